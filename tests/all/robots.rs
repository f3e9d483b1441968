//! Tools of a robot as users follow them: poses on a topic and on /tf, beside frames of particles.

use std::{collections::BTreeMap, fs, process::Command, time::Duration};

use eddy_bag::BagReader;
use eddy_frames::{
    Domain, Frame, Material, Stamp,
    tool::{ToolFrame as Moved, Tools},
};
use eddy_messages::{
    Header, Message, ParticleFrame, Point, Pose, PoseStamped, Quaternion, TFMessage,
    ToolDescription, ToolFrame, Transform, TransformStamped, Vector3, cdr,
};
use eddy_transport::{Publisher, PublisherOptions, Reliability, Subscriber};

use crate::support::{
    DEADLINE, Process, World, fail, findings, free_port, latched, talking_eddy, wait_for,
};

const FILE: &str = r#"
[[tools]]
name = "cup"
shape.polygons.corners = [[[-0.1, -0.1], [0.1, -0.1], [0.1, -0.08], [-0.1, -0.08]]]
contact.friction = 0.3
pose = "cup/pose"

[[tools]]
name = "blade"
shape.rectangle.size = [0.02, 0.3]
frame = "blade_link"
"#;
/// A scene without tools, whose matter is far from where the cup moves.
const SCENE: &str = r#"
[[bodies]]
material = "sand"
shape.rectangle.size = [0.2, 0.1]
position = [0.5, 0.15]
"#;
/// Frames of particles.
const FRAMES: u64 = 12;
/// Time between them (ms).
const FRAME: i64 = 16;
/// Time between poses (ms).
const POSE: i64 = 10;

/// Publishers of a robot and of particles.
struct Robot {
    frames: Box<dyn Publisher>,
    cup: Box<dyn Publisher>,
    tree: Box<dyn Publisher>,
    fixed: Box<dyn Publisher>,
}

fn stamp(milliseconds: i64) -> Stamp {
    Stamp(1_000_000 * milliseconds)
}

fn turned(angle: f64) -> Quaternion {
    let (z, w) = (0.5 * angle).sin_cos();
    Quaternion { x: 0.0, y: 0.0, z, w }
}

fn transforms(names: [&str; 2], at: Stamp, translation: [f64; 2], angle: f64) -> Vec<u8> {
    let [x, y] = translation;
    let transform = Transform { translation: Vector3 { x, y, z: 0.0 }, rotation: turned(angle) };
    let header = Header { frame_id: names[0].into(), ..Header::world(at) };
    let child_frame_id = names[1].into();
    let transforms = vec![TransformStamped { header, child_frame_id, transform }];
    cdr::encode(&TFMessage { transforms })
}

impl Robot {
    fn new(world: &World, transport: &str) -> Self {
        let open = |name, kind| world.publisher(transport, name, kind);
        let options = PublisherOptions { reliability: Reliability::Block, qos: Some(latched(1)) };
        let mut fixed = world
            .transports
            .publisher(&world.link(transport, "tf_static"), TFMessage::TYPE, options)
            .unwrap();
        // Before anyone listens.
        let rest = transforms(["base", "blade_link"], stamp(0), [0.25, 0.0], 0.0);
        fixed.publish_cdr(&rest).unwrap();
        Self {
            frames: open("particles", ParticleFrame::TYPE),
            cup: open("cup/pose", PoseStamped::TYPE),
            tree: open("tf", TFMessage::TYPE),
            fixed,
        }
    }

    /// Waits until all are listened to.
    fn wait(&self, listeners_of_frames: usize) {
        wait_for("the program subscribes", || {
            let all = [&self.cup, &self.tree, &self.fixed];
            let are_heard = all.iter().all(|publisher| publisher.subscribers() == 1);
            (are_heard && self.frames.subscribers() == listeners_of_frames).then_some(())
        });
    }

    fn frame(&mut self, sequence: u64) {
        let domain = Domain { lower: [0.0; 2], upper: [1.0; 2] };
        let (position, velocity) = (vec![[0.5, 0.5]], vec![[0.0; 2]]);
        let frame = Frame {
            stream: 5,
            sequence,
            stamp: stamp(FRAME * sequence as i64),
            dt: 1e-3 * FRAME as f32,
            domain,
            position,
            velocity,
            material: vec![Material::Liquid],
        };
        self.frames.publish_frame(&frame).unwrap();
    }

    /// The cup moves along x by 1/s and turns through half a turn; the base of the blade turns in place.
    fn poses(&mut self, number: i64) {
        let at = POSE * number;
        let seconds = 1e-3 * at as f64;
        let position = Point { x: seconds, y: 0.5, z: 0.0 };
        let pose = Pose { position, orientation: turned(3.0 + seconds) };
        let stamped = PoseStamped { header: Header::world(stamp(at)), pose };
        self.cup.publish_cdr(&cdr::encode(&stamped)).unwrap();
        let base = transforms(["world", "base"], stamp(at), [0.5, 0.5], seconds);
        self.tree.publish_cdr(&base).unwrap();
    }

    /// Publishes frames and poses until after the last frame; the poses come late.
    fn move_tools(&mut self) {
        for sequence in 0..FRAMES {
            self.frame(sequence);
        }
        for number in 0..=FRAME * FRAMES as i64 / POSE {
            self.poses(number);
        }
    }
}

fn program(world: &World, transport: &str, options: &[&str]) -> Command {
    let file = world.folder.path().join("tools.toml");
    fs::write(&file, FILE).unwrap();
    let mut command = talking_eddy();
    command.env("ZENOH_CONFIG_OVERRIDE", &world.overrides);
    command.env("ROS_DOMAIN_ID", world.domain.to_string());
    command.arg("tools").arg(file).args(options);
    command.args(["--input", &format!("{transport}:particles"), "--reliability", "block"]);
    command.args(["--ros-args", "-r", &format!("__ns:={}", world.prefix)]);
    for topic in ["tf", "tf_static"] {
        command.args(["-r", &format!("/{topic}:={topic}")]);
    }
    command
}

fn receive<M: Message>(subscriber: &mut dyn Subscriber) -> M {
    let payload = subscriber.receive(DEADLINE).unwrap().expect("a message comes");
    cdr::decode(&payload.into_cdr()).unwrap()
}

/// Checks the tools of all frames.
fn are_followed(frames: &[Moved]) {
    assert!(frames.iter().map(|frame| frame.sequence).eq(0..FRAMES));
    for frame in frames {
        assert_eq!(frame.stamp, stamp(FRAME * frame.sequence as i64));
        assert!(frame.wrenches.is_empty());
        let (seconds, is_moving) = (frame.stamp.seconds(), f64::from(frame.sequence > 0));
        let angle = (3.0 + seconds + std::f64::consts::PI).rem_euclid(std::f64::consts::TAU)
            - std::f64::consts::PI;
        let (sin, cos) = seconds.sin_cos();
        // The base turns about its origin, a quarter of a length from the blade.
        let blade = [0.5 + 0.25 * cos, 0.5 + 0.25 * sin, seconds, -0.25 * sin, 0.25 * cos, 1.0];
        let cup = [seconds, 0.5, angle, 1.0, 0.0, 1.0];
        for (state, expected) in frame.states.iter().zip([cup, blade]) {
            let ([x, y], [u, v]) = (state.pose.position, state.velocity);
            let found = [x, y, state.pose.angle, u, v, state.spin].map(f64::from);
            for (k, (found, expected)) in found.into_iter().zip(expected).enumerate() {
                let expected = if k < 3 { expected } else { is_moving * expected };
                assert!((found - expected).abs() < 1e-4, "{frame:?}: {found}, not {expected}");
            }
        }
    }
}

#[test]
fn tools_of_a_robot_are_published_beside_its_particles_and_recorded() {
    let world = World::new("robots");
    let mut robot = Robot::new(&world, "zenoh");
    let mut poses = world.subscriber("zenoh", "tools", ToolFrame::TYPE);
    let mut follower =
        Process::start_until(&mut program(&world, "zenoh", &["--wait", "60"]), "2 tools");
    let (bag, port) = (world.bag(), free_port());
    let mut recorder = talking_eddy();
    let override_ = format!(
        r#"listen/endpoints=["tcp/127.0.0.1:{port}"];connect/endpoints=["tcp/127.0.0.1:{}"]"#,
        world.port
    );
    recorder.env("ZENOH_CONFIG_OVERRIDE", override_).arg("record");
    let topics = ["particles", "tools", "tools/description"];
    recorder.args(topics.map(|name| world.link("zenoh", name).to_string()));
    recorder.args(["--max-messages", &(2 * FRAMES + 1).to_string(), "--output"]).arg(&bag);
    let mut recorder = Process::start(&mut recorder);
    for _ in topics {
        recorder.line("recording zenoh:");
    }
    robot.wait(2);
    robot.move_tools();
    let received: Vec<ToolFrame> = (0..FRAMES).map(|_| receive(&mut *poses)).collect();
    // Those who come late know what the tools are, too.
    let mut description = world.subscriber("zenoh", "tools/description", ToolDescription::TYPE);
    let tools = receive::<ToolDescription>(&mut *description).checked().unwrap();
    assert!(tools.tools.iter().map(|tool| &*tool.name).eq(["cup", "blade"]));
    assert_eq!(tools.stream, 5);
    let frames: Vec<_> = received.iter().map(|frame| frame.checked(&tools).unwrap()).collect();
    are_followed(&frames);

    assert!(recorder.wait().success());
    assert_eq!(findings(&bag), [""; 0]);
    let recorded = BagReader::open(&bag).unwrap().tools(&world.topic("particles")).unwrap();
    assert_eq!(recorded[&5].tools, tools);
    assert!(recorded[&5].frames.values().eq(&frames));
    follower.interrupt();
    assert!(follower.wait().success());
    let rest = follower.rest();
    let summary = "12 frames, 0 with a held pose, 0 without tools; 0 messages refused";
    assert!(rest.contains(summary), "{rest}");
}

#[test]
fn tools_are_followed_on_dds_and_in_shared_memory() {
    for transport in ["dds", "shm"] {
        let world = World::in_domain("robots", crate::support::domain());
        let mut robot = Robot::new(&world, transport);
        let mut poses = world.subscriber(transport, "tools", ToolFrame::TYPE);
        let mut description =
            world.subscriber(transport, "tools/description", ToolDescription::TYPE);
        let mut program = program(&world, transport, &["--wait", "60"]);
        let _follower = Process::start_until(&mut program, "2 tools");
        robot.wait(1);
        if transport == "shm" {
            // Shared memory keeps nothing for those who come late.
            let rest = transforms(["base", "blade_link"], stamp(0), [0.25, 0.0], 0.0);
            robot.fixed.publish_cdr(&rest).unwrap();
        }
        // Until the program has found those who listen to it; a repeated pose changes nothing.
        wait_for("the first tools come", || {
            robot.frame(0);
            robot.poses(0);
            poses.receive(Duration::from_millis(100)).unwrap()
        });
        robot.move_tools();
        let tools = receive::<ToolDescription>(&mut *description).checked().unwrap();
        let mut frames = BTreeMap::new();
        while frames.len() < FRAMES as usize {
            let frame = receive::<ToolFrame>(&mut *poses).checked(&tools).unwrap();
            frames.insert(frame.sequence, frame);
        }
        are_followed(&frames.into_values().collect::<Vec<_>>());
    }
}

#[test]
fn a_robot_that_falls_silent_or_lies_is_named_and_the_program_stays_up() {
    let world = World::new("robots");
    let mut robot = Robot::new(&world, "zenoh");
    let mut poses = world.subscriber("zenoh", "tools", ToolFrame::TYPE);
    let log = world.folder.path().join("log");
    let mut program = program(&world, "zenoh", &["--wait", "0.2"]);
    let mut follower =
        Process::start_until(program.stderr(fs::File::create(&log).unwrap()), "2 tools");
    robot.wait(1);
    let said = |sentence: &str| {
        wait_for(sentence, || fs::read_to_string(&log).unwrap().contains(sentence).then_some(()));
    };
    robot.frame(0);
    said("tool \"cup\" on ");
    said("pose: found no pose yet, expected a geometry_msgs/msg/PoseStamped");
    said("tool \"blade\" in blade_link: pose: found only blade_link, base (each in the next)");
    robot.cup.publish_cdr(&[0, 1, 0, 0, 7]).unwrap();
    said("cup/pose: CDR body of 1 bytes is not a PoseStamped");
    robot.poses(0);
    robot.frame(1);
    assert_eq!(receive::<ToolFrame>(&mut *poses).sequence, 1);
    said("found a last pose at 0 s, which is held, expected one at or after the frame's 0.016 s");
    let mut elsewhere = PoseStamped { header: Header::world(stamp(POSE)), pose: Pose::default() };
    elsewhere.header.frame_id = "map".into();
    robot.cup.publish_cdr(&cdr::encode(&elsewhere)).unwrap();
    said("header.frame_id: found \"map\", expected \"world\"");
    for number in 1..=4 {
        robot.poses(number);
    }
    robot.frame(2);
    let found = receive::<ToolFrame>(&mut *poses);
    assert_eq!((found.sequence, found.twists[0].angular.z as f32), (2, 1.0));
    follower.interrupt();
    assert!(follower.wait().success());
    let log = fs::read_to_string(&log).unwrap();
    assert_eq!(log.matches("which is held").count(), 2, "once for each tool: {log}");
}

#[test]
fn a_file_of_tools_that_cannot_be_used_is_refused() {
    let world = World::new("robots");
    let file = world.folder.path().join("tools.toml");
    for (text, expected) in [
        (FILE.replace("frame = \"blade_link\"", ""), "tools[1]: found no pose and no frame"),
        (FILE.replace("frame =", "fram ="), "did you mean"),
        (FILE.replace("size = [0.02", "size = [-1"), "tools[1].shape.rectangle.size: found -1"),
        (FILE.replace("cup/pose", "/cup//pose"), "tools[0].pose: found \"/cup//pose\", expected"),
    ] {
        fs::write(&file, text).unwrap();
        let said = fail(1, ["tools", file.to_str().unwrap()]);
        assert!(said.contains("tools.toml") && said.contains(expected), "{said}");
    }
}

/// The tools that a live source has published so far, by the number of their frame.
fn next_tools(poses: &mut dyn Subscriber, tools: &Tools) -> Moved {
    receive::<ToolFrame>(poses).checked(tools).unwrap()
}

#[test]
fn a_live_simulation_has_the_tools_of_a_robot() {
    let world = World::new("robots");
    let mut poses = world.subscriber("zenoh", "tools", ToolFrame::TYPE);
    let mut description = world.subscriber("zenoh", "tools/description", ToolDescription::TYPE);
    let mut cup = world.publisher("zenoh", "cup/pose", PoseStamped::TYPE);
    let [scene, file] = ["scene.toml", "tools.toml"].map(|name| world.folder.path().join(name));
    fs::write(&scene, SCENE).unwrap();
    let topic = world.topic("cup/pose");
    fs::write(
        &file,
        format!("[[tools]]\nname = \"cup\"\nshape.disc.radius = 0.05\npose = {topic:?}"),
    )
    .unwrap();
    let mut program = talking_eddy();
    program.env("ZENOH_CONFIG_OVERRIDE", &world.overrides).arg("simulate");
    program.arg("--scene").arg(&scene).arg("--tools").arg(&file);
    let link = world.link("zenoh", "particles").to_string();
    program.args(["--duration", "600", "--reliability", "drop", "--publish", &link]);
    let log = world.folder.path().join("log");
    let mut source =
        Process::start_until(program.stderr(fs::File::create(&log).unwrap()), "publishing on");
    let mut publish = |x: f64, z: f64, angle: f64| {
        let position = Point { x, y: 0.7, z };
        let pose = Pose { position, orientation: turned(angle) };
        let header = Header::world(Stamp((1e9 * (x + z)) as i64));
        cup.publish_cdr(&cdr::encode(&PoseStamped { header, pose })).unwrap();
    };
    // It begins with the first pose, whenever that comes.
    wait_for("the pose is waited for", || {
        fs::read_to_string(&log).unwrap().contains("found no pose yet, expected").then_some(())
    });
    publish(0.3, 0.0, 3.1);
    let tools = receive::<ToolDescription>(&mut *description).checked().unwrap();
    let first = next_tools(&mut *poses, &tools);
    assert_eq!((first.sequence, first.states[0].pose.position), (0, [0.3, 0.7]));
    publish(0.31, 0.0, -3.1);
    let mut reach = |x: f32| {
        wait_for("the cup is there", || {
            let frame = next_tools(&mut *poses, &tools);
            (frame.states[0].pose.position == [x, 0.7]).then_some(frame)
        })
    };
    let arrived = reach(0.31);
    assert_eq!(arrived.wrenches.len(), 1, "the wrench of the tool is published");
    let spin = f64::from(arrived.states[0].spin);
    assert!((spin * 0.016 - (std::f64::consts::TAU - 6.2)).abs() < 1e-3, "the shorter way: {spin}");
    // Out of the plane it rests, and goes on with the next pose.
    publish(0.32, 0.5, 0.0);
    wait_for("the pose is refused", || {
        let log = fs::read_to_string(&log).unwrap();
        log.contains("found 0.5 out of the plane").then_some(())
    });
    publish(0.93, 0.0, -3.1);
    reach(0.93);
    source.interrupt();
    assert!(source.wait().success());
}
