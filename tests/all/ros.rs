//! The node as ROS starts, sets and watches it: `--ros-args`, parameters, simulated time, clouds.

use std::{
    fs,
    path::Path,
    process::{Command, Stdio},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::{Duration, Instant},
};

use eddy_bag::BagReader;
use eddy_frames::{Frame, Stamp};
use eddy_inference::{checkpoint::Checkpoint, engine::Surrogate};
use eddy_messages::{
    Clock, DiagnosticArray, Message, ParameterEvent, ParticleFrame, PointCloud2, PredictionStatus,
    cdr, cloud,
    services::{Parameter, ParameterValue},
};
use eddy_node::{
    FrameQueue, NodeContext, NodeHandle, NodeRequest, NodeSettings, Outputs, RosTime,
    SurrogateNode, drive,
};
use eddy_transport::{Link, Publisher, Reliability, Subscriber, TransportOptions, Transports};

use crate::support::{DEADLINE, Process, World, domain, simulate, talking_eddy, unique, wait_for};

/// Time between two frames of the sample bag.
const DT: Duration = Duration::from_millis(16);

/// The frames of the sample bag.
fn frames() -> Vec<Frame> {
    let bag = Path::new(env!("CARGO_MANIFEST_DIR")).join("bags/sample");
    let reader = BagReader::open(&bag).unwrap();
    reader.frames("/particles").unwrap().map(Result::unwrap).collect()
}

/// How the node is started.
trait Predicting {
    fn node(&self, arguments: &[&str]) -> Command;
    fn start(&self, arguments: &[&str]) -> Process;
}

impl Predicting for World {
    /// A node that reads `particles`, publishes `prediction` and has `clock` and `diagnostics` here.
    fn node(&self, arguments: &[&str]) -> Command {
        let mut command = talking_eddy();
        command.args(["node", "--reliability", "block"]);
        command.args(["--input", "shm:/particles", "--output", "shm:/prediction", "--ros-args"]);
        for name in ["particles", "prediction", "clock", "diagnostics"] {
            command.args(["-r", &format!("/{name}:={}", self.topic(name))]);
        }
        command.args(arguments);
        command
    }

    fn start(&self, arguments: &[&str]) -> Process {
        let predicting = format!("predicting {}", self.link("shm", "particles"));
        Process::start_until(&mut self.node(arguments), &predicting)
    }
}

fn receive<M: Message>(subscriber: &mut dyn Subscriber) -> M {
    let payload = subscriber.receive(DEADLINE).unwrap().expect("a message comes");
    cdr::decode(&payload.into_cdr()).unwrap()
}

fn refused(arguments: &[&str]) -> (Option<i32>, String) {
    let mut command = talking_eddy();
    let output = command.args(arguments).output().unwrap();
    (output.status.code(), String::from_utf8(output.stderr).unwrap())
}

#[test]
fn names_and_parameters_come_from_the_arguments_and_files_of_ros() {
    let world = World::new("ros");
    let file = world.folder.path().join("parameters.yaml");
    let text = "/**: {ros__parameters: {horizon: 4, of_another_node: 1}}
robot1/predictor: {ros__parameters: {publish: all}}";
    fs::write(&file, text).unwrap();
    let mut diagnostics = world.subscriber("shm", "diagnostics", DiagnosticArray::TYPE);
    let mut status = world.subscriber("shm", "prediction/status", PredictionStatus::TYPE);
    let mut truth = world.publisher("shm", "particles", ParticleFrame::TYPE);
    let mut node = world.start(&[
        "-r",
        "__node:=predictor",
        "-r",
        "__ns:=/robot1",
        "--params-file",
        file.to_str().unwrap(),
        "-p",
        "horizon:=3",
    ]);
    assert_eq!(receive::<DiagnosticArray>(&mut *diagnostics).status[0].name, "robot1/predictor");
    for frame in &frames() {
        truth.publish_frame(frame).unwrap();
    }
    // The last value of a parameter counts, and all frames up to it are published.
    let ahead = [(); 4].map(|()| receive::<PredictionStatus>(&mut *status).horizon);
    assert_eq!(ahead, [1, 2, 3, 1]);
    // Or the node would wait for it to read the rest.
    drop(status);
    node.interrupt();
    assert!(node.wait().success());
}

#[test]
fn diagnostics_warn_of_a_stream_whose_error_is_expected_to_be_large() {
    let world = World::new("ros");
    let mut diagnostics = world.subscriber("shm", "diagnostics", DiagnosticArray::TYPE);
    let mut truth = world.publisher("shm", "particles", ParticleFrame::TYPE);
    let parameters = ["-p", "horizon:=20", "-p", "max_expected_error:=0.00001"];
    let mut node = world.start(&parameters);
    for frame in &frames() {
        truth.publish_frame(frame).unwrap();
    }
    let warning = wait_for("an expected error is reported", || {
        let status = receive::<DiagnosticArray>(&mut *diagnostics).status.remove(0);
        status.values.iter().any(|v| v.key.starts_with("largest expected error")).then_some(status)
    });
    assert_eq!(warning.level, 1, "{warning:?}");
    let words =
        ["the error 20 frames ahead is expected to be ", "above max_expected_error 0.00001"];
    assert!(words.iter().all(|word| warning.message.contains(word)), "{}", warning.message);
    node.interrupt();
    assert!(node.wait().success());
}

#[test]
fn without_links_topics_are_in_the_namespace() {
    let domain = domain().to_string();
    let mut command = talking_eddy();
    command.env("ROS_DOMAIN_ID", &domain).args(["node", "--ros-args", "-r", "__ns:=/robot1"]);
    let mut node = Process::start(&mut command);
    let line = node.line("predicting");
    assert!(line.contains("zenoh:/robot1/particles -> zenoh:/robot1/prediction"), "{line}");
    node.interrupt();
    assert!(node.wait().success());
}

#[test]
fn links_of_a_node_may_be_relative_to_it() {
    let name = unique("relative");
    let (input, output) = (format!("shm:{name}/particles"), "shm:~/prediction");
    let rename = format!("__node:={name}");
    let mut command = talking_eddy();
    command.args(["node", "--input", &input, "--output", output]);
    command.args(["--ros-args", "-r", "__ns:=/robot1", "-r", &rename]);
    let mut node = Process::start(&mut command);
    let line = node.line("predicting");
    let expected = format!("shm:/robot1/{name}/particles -> shm:/robot1/{name}/prediction with");
    assert!(line.contains(&expected), "{line}");
    node.interrupt();
    assert!(node.wait().success());
}

#[test]
fn arguments_of_ros_that_cannot_be_used_are_named() {
    let shm = ["--input", "shm:/a", "--output", "shm:/b"];
    let node = |arguments: &[&str]| refused(&[&["node"], &shm[..], arguments].concat());
    for (arguments, code, expected) in [
        (["-r", "/a"], 2, "-r /a: found `/a`, expected FROM:=TO"),
        (["-x", "y"], 2, "--ros-args: found `-x`, expected -r/--remap, -p/--param"),
        (["--params-file", "/no/file"], 2, "--params-file /no/file: found No such file"),
        (["--log-level", "loud"], 2, "--log-level loud: found `loud`, expected debug, info"),
        (["-p", "horizon:=0"], 1, "-p horizon:=0: horizon: found 0, expected 1 to 10000"),
        (["-p", "depth:=1"], 1, "-p depth:=1: parameter: found depth, expected one of horizon"),
        (["-p", "queue:=many"], 1, "-p queue:=many: queue: found a string, expected an integer"),
        (["-r", "/b:=/c"], 2, "output: found shm:/c twice, expected once"),
    ] {
        let twice = ["--output", "shm:/c", "--ros-args"];
        let (found, message) = node(&[&twice[..], &arguments].concat());
        assert!(message.contains(expected), "{message}");
        assert_eq!(found, Some(code), "{message}");
    }
    let (code, message) = refused(&["replay", "bags/sample", "--ros-args", "-p", "horizon:=1"]);
    assert!(message.contains("-p horizon:=1: found horizon, expected none"), "{message}");
    assert_eq!(code, Some(1));
    let (code, _) = refused(&["train", "--ros-args", "-r", "a:=b"]);
    assert_eq!(code, Some(2), "only nodes have them");
}

#[test]
fn arguments_of_ros_end_with_two_dashes_and_replay_and_record_take_them() {
    let world = World::new("ros");
    let bag = world.bag();
    let mut record = talking_eddy();
    record.args(["record", "shm:/particles", "--ros-args", "-r"]);
    record.arg(format!("/particles:={}", world.topic("particles")));
    record.args(["--", "--max-messages", "20", "--output", bag.to_str().unwrap()]);
    let mut record = Process::start_until(&mut record, "recording");
    let mut replay = talking_eddy();
    replay.args(["replay", "bags/sample", "--to", "shm", "--wait-for", "1", "--rate", "4"]);
    replay.args(["--ros-args", "-r", &format!("/particles:={}", world.topic("particles"))]);
    replay.args(["-r", "__node:=player", "--log-level", "info"]);
    let mut replay = Process::start(&mut replay);
    assert!(record.wait().success() && replay.wait().success());
    let recorded = BagReader::open(&bag).unwrap();
    let frames_in_bag = recorded.frames(&world.topic("particles")).unwrap().map(Result::unwrap);
    assert!(frames_in_bag.eq(frames()));
}

#[test]
fn a_log_level_is_for_the_node_alone() {
    let world = World::new("ros");
    let mut command =
        world.node(&["--log-level", "eddy_node:=debug", "--log-level", "zenoh:=fatal"]);
    let log = tempfile::NamedTempFile::new().unwrap();
    command.stderr(Stdio::from(log.reopen().unwrap()));
    let mut truth = world.publisher("shm", "particles", ParticleFrame::TYPE);
    let mut node = Process::start_until(&mut command, "predicting");
    for frame in [&frames()[0], &frames()[0]] {
        truth.publish_frame(frame).unwrap();
    }
    let written = || fs::read_to_string(log.path()).unwrap();
    wait_for("a frame is rejected twice", || written().contains("frame rejected").then_some(()));
    node.interrupt();
    assert!(node.wait().success());
    // Colours of a terminal apart.
    assert!(written().contains("DEBUG"), "{}", written());
}

fn tell(clock: &mut dyn Publisher, time: Duration) {
    let stamp = Stamp(i64::try_from(time.as_nanos()).unwrap());
    clock.publish_cdr(&cdr::encode(&Clock { clock: stamp.into() })).unwrap();
}

#[test]
fn a_free_run_on_simulated_time_goes_with_the_clock_and_pauses_with_it() {
    const OBSERVED: usize = 12;
    let world = World::new("ros");
    let mut predictions = world.subscriber("shm", "prediction", ParticleFrame::TYPE);
    let mut truth = world.publisher("shm", "particles", ParticleFrame::TYPE);
    let mut clock = world.publisher("shm", "clock", Clock::TYPE);
    let observed = format!("free_run:={OBSERVED}");
    let mut node = world.start(&["-p", "use_sim_time:=true", "-p", &observed]);
    wait_for("the node reads the clock", || (clock.subscribers() == 1).then_some(()));
    for frame in frames().iter().take(OBSERVED) {
        truth.publish_frame(frame).unwrap();
    }
    let mut next = |patience| -> Option<u64> {
        let payload = predictions.receive(patience).unwrap()?;
        Some(payload.into_frame().unwrap().sequence)
    };
    let last = OBSERVED as u64 - 1;
    while next(DEADLINE).unwrap() < last {}
    let pause = Duration::from_millis(300);
    assert_eq!(next(pause), None, "no time has arrived yet");
    // The first time that is told is no time that has passed, however late it is.
    let start = Duration::from_secs(1_700_000_000);
    tell(&mut *clock, start);
    assert_eq!(next(pause), None, "no time has passed yet");
    tell(&mut *clock, start + DT);
    assert_eq!(next(DEADLINE), Some(last + 1));
    assert_eq!(next(pause), None, "the clock is paused");
    tell(&mut *clock, start + 3 * DT);
    assert_eq!([next(DEADLINE), next(DEADLINE)], [Some(last + 2), Some(last + 3)]);
    assert_eq!(next(pause), None);
    // A bag that begins anew: the next frame is due an interval later.
    tell(&mut *clock, Duration::from_secs(5));
    assert_eq!(next(pause), None);
    tell(&mut *clock, Duration::from_secs(5) + DT);
    assert_eq!(next(DEADLINE), Some(last + 4));
    node.interrupt();
    assert!(node.wait().success());
}

#[test]
fn beside_a_replay_at_half_the_rate_a_free_run_goes_half_as_fast() {
    const RATE: f64 = 0.5;
    let world = World::new("ros");
    simulate(world.folder.path(), 1, 3.0);
    let bag = world.folder.path().join("scene_0000").display().to_string();
    let mut predictions = world.subscriber("shm", "prediction", ParticleFrame::TYPE);
    let mut node = world.start(&["-p", "use_sim_time:=true", "-p", "free_run:=10"]);
    let mut replay = talking_eddy();
    replay.args(["replay", &bag, "--to", "shm", "--wait-for", "1", "--clock", "100"]);
    replay.args(["--rate", &RATE.to_string(), "--ros-args"]);
    for name in ["particles", "clock"] {
        replay.args(["-r", &format!("/{name}:={}", world.topic(name))]);
    }
    let mut replay = Process::start(&mut replay);
    let mut receive = |patience| -> Option<(Instant, u64)> {
        let payload = predictions.receive(patience).unwrap()?;
        Some((Instant::now(), payload.into_frame().unwrap().sequence))
    };
    let mut ticks = vec![receive(DEADLINE).expect("the first prediction")];
    // Until the replay has ended, and its clock with it.
    while let Some(tick) = receive(Duration::from_secs(2)) {
        ticks.push(tick);
    }
    assert!(replay.wait().success());
    // The middle half: neither the observed frames nor the end of the clock.
    let (first, last) = (ticks[ticks.len() / 4], ticks[ticks.len() * 3 / 4]);
    let wall = (last.0 - first.0).as_secs_f64();
    let simulated = (last.1 - first.1) as f64 * DT.as_secs_f64();
    println!("{} ticks, {simulated:.3} s of simulated time in {wall:.3} s", ticks.len());
    assert!(ticks.len() > 50, "{}", ticks.len());
    assert!((0.4..0.6).contains(&(simulated / wall)), "{simulated} s in {wall} s");
    node.interrupt();
    assert!(node.wait().success());
}

#[test]
fn clouds_hold_the_points_of_the_frames_they_stand_beside() {
    let world = World::new("ros");
    let mut observed = world.subscriber("shm", "particles/cloud", PointCloud2::TYPE);
    let mut predicted = world.subscriber("shm", "prediction/cloud", PointCloud2::TYPE);
    let mut predictions = world.subscriber("shm", "prediction", ParticleFrame::TYPE);
    let mut truth = world.publisher("shm", "particles", ParticleFrame::TYPE);
    let mut node = world.start(&["-p", "cloud:=true"]);
    let frames = frames();
    for frame in frames.iter().take(15) {
        truth.publish_frame(frame).unwrap();
    }
    for frame in frames.iter().take(10) {
        let bytes = observed.receive(DEADLINE).unwrap().unwrap().into_cdr();
        assert!(bytes == cloud::to_cdr(frame), "frame {}", frame.sequence);
    }
    for _ in 0..3 {
        let frame = predictions.receive(DEADLINE).unwrap().unwrap().into_frame().unwrap();
        let cloud: PointCloud2 = receive(&mut *predicted);
        assert_eq!(cloud.width as usize, frame.len());
        assert!(cdr::encode(&cloud) == cloud::to_cdr(&frame), "frame {}", frame.sequence);
    }
    node.interrupt();
    assert!(node.wait().success());
}

#[test]
fn there_are_no_clouds_unless_they_are_asked_for() {
    let world = World::new("ros");
    let mut node = world.start(&[]);
    let topics = world.transports.topics(world.link("shm", "particles").transport).unwrap();
    let ours: Vec<_> = topics
        .iter()
        .map(|seen| seen.link.topic.as_str())
        .filter(|topic| topic.starts_with(&world.prefix))
        .collect();
    assert!(ours.contains(&world.topic("prediction").as_str()), "{ours:?}");
    assert!(!ours.iter().any(|topic| topic.ends_with("/cloud")), "{ours:?}");
    node.interrupt();
    assert!(node.wait().success());
}

#[test]
fn what_is_set_is_told_on_parameter_events_and_simulated_time_can_be_switched_on() {
    let transports = Transports::new(TransportOptions::new("eddy_test"));
    let publish = |topic: &str, kind: &str| {
        transports.publisher(&Link::memory(topic), kind, Reliability::Block).unwrap()
    };
    let listen =
        |topic: &str, kind: &str| transports.subscriber(&Link::memory(topic), kind).unwrap();
    let surrogate = Surrogate::load(&Checkpoint::shipped().unwrap(), None).unwrap();
    let mut node = SurrogateNode::new(surrogate, NodeSettings::default()).unwrap();
    let mut input = listen("/particles", ParticleFrame::TYPE);
    let mut events = listen("/parameter_events", ParameterEvent::TYPE);
    let mut diagnostics = listen("/diagnostics", DiagnosticArray::TYPE);
    let mut clock = publish("/clock", Clock::TYPE);
    let mut outputs = [Outputs {
        parameter_events: Some(publish("/parameter_events", ParameterEvent::TYPE)),
        diagnostics: Some(publish("/diagnostics", DiagnosticArray::TYPE)),
        ..Outputs::new(
            publish("/prediction", ParticleFrame::TYPE),
            publish("/prediction/status", PredictionStatus::TYPE),
        )
    }];
    let opener = transports.clone();
    let open = move || opener.subscriber(&Link::memory("/clock"), Clock::TYPE);
    let (queue, handle) = (FrameQueue::new(8, Reliability::Block), Arc::new(NodeHandle::default()));
    let stop = AtomicBool::new(false);
    let of = |name: &str, value| Parameter { name: name.to_owned(), value };
    let time = RosTime::new(Box::new(open));
    let (name, link) = ("/n/eddy_node".to_owned(), Link::memory("/particles"));
    let mut context = NodeContext { name, input: link, time, group: None };
    thread::scope(|scope| {
        scope.spawn(|| {
            let (input, context) = (input.as_mut(), &mut context);
            drive(&mut node, context, input, &mut outputs, &queue, &handle, &stop).unwrap();
        });
        let set =
            |parameters: Vec<Parameter>| handle.request(NodeRequest::Set(parameters), DEADLINE);
        let both = vec![
            of("horizon", ParameterValue::integer(4)),
            of("use_sim_time", ParameterValue::bool(true)),
        ];
        set(both.clone()).unwrap();
        let event: ParameterEvent = receive(&mut *events);
        assert_eq!((event.node.as_str(), &event.changed_parameters), ("/n/eddy_node", &both));
        assert_eq!(Stamp::from(event.stamp), Stamp(0), "no time has arrived yet");
        set(vec![of("horizon", ParameterValue::integer(0))]).unwrap_err();
        wait_for("the node reads the clock", || (clock.subscribers() == 1).then_some(()));
        tell(&mut *clock, Duration::from_secs(42));
        wait_for("diagnostics have the simulated time", || {
            let report: DiagnosticArray = receive(&mut *diagnostics);
            (report.header.stamp.sec == 42).then_some(())
        });
        set(vec![of("use_sim_time", ParameterValue::bool(false))]).unwrap();
        let event: ParameterEvent = receive(&mut *events);
        assert_eq!(event.changed_parameters.len(), 1, "rejected parameters are not announced");
        assert!(event.stamp.sec > 1_000_000_000, "system time again");
        stop.store(true, Ordering::Relaxed);
    });
}
