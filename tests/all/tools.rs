//! Tools as users meet them: simulated, recorded, replayed and published on every transport, checked and drawn.

use std::{path::PathBuf, process::Command, time::Duration};

use eddy_bag::{BagReader, BagWriter, RecordedTools, WriterOptions};
use eddy_frames::tool::{Outline, Tools};
use eddy_messages::{FrameCdr, Message, ParticleFrame, ToolDescription, ToolFrame, cdr};
use eddy_transport::Subscriber;

use crate::support::{Process, World, domain, fail, findings, succeed, talking_eddy};

const DEADLINE: Duration = Duration::from_secs(30);
/// Frames of the scenes.
const FRAMES: usize = 12;

/// A bag with a scene in which a blade pushes sand.
fn pushed(world: &World) -> PathBuf {
    pushed_scenes(world, "1").join("scene_0000")
}

/// A directory of bags in which blades push sand, liquid and so on.
fn pushed_scenes(world: &World, scenes: &str) -> PathBuf {
    let output = world.folder.path().join("pushed");
    let path = output.to_str().unwrap();
    let scenes = ["simulate", "--preset", "push", "--scenes", scenes];
    succeed(scenes.into_iter().chain(["--duration", "0.192", "--output", path]));
    output
}

fn tools_of(bag: &BagReader) -> RecordedTools {
    let mut all = bag.tools("/particles").unwrap();
    assert_eq!(all.len(), 1);
    all.remove(&0).unwrap()
}

/// The messages of a topic.
fn messages(bag: &BagReader, topic: &str) -> Vec<Vec<u8>> {
    let all = bag.messages().map(Result::unwrap).filter(|message| *message.topic == *topic);
    all.map(|message| message.data).collect()
}

fn receive(subscriber: &mut dyn Subscriber, count: usize) -> Vec<Vec<u8>> {
    let next = |_| subscriber.receive(DEADLINE).unwrap().expect("a message comes").into_cdr();
    (0..count).map(next).collect()
}

fn program(world: &World) -> Command {
    let mut command = talking_eddy();
    command.env("ZENOH_CONFIG_OVERRIDE", &world.overrides);
    command.env("ROS_DOMAIN_ID", world.domain.to_string());
    command
}

#[test]
fn a_simulated_scene_has_its_tools_at_every_frame() {
    let world = World::new("tools");
    let bag = BagReader::open(&pushed(&world)).unwrap();
    let recorded = tools_of(&bag);
    let Tools { stream, tools } = &recorded.tools;
    assert_eq!((*stream, &*tools[0].name), (0, "blade"));
    assert!(matches!(tools[0].shape, Outline::Rectangle { .. }));
    assert!(recorded.frames.keys().copied().eq(0..FRAMES as u64));
    let frames = bag.frames("/particles").unwrap().map(Result::unwrap);
    for (frame, tools) in frames.zip(recorded.frames.values()) {
        assert_eq!((frame.sequence, frame.stamp), (tools.sequence, tools.stamp));
        assert_eq!(tools.wrenches.len(), usize::from(frame.sequence > 0));
    }
    let description = bag.topics().iter().find(|topic| topic.name == "/tools/description");
    assert_eq!(description.unwrap().kept(), 64, "late subscribers of a replay receive it");
}

#[test]
fn a_replay_publishes_the_tools_of_a_bag_on_every_transport() {
    for transport in ["zenoh", "shm", "dds"] {
        let world = World::in_domain("tools", domain());
        let path = pushed(&world);
        let bag = BagReader::open(&path).unwrap();
        let mut poses = world.subscriber(transport, "tools", ToolFrame::TYPE);
        let mut description =
            world.subscriber(transport, "tools/description", ToolDescription::TYPE);
        let mut player = program(&world);
        player.args(["replay", path.to_str().unwrap(), "--to", transport, "--wait-for", "1"]);
        player.args(["--topics", "/tools/description", "--topics", "/tools", "--remap"]);
        player.arg(format!("/tools/description:={}", world.topic("tools/description")));
        player.args(["--remap", &format!("/tools:={}", world.topic("tools"))]);
        let mut player = Process::start(&mut player);
        let found = std::thread::scope(|scope| {
            let described = scope.spawn(|| receive(&mut *description, 1));
            [receive(&mut *poses, FRAMES), described.join().unwrap()]
        });
        assert!(player.wait().success(), "{transport}");
        let expected = ["/tools", "/tools/description"].map(|topic| messages(&bag, topic));
        assert_eq!(found, expected, "{transport}");
    }
}

#[test]
fn a_live_simulation_publishes_its_tools_also_to_those_who_come_late() {
    for transport in ["zenoh", "shm"] {
        let world = World::new("tools");
        let bag = BagReader::open(&pushed(&world)).unwrap();
        let mut frames = world.subscriber(transport, "particles", ParticleFrame::TYPE);
        let mut poses = world.subscriber(transport, "tools", ToolFrame::TYPE);
        let mut source = program(&world);
        source.args(["simulate", "--preset", "push", "--scenes", "1", "--duration", "0.192"]);
        source.args(["--publish", &world.link(transport, "particles").to_string()]);
        source.args(["--wait-for", "1", "--rate", "0.1"]);
        let mut source = Process::start(&mut source);
        let first = frames.receive(DEADLINE).unwrap().unwrap().into_frame().unwrap();
        assert_eq!(first.sequence, 0);
        let mut description =
            world.subscriber(transport, "tools/description", ToolDescription::TYPE);
        let described = receive(&mut *description, 1);
        assert_eq!(described, messages(&bag, "/tools/description"), "{transport}");
        for _ in 1..FRAMES {
            frames.receive(DEADLINE).unwrap().unwrap();
        }
        assert_eq!(receive(&mut *poses, FRAMES), messages(&bag, "/tools"), "{transport}");
        assert!(source.wait().success(), "{transport}");
    }
}

#[test]
fn a_description_that_changes_is_found_and_the_frames_are_drawn_without_tools() {
    let world = World::new("tools");
    let good = BagReader::open(&pushed(&world)).unwrap();
    let recorded = tools_of(&good);
    let mut bag = BagWriter::create(&world.bag(), WriterOptions::default()).unwrap();
    let frames = bag.topic("/particles", ParticleFrame::TYPE).unwrap();
    let description = bag.topic("/tools/description", ToolDescription::TYPE).unwrap();
    let poses = bag.topic("/tools", ToolFrame::TYPE).unwrap();
    for frame in good.frames("/particles").unwrap().map(Result::unwrap) {
        let mut tools = recorded.tools.clone();
        if frame.sequence > 5 {
            tools.tools[0].shape = Outline::Disc { radius: 0.1 };
        }
        let message = cdr::encode(&ToolDescription::of(&tools, frame.stamp));
        bag.write_stamped(description, frame.stamp, &message).unwrap();
        let at = &recorded.frames[&frame.sequence];
        bag.write_stamped(poses, frame.stamp, &cdr::encode(&ToolFrame::of(at, &tools))).unwrap();
        bag.write_stamped(frames, frame.stamp, &frame.to_cdr()).unwrap();
    }
    bag.finish().unwrap();
    let path = world.bag();
    let expected = "topic /tools/description, message 6: tools: found other tools of stream 0, \
                    expected the description that the stream has begun with";
    let found = findings(&path);
    assert!(found.iter().any(|finding| finding.contains(expected)), "{found:?}");
    let picture = world.folder.path().join("strip.png");
    let render = ["bag", "render", path.to_str().unwrap(), "--output", picture.to_str().unwrap()];
    succeed(render);
    assert!(picture.exists());
}

#[test]
fn tools_are_exported_as_polygons_and_trivial_predictors_know_them() {
    let world = World::new("tools-out");
    // Of liquid: the model does not know sand.
    let bag = pushed_scenes(&world, "2").join("scene_0001");
    let (vtu, report) = (world.folder.path().join("vtu"), world.folder.path().join("report"));
    let [bag, vtu_path, report_path] = [&bag, &vtu, &report].map(|path| path.to_str().unwrap());
    succeed(["bag", "export", bag, "--format", "vtu", "--output", vtu_path]);
    let collection = std::fs::read_to_string(vtu.join("stream_0001.pvd")).unwrap();
    let polygons = |frame: usize| format!("stream_0001/{frame:06}.vtp");
    for frame in 0..FRAMES {
        assert!(collection.contains(&format!("part=\"1\" file=\"{}\"", polygons(frame))));
        let text = std::fs::read_to_string(vtu.join(polygons(frame))).unwrap();
        assert!(text.contains("NumberOfPolys=\"1\"") && text.contains("Name=\"force\""), "{text}");
    }
    succeed([
        "eval",
        "--data",
        bag,
        "--checkpoint",
        "particle-mingru",
        "--horizon",
        "5",
        "--output",
        report_path,
    ]);
    let report = std::fs::read_to_string(report.join("report.json")).unwrap();
    let report: serde_json::Value = serde_json::from_str(&report).unwrap();
    let predictors = report["predictors"].as_array().unwrap();
    let names: Vec<_> = predictors.iter().filter_map(|one| one["name"].as_str()).collect();
    assert!(names.contains(&"carried by the tool"), "{names:?}");
}

#[test]
fn a_scene_whose_tool_cannot_be_is_refused_and_leaves_nothing() {
    let world = World::new("tools");
    let [scene, output] = ["scene.toml", "out"].map(|name| world.folder.path().join(name));
    std::fs::write(
        &scene,
        r#"
        [[bodies]]
        material = "sand"
        shape.rectangle.size = [0.2, 0.2]
        position = [0.5, 0.3]

        [[tools]]
        name = "blade"
        shape.rectangle.size = [0.1, 0.1]
        keyframes = [{ time = 0.0, position = [0.5, 0.3] }]
        "#,
    )
    .unwrap();
    let [scene, path] = [&scene, &output].map(|path| path.to_str().unwrap());
    let said = fail(1, ["simulate", "--scene", scene, "--output", path]);
    assert!(said.contains("tools[0]: found") && said.contains("expected a start beside"), "{said}");
    assert!(!output.exists());
}
