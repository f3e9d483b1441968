//! `eddy simulate`: what it leaves on disk, and what it refuses.

use std::{collections::BTreeSet, fs, path::Path, process::Command, time::Duration};

use eddy_bag::BagReader;
use eddy_frames::{Frame, Stamp};
use eddy_messages::{self as msg, Message, ParticleFrame, cdr};
use eddy_transport::{Link, TransportOptions, Transports};

use crate::support::{DEADLINE, Process, eddy, fail, succeed, talking_eddy, unique, wait_for};

fn simulate(output: &Path, more: &[&str]) -> Vec<String> {
    let mut arguments = vec!["simulate", "--output", output.to_str().unwrap()];
    if !more.contains(&"--duration") {
        arguments.extend(["--duration", "0.032"]);
    }
    arguments.extend(more);
    arguments.into_iter().map(str::to_owned).collect()
}

fn manifest(output: &Path) -> serde_json::Value {
    serde_json::from_str(&fs::read_to_string(output.join("manifest.json")).unwrap()).unwrap()
}

#[test]
fn the_same_seed_writes_the_same_bags() {
    let folder = tempfile::tempdir().unwrap();
    let (first, second) = (folder.path().join("first"), folder.path().join("second"));
    for output in [&first, &second] {
        succeed(simulate(output, &["--scenes", "3", "--seed", "4"]));
    }
    for scene in ["scene_0000", "scene_0001", "scene_0002"] {
        let file = format!("{scene}/{scene}_0.mcap");
        assert_eq!(fs::read(first.join(&file)).unwrap(), fs::read(second.join(&file)).unwrap());
    }
    assert_eq!(manifest(&first), manifest(&second));
    assert_eq!(manifest(&first)["scenes"][2]["frames"], 2);
    assert_eq!(fs::read_dir(&first).unwrap().count(), 4, "three bags and the manifest");
}

#[test]
fn the_manifest_says_what_every_scene_is_and_how_its_energy_went() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path();
    succeed(simulate(output, &["--scenes", "2", "--duration", "0.8", "--stiffness", "500"]));
    let manifest = manifest(output);
    assert_eq!(manifest["request"]["seed"], 1);
    for (id, scene) in manifest["scenes"].as_array().unwrap().iter().enumerate() {
        assert_eq!(scene["id"], id);
        assert_eq!(scene["materials"].as_array().unwrap().len(), 2);
        assert!(scene["substeps"].as_u64().unwrap() > 50);
        assert_eq!(scene["scene"]["materials"]["stiffness"], 500.0);
        assert_eq!(scene["frames"], 50);
        assert_eq!(scene["sha256"].as_str().unwrap().len(), 64);
        let time = scene["energy"]["time"].as_array().unwrap();
        let kinetic = scene["energy"]["kinetic"].as_array().unwrap();
        assert_eq!((time.len(), kinetic.len()), (33, 33));
        assert_eq!((&time[0], &time[32]), (&0.0.into(), &0.784.into()));
        // The energy of the last frame, as its bag has it: particles of density 1 half a cell wide.
        // The affine motion around them, which no frame tells, adds a little.
        let last = frames(&output.join(format!("scene_000{id}"))).pop().unwrap();
        let squares: f64 = last.velocity.as_flattened().iter().map(|&v| f64::from(v * v)).sum();
        let height: f64 = last.position.iter().map(|p| f64::from(p[1])).sum();
        let mass = (0.5f64 / 64.0).powi(2);
        let found = |kind: &str| scene["energy"][kind][32].as_f64().unwrap();
        let ratio = found("kinetic") / (0.5 * mass * squares);
        assert!((1.0..1.1).contains(&ratio), "{ratio}");
        assert!((found("potential") / (9.8 * mass * height) - 1.0).abs() < 1e-4);
        assert!(found("elastic") > 0.0);
    }
}

#[test]
fn a_range_of_stiffness_gives_each_scene_its_own_and_is_part_of_the_request() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path();
    let asked = |scenes, range| {
        simulate(output, &["--scenes", scenes, "--duration", "0.032", "--stiffness", range])
    };
    succeed(asked("3", "300..3000"));
    let written = manifest(output);
    assert_eq!(written["request"]["stiffness"], serde_json::json!([300.0, 3000.0]));
    let scenes = written["scenes"].as_array().unwrap().iter();
    let all = scenes.map(|scene| scene["scene"]["materials"]["stiffness"].as_f64().unwrap());
    let mut all: Vec<_> = all.collect();
    assert!(all.iter().all(|stiffness| (300.0..=3000.0).contains(stiffness)), "{all:?}");
    all.sort_by(f64::total_cmp);
    all.dedup();
    assert_eq!(all.len(), 3, "all scenes are different");

    let said = fail(1, asked("4", "300..4000"));
    assert!(said.contains("stiffness [300.0,3000.0] instead of [300.0,4000.0]"), "{said}");
    let said = fail(2, asked("4", "300..200"));
    let expected = "--stiffness: found 300..200, expected a positive number and a larger one";
    assert!(said.contains(expected), "{said}");
    let said = fail(2, asked("4", "soft"));
    assert!(said.contains("expected a number, or a range such as 300..3e5"), "{said}");
    let said = fail(2, simulate(output, &["--preset", "dam-break", "--stiffness", "1..2"]));
    assert!(said.contains("expected one number: preset dam-break is a single scene"), "{said}");
    let file = folder.path().join("scene.toml");
    fs::write(&file, "").unwrap();
    let said =
        fail(2, simulate(output, &["--scene", file.to_str().unwrap(), "--stiffness", "1..2"]));
    assert!(said.contains("scene.toml is a single scene"), "{said}");
}

fn frames(bag: &Path) -> Vec<Frame> {
    BagReader::open(bag).unwrap().frames("/particles").unwrap().map(Result::unwrap).collect()
}

#[test]
fn threads_change_nothing_but_the_time() {
    let folder = tempfile::tempdir().unwrap();
    let digests = ["1", "3"].map(|threads| {
        let output = folder.path().join(threads);
        succeed(simulate(&output, &["--scenes", "3", "--threads", threads]));
        let manifest = manifest(&output);
        let scenes = manifest["scenes"].as_array().unwrap().clone();
        scenes.iter().map(|scene| scene["sha256"].to_string()).collect::<Vec<_>>()
    });
    assert_eq!(digests[0], digests[1]);
    assert_eq!(digests[0].iter().collect::<BTreeSet<_>>().len(), 3, "three scenes");
}

#[test]
fn a_finer_solver_records_the_particles_of_the_scene() {
    let folder = tempfile::tempdir().unwrap();
    let [usual, finer] = ["usual", "finer"].map(|name| folder.path().join(name));
    let short = ["--scenes", "1", "--seed", "3", "--duration", "0.1", "--fields"];
    succeed(simulate(&usual, &short));
    succeed(simulate(&finer, &[&short[..], &["--resolve", "2"]].concat()));
    let scene = &manifest(&finer)["scenes"][0]["scene"];
    assert_eq!(scene["solver"]["resolve"], 2);
    let [usual, finer] = [usual, finer].map(|bag| frames(&bag.join("scene_0000")));
    assert_eq!(usual.len(), finer.len());
    for (usual, finer) in usual.iter().zip(&finer) {
        assert_eq!((usual.domain, &usual.material), (finer.domain, &finer.material));
    }
    assert_ne!(usual[0].position, finer[0].position);
}

#[test]
fn scenes_of_more_particles_are_wider_and_the_same_command_goes_on_with_them() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path();
    let asked = |scenes, particles| {
        let more = ["--preset", "kinds", "--scenes", scenes, "--particles", particles];
        simulate(output, &more)
    };
    succeed(asked("1", "6000"));
    assert!(succeed(asked("2", "6000")).contains("1 of 2 scenes are already in"));
    for bag in ["scene_0000", "scene_0001"] {
        let frame = &frames(&output.join(bag))[1];
        assert_eq!(frame.len(), 6000);
        let width = (2.4f32 * 64.0).ceil() / 64.0;
        assert_eq!((frame.domain.lower, frame.domain.upper), ([0.0; 2], [width, 1.0]));
    }
    assert_eq!(manifest(output)["request"]["particles"], 6000);
    let said = fail(1, asked("2", "6001"));
    assert!(said.contains("particles 6000 instead of 6001; choose another --output"), "{said}");
}

#[test]
fn scenes_with_the_same_bodies_and_particles_along_a_curve_are_what_they_say() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path();
    let asked = |more: &[&str]| {
        let usual = ["--preset", "fluid", "--scenes", "2", "--duration", "0.1"];
        simulate(output, &[&usual[..], more].concat())
    };
    let curve = ["--same-bodies", "--particle-order", "curve"];
    succeed(asked(&curve));
    let firsts = ["scene_0000", "scene_0001"].map(|bag| frames(&output.join(bag)).remove(0));
    let near = |pair: &[[f32; 2]]| (pair[0][0] - pair[1][0]).hypot(pair[0][1] - pair[1][1]) < 0.02;
    for frame in &firsts {
        let near = frame.position.windows(2).filter(|pair| near(pair)).count();
        assert!(near > frame.len() * 9 / 10, "{near} of {} are near the one before", frame.len());
    }
    assert_ne!(firsts[0].velocity, firsts[1].velocity);
    let request = &manifest(output)["request"];
    assert_eq!(
        (&request["same_bodies"], &request["settings"]["order"]),
        (&true.into(), &"curve".into())
    );
    let said = fail(1, asked(&curve[1..]));
    assert!(said.contains("same_bodies"), "{said}");
    let said = fail(2, simulate(output, &["--preset", "dam-break", "--same-bodies"]));
    assert!(said.contains("--same-bodies: preset dam-break is a single scene"), "{said}");
}

#[test]
fn scenes_of_a_random_fill_differ_in_their_numbers_of_particles() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path();
    let asked = |fill: &str| {
        let usual = ["--preset", "kinds", "--scenes", "3", "--duration", "0.05", "--fill", fill];
        simulate(output, &usual)
    };
    succeed(asked("0.05..0.3"));
    let counts = ["scene_0000", "scene_0001", "scene_0002"]
        .map(|bag| frames(&output.join(bag)).remove(0).len());
    assert!(counts.iter().all(|count| (819..4916).contains(count)), "{counts:?}");
    assert!(counts[0] != counts[1] && counts[1] != counts[2], "{counts:?}");
    succeed(asked("0.05..0.3"));
    let said = fail(1, asked("0.05..0.2"));
    assert!(said.contains("fill [0.05,0.3] instead of [0.05,0.2]"), "{said}");
    let said = fail(2, asked("0.2..0.3"));
    assert!(
        said.contains("--fill: found 0.2..0.3, expected a range that begins at 0.02 to 0.15"),
        "{said}"
    );
    let said = fail(2, simulate(output, &["--preset", "dam-break", "--fill", "0.1..0.2"]));
    assert!(said.contains("--fill: preset dam-break is a single scene"), "{said}");
}

#[test]
fn asking_for_2500_particles_is_asking_for_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path();
    succeed(simulate(output, &["--scenes", "1"]));
    let said = succeed(simulate(output, &["--scenes", "2", "--particles", "2500"]));
    assert!(said.contains("1 of 2 scenes are already in"), "{said}");
    assert_eq!(manifest(output)["request"].get("particles"), None);
}

#[test]
fn a_scene_that_fails_leaves_the_others_as_they_are() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path();
    // So soft that sound is slower than the splashes: the matter of some scenes is crushed.
    let more = ["--scenes", "6", "--duration", "0.8", "--stiffness", "10"];
    let said = fail(1, simulate(output, &more));
    let failed = said.lines().filter(|line| line.contains("found matter crushed")).count();
    assert!((1..6).contains(&failed), "{said}");
    let manifest = manifest(output);
    let finished = manifest["scenes"].as_array().unwrap();
    assert_eq!(finished.len() + failed, 6, "{said}");
    assert!(said.contains(&format!("{} of 6 scenes are finished and kept", finished.len())));
    for scene in finished {
        let bag = output.join(format!("scene_000{}", scene["id"]));
        assert_eq!(frames(&bag).len(), 50);
    }
    assert_eq!(fs::read_dir(output).unwrap().count(), finished.len() + 1, "no half a bag is left");
}

#[cfg(unix)]
#[test]
fn a_full_disk_keeps_what_is_finished() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path();
    let arguments = |scenes: &str| simulate(output, &["--scenes", scenes, "--duration", "0.32"]);
    succeed(arguments("2"));
    let before = manifest(output);

    // What the system says of a file over the limit reaches the program as that of a full disk does.
    let mut limited = Command::new("sh");
    limited.args(["-c", "trap '' XFSZ; ulimit -f 100; exec \"$@\"", "sh"]);
    let limited = limited.arg(eddy().get_program()).args(arguments("4")).output().unwrap();
    let said = String::from_utf8_lossy(&limited.stderr);
    assert_eq!(limited.status.code(), Some(1), "{said}");
    assert!(said.contains("2 of 4 scenes are finished and kept"), "{said}");
    assert!(said.contains("the disk is full: free some space"), "{said}");
    assert_eq!(manifest(output), before);
    assert_eq!(fs::read_dir(output).unwrap().count(), 3, "two bags and the manifest");

    assert!(succeed(arguments("4")).contains("2 of 4 scenes are already in"));
}

#[test]
fn a_live_source_publishes_every_frame_in_time_and_the_clock_before_it() {
    let topic = format!("/{}/particles", unique("live"));
    let [frames_link, clock_link] =
        [&topic, "/clock"].map(|topic| format!("shm:{topic}").parse::<Link>().unwrap());
    let transports = Transports::new(TransportOptions::new("test_live"));
    let mut particles = transports.subscriber(&frames_link, ParticleFrame::TYPE).unwrap();
    let mut clock = transports.subscriber(&clock_link, msg::Clock::TYPE).unwrap();

    let folder = tempfile::tempdir().unwrap();
    let output = folder.path();
    let started = std::time::Instant::now();
    let link = frames_link.to_string();
    let more = ["--duration", "0.8", "--publish", &link, "--rate", "0.5", "--wait-for", "1"];
    let mut source = Process::start(eddy().args(simulate(output, &more)));
    let (mut received, mut times): (Vec<Frame>, BTreeSet<Stamp>) = Default::default();
    while received.len() < 50 && started.elapsed() < DEADLINE {
        if let Some(payload) = particles.receive(Duration::from_millis(20)).unwrap() {
            let frame = payload.into_frame().unwrap();
            let due = Duration::from_secs_f64(frame.stamp.seconds() / 0.5);
            assert!(started.elapsed() >= due, "frame {} came too early", frame.sequence);
            received.push(frame);
        }
        while let Some(payload) = clock.receive(Duration::ZERO).unwrap() {
            let message: msg::Clock = cdr::decode(&payload.into_cdr()).unwrap();
            times.insert(message.clock.into());
        }
    }
    assert!(source.wait().success());
    assert_eq!(received, frames(&output.join("scene_0000")), "what was published is recorded");
    assert!(received.iter().all(|frame| times.contains(&frame.stamp)), "{times:?}");
}

#[test]
fn an_interrupt_ends_a_live_source_cleanly() {
    let link = format!("shm:/{}/particles", unique("live"));
    let mut command = talking_eddy();
    command.args(["simulate", "--publish", &link, "--duration", "1000", "--reliability", "drop"]);
    let mut source = Process::start_until(&mut command, "publishing on shm:");
    source.interrupt();
    assert!(source.wait().success());
}

#[test]
fn a_live_source_that_cannot_be_is_refused() {
    let refused = |more: &[&str], code: i32| fail(code, [&["simulate"], more].concat());
    assert!(refused(&["--publish", "memory:/x"], 2).contains("expected shm, zenoh or dds"));
    let said = refused(&["--publish", "shm:/x", "--rate", "0"], 2);
    assert!(said.contains("--rate") && said.contains("expected a positive number"), "{said}");
    assert!(refused(&["--rate", "2", "--output", "x"], 2).contains("--publish"));
    assert!(
        refused(&["--scene", "x.toml", "--scenes", "2", "--output", "x"], 2).contains("--scene")
    );
}

#[test]
fn scenes_that_are_there_are_kept_and_new_ones_added() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path();
    succeed(simulate(output, &["--scenes", "1"]));
    let bag = output.join("scene_0000/scene_0000_0.mcap");
    let made = fs::metadata(&bag).unwrap().modified().unwrap();
    let said = succeed(simulate(output, &["--scenes", "2"]));
    assert!(said.contains("1 of 2 scenes are already in"), "{said}");
    assert_eq!(fs::metadata(&bag).unwrap().modified().unwrap(), made);
    assert_eq!(manifest(output)["scenes"].as_array().unwrap().len(), 2);
}

#[test]
fn a_directory_of_other_scenes_is_left_as_it_is() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path();
    succeed(simulate(output, &["--scenes", "1", "--seed", "1"]));
    let before = manifest(output);
    let said = fail(1, simulate(output, &["--scenes", "1", "--seed", "2"]));
    assert!(said.contains("there have seed 1 instead of 2; choose another"), "{said}");
    assert_eq!(manifest(output), before);
    succeed(simulate(output, &["--scenes", "1", "--seed", "2", "--force"]));
    assert_eq!(manifest(output)["request"]["seed"], 2);

    let foreign = output.join("foreign");
    fs::create_dir_all(foreign.join("scene_0000")).unwrap();
    let said = fail(1, simulate(&foreign, &["--scenes", "1"]));
    assert!(
        said.contains("already exists and is not this scene according to the manifest"),
        "{said}"
    );
}

#[test]
fn an_unstable_request_is_refused_before_anything_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("unstable");
    let said = fail(1, simulate(&output, &["--substeps", "20"]));
    assert!(
        said.contains("scene 0: substeps: found 20, expected at least 153 per frame"),
        "{said}"
    );
    assert!(!output.exists());
    fail(2, ["simulate", "--preset", "gas", "--output", "x"]);

    for (more, words) in [
        (["--preset", "kinds", "--particles", "0"], ["particles: found 0", "expected 250 to "]),
        (["--preset", "kinds", "--particles", "100"], ["particles: found 100", "expected 250 to "]),
        (["--preset", "fluid", "--particles", "9999999"], ["found 9999999", "to 1277500 in"]),
        (
            ["--preset", "viscous-jet", "--particles", "1000"],
            ["--particles: preset viscous-jet", "fixed number of particles"],
        ),
    ] {
        let said = fail(2, simulate(&output, &more));
        assert!(words.iter().all(|word| said.contains(word)), "{said}");
    }
    fail(2, ["simulate", "--scene", "own.toml", "--particles", "1000", "--output", "x"]);
}

#[test]
fn an_interrupt_keeps_what_is_finished_and_the_same_command_goes_on() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path();
    let folder = output.to_str().unwrap();
    let arguments = ["simulate", "--duration", "0.32", "--scenes", "30", "--output", folder];
    let mut process = Process::start(eddy().args(arguments).env("RAYON_NUM_THREADS", "2"));
    wait_for("a scene is finished", || output.join("manifest.json").exists().then_some(()));
    process.interrupt();
    assert_eq!(process.wait().code(), Some(1));
    assert!(!output.join(".incomplete").exists());
    let finished = manifest(output)["scenes"].as_array().unwrap().len();
    assert!((1..30).contains(&finished), "{finished}");
    assert_eq!(fs::read_dir(output).unwrap().count(), finished + 1, "bags and the manifest");
    let said = succeed(arguments);
    assert!(said.contains(&format!("{finished} of 30 scenes are already in")), "{said}");
}

#[test]
fn a_killed_simulation_is_taken_up_by_the_same_command() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path();
    let arguments = simulate(output, &["--scenes", "8", "--duration", "0.32", "--threads", "2"]);
    let process = Process::start(eddy().args(&arguments));
    wait_for("a scene is finished", || output.join("manifest.json").exists().then_some(()));
    process.kill();
    assert!(output.join(".incomplete").exists());
    succeed(&arguments);
    let manifest = manifest(output);
    assert_eq!(manifest["scenes"].as_array().unwrap().len(), 8);
    for id in 0..8 {
        assert_eq!(frames(&output.join(format!("scene_000{id}"))).len(), 20);
    }
    assert_eq!(fs::read_dir(output).unwrap().count(), 9, "eight bags and the manifest");
}
