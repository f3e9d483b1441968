use std::{
    fs, io,
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::SystemTime,
};

use tempfile::TempDir;

use super::*;
use crate::TRUTH_TOPIC;
use eddy_bag::BagReader;
use eddy_cuda::solver::{Constants, Solvers};
use eddy_cuda_emulator::Emulator;
use eddy_frames::{Material, progress::Silent};
use eddy_mpm::{Body, Extent, Interval, Law, Preset, Shape, Solver};

/// Two frames of each scene, on one thread.
fn request(scenes: u32) -> SimulationRequest {
    SimulationRequest {
        source: Source::Random(Extent::usual(Preset::Kinds)),
        name: "kinds".to_owned(),
        scene_name: None,
        scenes,
        seed: 1,
        settings: Settings { duration: Some(0.032), ..Settings::default() },
        fields: false,
        device: None,
        threads: NonZeroUsize::new(1),
    }
}

fn output() -> (TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("out");
    (folder, output)
}

fn changed(output: &Path, id: u64) -> SystemTime {
    let metadata = output.join(directory(id)).join("metadata.yaml");
    fs::metadata(metadata).unwrap().modified().unwrap()
}

fn names(output: &Path) -> Vec<String> {
    let entries = fs::read_dir(output).unwrap();
    let mut names: Vec<String> =
        entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

/// Cancels after so many steps.
struct CancelAfter(u64, AtomicU64);

impl Progress for CancelAfter {
    fn advance(&self, steps: u64) {
        self.1.fetch_add(steps, Ordering::Relaxed);
    }

    fn cancelled(&self) -> bool {
        self.1.load(Ordering::Relaxed) >= self.0
    }
}

#[test]
fn a_cancelled_request_is_resumed_with_the_remaining_scenes() {
    let (_folder, output) = output();
    // In the middle of the second scene.
    let progress = CancelAfter(3, AtomicU64::new(0));
    let summary = simulate(&request(3), &output, &progress, None).unwrap();
    let [first] = &summary.finished[..] else { panic!("{summary:?}") };
    let first = first.start.id;
    let error = summary.complete().unwrap_err();
    assert!(matches!(error, SimulateError::Cancelled { finished: 1, scenes: 3 }), "{error}");
    assert_eq!(names(&output), ["manifest.json".to_owned(), directory(first)]);

    let before = changed(&output, first);
    let summary = simulate(&request(3), &output, &Silent, None).unwrap();
    let ids: Vec<u64> = summary.finished.iter().map(|scene| scene.start.id).collect();
    assert_eq!((summary.present, summary.frames()), (1, 4));
    assert_eq!(ids, (0..3).filter(|&id| id != first).collect::<Vec<_>>());
    summary.complete().unwrap();
    assert_eq!(changed(&output, first), before);
    let whole = |id| BagReader::open(&output.join(directory(id))).unwrap().message_count() == 2;
    assert!((0..3).all(whole));
}

#[test]
fn a_finished_request_and_a_longer_one_keep_what_is_there() {
    let (_folder, output) = output();
    simulate(&request(1), &output, &Silent, None).unwrap();
    let (before, manifest) = (changed(&output, 0), fs::read(output.join("manifest.json")).unwrap());
    let summary = simulate(&request(1), &output, &Silent, None).unwrap();
    assert_eq!((summary.present, summary.finished.len()), (1, 0));
    summary.complete().unwrap();
    assert_eq!(fs::read(output.join("manifest.json")).unwrap(), manifest);
    assert_eq!(simulate(&request(2), &output, &Silent, None).unwrap().finished.len(), 1);
    assert_eq!(changed(&output, 0), before);
    assert_eq!(recorded_scenes(&output).unwrap().unwrap().len(), 2);
}

#[test]
fn a_folder_of_another_request_is_rejected_with_the_fields_that_differ() {
    let (_folder, output) = output();
    simulate(&request(1), &output, &Silent, None).unwrap();
    let longer = Settings { duration: Some(0.048), ..request(1).settings };
    let more = Source::Random(Extent::of(Preset::Kinds, 2600).unwrap());
    for (other, expected) in [
        (SimulationRequest { seed: 2, ..request(1) }, vec!["seed 1 instead of 2"]),
        (
            SimulationRequest { fields: true, ..request(1) },
            vec!["fields the default instead of true"],
        ),
        (
            SimulationRequest { settings: longer, ..request(1) },
            vec!["settings.duration 0.032 instead of 0.048"],
        ),
        (
            SimulationRequest { source: more, name: "other".to_owned(), ..request(1) },
            vec!["particles the default instead of 2600", "scene \"kinds\" instead of \"other\""],
        ),
    ] {
        let error = simulate(&other, &output, &Silent, None).unwrap_err();
        assert!(error.to_string().contains("manifest.json: the scenes there have "));
        let SimulateError::OtherRequest { fields, .. } = error else { panic!("{error}") };
        assert_eq!(fields, expected);
    }
}

#[test]
fn an_output_directory_is_used_by_one_job_at_a_time() {
    let (_folder, output) = output();
    let plan = || Job::plan(&request(1), Some(&output), None).unwrap();
    let (first, second) = (plan(), plan());
    let store = first.open_store(&output).unwrap();
    let error = second.open_store(&output).unwrap_err();
    assert!(matches!(error, SimulateError::Locked { .. }), "{error}");
    first.write(&store, &Silent, None).complete().unwrap();
    store.close();
    // The scene that the second has planned is finished now.
    let error = second.open_store(&output).unwrap_err();
    assert!(matches!(error, SimulateError::Changed { .. }), "{error}");
}

#[test]
fn the_leftovers_of_a_killed_process_are_simulated_again_with_the_same_frames() {
    let (_folder, output) = output();
    let before = simulate(&request(2), &output, &Silent, None).unwrap().finished;
    // Killed after the entry in the manifest and before the bag was moved.
    let staging = output.join(".incomplete");
    fs::create_dir(&staging).unwrap();
    fs::rename(output.join(directory(1)), staging.join(directory(1))).unwrap();
    fs::write(staging.join("manifest.unfinished"), "{\"request\": ").unwrap();
    let again = simulate(&request(2), &output, &Silent, None).unwrap().finished;
    assert_eq!(again, before[1..]);
    assert_eq!(names(&output), ["manifest.json".to_owned(), directory(0), directory(1)]);
}

#[test]
fn a_bag_that_is_not_in_the_manifest_is_not_replaced() {
    let (_folder, output) = output();
    fs::create_dir_all(output.join(directory(0))).unwrap();
    let error = simulate(&request(1), &output, &Silent, None).unwrap_err();
    assert!(matches!(error, SimulateError::OtherScene { .. }), "{error}");
    assert_eq!(names(&output), [directory(0)]);
}

#[test]
fn an_invalid_request_is_rejected_before_anything_is_written() {
    let (_folder, output) = output();
    let scene = Box::new(Scene::generate(Preset::Kinds, 1, 0));
    let few = Settings { substeps: Some(1), ..Settings::default() };
    for (request, words) in [
        (request(0), "scenes: found 0, expected at least 1"),
        (
            SimulationRequest { source: Source::Written(scene), ..request(2) },
            "scenes: found 2, expected 1: a scene file",
        ),
        (
            SimulationRequest { threads: NonZeroUsize::new(1025), ..request(1) },
            "threads: found 1025, expected 1 to 1024",
        ),
        (
            SimulationRequest { settings: few, ..request(1) },
            "scene 0: substeps: found 1, expected at least",
        ),
    ] {
        let error = simulate(&request, &output, &Silent, None).unwrap_err();
        assert!(error.to_string().contains(words), "{error}");
        assert!(!output.exists());
    }
}

#[test]
fn failures_are_listed_with_their_remedy() {
    let failed = |reason| SimulateError::Failed {
        failures: vec![SimulateError::Scene { scene: "scene 3".into(), reason: Box::new(reason) }],
        finished: 2,
        scenes: 3,
    };
    let io = |kind: io::ErrorKind| SimulateError::io("write", Path::new("bag"))(kind.into());
    let diverged = MpmError::Field { field: "x".into(), found: "1".into(), expected: "2".into() };
    for (reason, end) in [
        (
            io(io::ErrorKind::StorageFull),
            "and kept; the disk is full: free some space, then run the same command again to resume",
        ),
        (io(io::ErrorKind::NotFound), "and kept; run the same command again to resume"),
        (diverged.into(), "2 of 3 scenes are finished and kept"),
    ] {
        let message = failed(reason).to_string();
        assert!(message.starts_with("scene 3: ") && message.ends_with(end), "{message}");
    }
}

#[test]
fn bytes_are_formatted_in_the_largest_unit() {
    let cases = [(0, "0 B"), (1023, "1023 B"), (1024, "1.00 KiB"), (3 << 29, "1.50 GiB")];
    for (count, expected) in cases {
        assert_eq!(plan::bytes(count), expected);
    }
    assert_eq!(plan::bytes(u64::MAX), "16.00 EiB");
}

/// The kernels of GPUs on the processor.
fn emulated() -> Solvers {
    Solvers::new(Arc::new(Emulator::new(&Constants).unwrap()), 0)
}

#[test]
fn scenes_side_by_side_on_a_device_are_those_of_the_processor() {
    let ((_a, here), (_b, there)) = (output(), output());
    let request = request(3);
    simulate(&request, &here, &Silent, None).unwrap().complete().unwrap();
    let job = Job::plan(&request, Some(&there), Some(MOST_SCENES)).unwrap();
    let store = job.open_store(&there).unwrap();
    let summary = job.write(&store, &Silent, Some(&mut emulated()));
    assert_eq!(summary.to_string(), format!("3 scenes, 6 frames: {}", there.display()));
    summary.complete().unwrap();
    store.close();
    assert_eq!(names(&there), ["manifest.json", "scene_0000", "scene_0001", "scene_0002"]);
    for id in 0..3 {
        let [expected, found] = [&here, &there].map(|output| {
            let bag = BagReader::open(&output.join(directory(id))).unwrap();
            bag.frames(TRUTH_TOPIC).unwrap().collect::<Result<Vec<_>, _>>().unwrap()
        });
        assert_eq!(expected.len(), found.len());
        for (expected, found) in expected.iter().zip(&found) {
            assert_eq!(expected.stamp, found.stamp);
            let pairs = expected.position.iter().zip(&found.position);
            let far = pairs.map(|(a, b)| (a[0] - b[0]).hypot(a[1] - b[1])).sum::<f32>();
            assert!(far / (found.len() as f32) < 1e-4, "scene {id}: {far}");
        }
    }
}

/// A device with room for two scenes that fails after it was loaded so often.
struct Failing(Solvers, u32);

impl Accelerator for Failing {
    fn has_room(&self, solvers: &[&Solver]) -> Result<bool, MpmError> {
        Ok(solvers.len() <= 2)
    }

    fn load(&mut self, solvers: &[&Solver]) -> Result<(), MpmError> {
        assert!(solvers.len() <= 2);
        self.1 -= 1;
        self.0.load(solvers)
    }

    fn run(
        &mut self,
        intervals: &[Interval],
        cancelled: &(dyn Fn() -> bool + Sync),
    ) -> Result<Vec<Result<(), usize>>, MpmError> {
        if self.1 == 0 {
            return Err(MpmError::Device("GPU: cuStreamSynchronize failed: it is gone".into()));
        }
        self.0.run(intervals, cancelled)
    }

    fn fetch(&mut self, solvers: &mut [&mut Solver]) {
        self.0.fetch(solvers);
    }
}

#[test]
fn finished_scenes_stay_when_a_device_fails_and_the_others_are_resumed() {
    let (_folder, output) = output();
    let run = |loads: u32| {
        let job = Job::plan(&request(5), Some(&output), Some(MOST_SCENES)).unwrap();
        let store = job.open_store(&output).unwrap();
        let mut device = Failing(emulated(), loads);
        let outcome = job.write(&store, &Silent, Some(&mut device)).complete();
        store.close();
        outcome
    };
    let error = run(2).unwrap_err().to_string();
    // The manifest and at least the first scene.
    let finished = names(&output).len() - 1;
    assert!((1..5).contains(&finished), "{finished}");
    let expected =
        format!("{finished} of 5 scenes are finished and kept; run the same command again");
    assert!(error.contains("it is gone") && error.contains(&expected), "{error}");
    run(u32::MAX).unwrap();
    assert_eq!(names(&output).len(), 6);
}

/// All files of a folder with their bytes.
fn contents(folder: &Path) -> Vec<(String, Vec<u8>)> {
    let mut files = Vec::new();
    for name in names(folder) {
        let path = folder.join(&name);
        if path.is_dir() {
            let inside = contents(&path).into_iter();
            files.extend(inside.map(|(file, bytes)| (format!("{name}/{file}"), bytes)));
        } else {
            files.push((name, fs::read(path).unwrap()));
        }
    }
    files
}

#[test]
fn scenes_of_several_processes_are_those_of_one_byte_for_byte() {
    let ((_a, alone), (_b, shared)) = (output(), output());
    let request = request(4);
    simulate(&request, &alone, &Silent, None).unwrap().complete().unwrap();
    let some = |scenes| simulate_some(&request, scenes, &shared, &Silent, None).unwrap();
    some(2..4).complete().unwrap();
    let error = collect(&request, &shared).unwrap_err().to_string();
    assert!(
        error.contains("scene_0000: found no bag") && error.ends_with("1 more are missing"),
        "{error}"
    );
    // Two at once, of which one runs a scene that the other has just finished.
    let late = Job::plan_some(&request, 1..2, Some(&shared), None).unwrap();
    let store = Store::share(&shared, &request.recorded()).unwrap();
    assert_eq!(some(0..2).finished.len(), 2);
    let before = changed(&shared, 1);
    late.write(&store, &Silent, None).complete().unwrap();
    assert_eq!(changed(&shared, 1), before);
    let error = simulate(&request, &shared, &Silent, None).unwrap_err();
    assert!(matches!(error, SimulateError::Locked { .. }), "{error}");
    let error = collect(&request, &shared).unwrap_err();
    assert!(matches!(error, SimulateError::Locked { .. }), "{error}");
    store.close();
    assert_eq!(some(0..4).present, 4);
    collect(&request, &shared).unwrap();
    assert_eq!(contents(&shared), contents(&alone));
    collect(&request, &shared).unwrap();
    assert_eq!(contents(&shared), contents(&alone));
}

#[test]
fn one_process_goes_on_where_several_have_begun() {
    let ((_a, alone), (_b, shared)) = (output(), output());
    simulate(&request(3), &alone, &Silent, None).unwrap().complete().unwrap();
    simulate_some(&request(3), 1..2, &shared, &Silent, None).unwrap().complete().unwrap();
    let other = SimulationRequest { seed: 2, ..request(3) };
    for error in [
        simulate(&other, &shared, &Silent, None).unwrap_err(),
        simulate_some(&other, 0..2, &shared, &Silent, None).unwrap_err(),
    ] {
        let SimulateError::OtherRequest { fields, .. } = error else { panic!("{error}") };
        assert_eq!(fields, ["seed 1 instead of 2"]);
    }
    assert_eq!(simulate(&request(3), &shared, &Silent, None).unwrap().finished.len(), 2);
    assert_eq!(contents(&shared), contents(&alone));
}

/// A written scene in which water hits a wall.
fn impact() -> SimulationRequest {
    let body = Body {
        material: Material::Liquid,
        shape: Shape::Rectangle { size: [0.1, 0.1] },
        position: [0.2, 0.5],
        angle_degrees: 0.0,
        velocity: [-20.0, 0.0],
        particles: None,
    };
    let scene = Scene { bodies: vec![body], cell_width: 1.0 / 32.0, ..Scene::default() };
    let settings = Settings { duration: Some(0.064), ..Settings::default() };
    SimulationRequest { source: Source::Written(Box::new(scene)), settings, ..request(1) }
}

#[test]
fn the_manifest_has_the_substeps_of_frames_that_needed_more() {
    let ((_a, here), (_b, there)) = (output(), output());
    let mut scenes = Vec::new();
    for (output, device) in [(&here, None), (&there, Some(&mut emulated() as &mut dyn Accelerator))]
    {
        simulate(&impact(), output, &Silent, device).unwrap().complete().unwrap();
        let manifest = Manifest::open(output, &impact().recorded()).unwrap();
        scenes.push(manifest.scene(0).unwrap().unwrap());
    }
    for Finished { start, refined, frames, .. } in scenes {
        assert_eq!(frames, 4);
        assert!(!refined.is_empty(), "{refined:?}");
        let more = |&[frame, most]: &[u64; 2]| frame < 4 && most > u64::from(start.substeps);
        assert!(refined.iter().all(more), "{refined:?}");
    }
}

#[test]
fn a_damaged_bag_is_found_when_the_request_is_repeated() {
    let (_folder, output) = output();
    let run = || simulate(&request(2), &output, &Silent, None);
    run().unwrap().complete().unwrap();
    assert_eq!(run().unwrap().present, 2);
    let file = output.join(directory(1)).join("scene_0001_0.mcap");
    let whole = fs::read(&file).unwrap();
    let middle = whole.len() / 2;
    let mut flipped = whole.clone();
    flipped[middle] ^= 1;
    for damaged in [&whole[..middle], &[], &flipped] {
        fs::write(&file, damaged).unwrap();
        let said = run().unwrap_err().to_string();
        for words in ["scene_0001: found ", "expected 2 frames as in manifest.json", "delete it"] {
            assert!(said.contains(words), "{said}");
        }
    }
    fs::remove_dir_all(output.join(directory(1))).unwrap();
    assert_eq!(run().unwrap().finished.len(), 1);
    assert_eq!(fs::read(&file).unwrap(), whole);
}

#[test]
fn scenes_of_older_versions_fall_down_as_they_did() {
    // Both written by eddy 0.1.0 of 2026-11, in which gravity was along -y: the scene, and the manifest of its bag.
    let file = concat!(env!("CARGO_MANIFEST_DIR"), "/src/simulate/golden/older_scene.toml");
    // The default law was `water`.
    let load = || {
        let mut scene: Scene = eddy_settings::load(Path::new(file)).unwrap();
        scene.materials.law = Law::Water;
        scene
    };
    let mut scene = load();
    assert_eq!(scene.solver.gravity, 1.6);
    assert!(scene.check().unwrap_err().to_string().contains("negative is down"));
    let folder = tempfile::tempdir().unwrap();
    let manifest = include_str!("golden/older_manifest.json");
    fs::write(folder.path().join("manifest.json"), manifest).unwrap();
    let recorded = recorded_scenes(folder.path()).unwrap().unwrap();
    let note = scene.read_older_form().unwrap();
    assert_eq!(
        note,
        "solver.gravity: found 1.6, read as -1.6: gravity is along y, and negative is down"
    );
    assert_eq!(recorded[&0], scene);
    assert_eq!(scene.read_older_form(), None, "it has the present form now");

    // The request reads it, too, and gives the frames of then.
    let digest = manifest.split("\"sha256\":\"").nth(1).unwrap().split('"').next().unwrap();
    let (settings, source) = (Settings::default(), Source::Written(Box::new(load())));
    let request = SimulationRequest { source, settings, ..request(1) };
    let (_other, output) = output();
    let summary = simulate(&request, &output, &Silent, None).unwrap();
    assert_eq!(summary.finished[0].sha256, digest);
    let bag = BagReader::open(&output.join(directory(0))).unwrap();
    assert_eq!(bag.custom_data()["eddy_gravity"], "-1.6");
}
