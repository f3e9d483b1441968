//! Frames with poses, without transport and clock.

use std::time::Duration;

use eddy_frames::{
    Stamp,
    tool::{Contact, Outline, ToolFrame},
};
use eddy_messages::{
    Header, Point, Pose, PoseStamped, Quaternion, TFMessage, Transform, TransformStamped, Vector3,
};
use proptest::prelude::*;

use super::{FollowedTool, FramePlace, ToolFollower, ToolsFile};

const WAIT: Duration = Duration::from_millis(100);
const START: Duration = Duration::from_secs(5);

fn disc(name: &str, pose: Option<&str>, frame: Option<&str>) -> FollowedTool {
    FollowedTool {
        name: name.into(),
        shape: Outline::Disc { radius: 0.1 },
        contact: Contact::Slip,
        pose: pose.map(str::to_owned),
        frame: frame.map(str::to_owned),
        parent: "world".into(),
    }
}

fn follower(tools: Vec<FollowedTool>) -> ToolFollower {
    ToolFollower::new(&ToolsFile { tools }, WAIT).unwrap()
}

/// Of a cup whose poses are on `/cup`.
fn cup() -> ToolFollower {
    follower(vec![disc("cup", Some("/cup"), None)])
}

fn stamp(milliseconds: i64) -> Stamp {
    Stamp(1_000_000 * milliseconds)
}

fn place(sequence: u64, milliseconds: i64) -> FramePlace {
    FramePlace { stream: 7, sequence, stamp: stamp(milliseconds) }
}

fn turned(angle: f64) -> Quaternion {
    let (z, w) = libm::sincos(0.5 * angle);
    Quaternion { x: 0.0, y: 0.0, z, w }
}

fn pose(milliseconds: i64, x: f64, angle: f64) -> PoseStamped {
    let position = Point { x, y: 0.5, z: 0.0 };
    let pose = Pose { position, orientation: turned(angle) };
    PoseStamped { header: Header::world(stamp(milliseconds)), pose }
}

fn transforms(names: [&str; 2], milliseconds: i64, x: f64, angle: f64) -> TFMessage {
    let translation = Vector3 { x, y: 0.25, z: 0.0 };
    let header = Header { stamp: stamp(milliseconds).into(), frame_id: names[0].into() };
    let transform = Transform { translation, rotation: turned(angle) };
    let child_frame_id = names[1].into();
    TFMessage { transforms: vec![TransformStamped { header, child_frame_id, transform }] }
}

/// x, angle, velocity along x and spin of the first tool.
fn first(frame: &ToolFrame) -> [f64; 4] {
    let state = frame.states[0];
    let numbers = [state.pose.position[0], state.pose.angle, state.velocity[0], state.spin];
    numbers.map(|number| (f64::from(number) * 1e5).round() / 1e5)
}

#[test]
fn a_frame_has_the_pose_between_those_before_and_after_it() {
    let mut cup = cup();
    cup.on_frame(place(3, 25), START);
    cup.on_pose("/cup", &pose(0, 0.0, 3.0), START);
    assert_eq!(cup.due(START), [], "the next pose is waited for");
    cup.on_pose("/other", &pose(100, 9.0, 0.0), START);
    cup.on_pose("/cup", &pose(100, 0.4, -3.0), START);
    let frames = cup.due(START);
    assert_eq!(frames.len(), 1);
    let ToolFrame { stream, sequence, stamp: at, wrenches, .. } = &frames[0];
    assert_eq!((*stream, *sequence, *at, wrenches.len()), (7, 3, stamp(25), 0));
    // The shorter way is over half a turn: 0.28319 rad, of which a quarter has passed.
    assert_eq!(first(&frames[0]), [0.1, 3.0708, 4.0, 2.83185]);
    assert_eq!(cup.tools(7).tools[0].name, "cup");
    assert_eq!(cup.warnings(), [""; 0]);
}

#[test]
fn the_last_pose_is_held_with_one_warning_until_the_next_comes() {
    let mut cup = cup();
    cup.on_pose("/cup", &pose(0, 0.0, 0.0), START);
    cup.on_pose("/cup", &pose(10, 0.1, 0.0), START);
    cup.on_frame(place(0, 20), START);
    cup.on_frame(place(1, 30), START + WAIT / 2);
    assert_eq!(cup.next_due(), Some(START + WAIT));
    assert_eq!(cup.due(START + WAIT - Duration::from_nanos(1)), []);
    let held = cup.due(START + WAIT);
    assert_eq!((held.len(), first(&held[0])), (1, [0.1, 0.0, 0.0, 0.0]));
    assert_eq!(
        cup.warnings(),
        ["tool \"cup\" on /cup: header.stamp: found a last pose at 0.01 s, which is held, \
          expected one at or after the frame's 0.02 s"]
    );
    assert_eq!(cup.due(START + 2 * WAIT).len(), 1);
    assert_eq!(cup.warnings(), [""; 0]);
    let later = START + Duration::from_secs(60);
    cup.on_pose("/cup", &pose(50, 0.5, 0.0), later);
    cup.on_frame(place(2, 40), later);
    assert_eq!(first(&cup.due(later)[0]), [0.4, 0.0, 10.0, 0.0]);
    cup.on_frame(place(3, 60), later);
    assert_eq!((cup.due(later + WAIT).len(), cup.warnings().len()), (1, 1), "again");
    let counts = cup.counts();
    assert_eq!((counts.frames, counts.published, counts.held), (4, 4, 3));
}

#[test]
fn without_poses_frames_have_no_tools_and_one_warning_says_what_is_missing() {
    let mut both =
        follower(vec![disc("cup", Some("/cup"), None), disc("blade", None, Some("blade_link"))]);
    let base = transforms(["base", "blade_link"], 0, 0.0, 0.0);
    both.on_transforms(&base, false, START);
    for sequence in 0..3 {
        both.on_frame(place(sequence, 16), START);
    }
    assert_eq!(both.due(START + WAIT), []);
    assert_eq!(
        both.warnings(),
        [
            "tool \"cup\" on /cup: pose: found no pose yet, expected a geometry_msgs/msg/PoseStamped: the frame has \
             no tools",
            "tool \"blade\" in blade_link: pose: found only blade_link, base (each in the next), expected transforms \
             of blade_link to world: the frame has no tools"
        ]
    );
    // Poses of another clock.
    let mut cup = cup();
    cup.on_pose("/cup", &pose(1_700_000_000_000, 0.0, 0.0), START);
    cup.on_frame(place(0, 500), START);
    assert_eq!(cup.due(START + WAIT), []);
    assert_eq!(
        cup.warnings(),
        [
            "tool \"cup\" on /cup: header.stamp: found a first pose at 1700000000 s, expected one before the frame's \
          0.5 s: the frame has no tools"
        ]
    );
}

#[test]
fn chains_of_transforms_are_followed_in_space_and_end_in_the_plane() {
    let mut cup = follower(vec![disc("cup", None, Some("cup_link"))]);
    // An arm that lies on its side, and a cup that is upright again.
    let quarter = std::f64::consts::FRAC_1_SQRT_2;
    let on_its_side = Quaternion { x: quarter, y: 0.0, z: 0.0, w: quarter };
    let upright = Quaternion { x: -quarter, ..on_its_side };
    for milliseconds in [0, 100] {
        let x = 0.01 * milliseconds as f64;
        let mut base = transforms(["world", "base"], milliseconds, x, 0.0);
        base.transforms[0].transform.rotation = on_its_side;
        base.transforms[0].transform.translation.z = 0.5;
        cup.on_transforms(&base, false, START);
    }
    let mut link = transforms(["base", "cup_link"], 0, 0.25, 0.0);
    link.transforms[0].transform.translation.y = -0.5;
    link.transforms[0].transform.rotation = upright;
    cup.on_transforms(&link, true, START);
    cup.on_frame(place(0, 50), START);
    // y of the base is z of the world: -0.5 + 0.5 is in the plane.
    assert_eq!(first(&cup.due(START)[0]), [0.75, 0.0, 10.0, 0.0]);
    link.transforms[0].transform.translation.y = 0.5;
    cup.on_transforms(&link, true, START);
    cup.on_frame(place(1, 60), START);
    assert_eq!(cup.due(START), []);
    let warnings = cup.warnings();
    assert_eq!(warnings.len(), 1, "{warnings:?}");
    let expected = "tool \"cup\" in cup_link: pose.position: found 1 out of the plane, expected 0";
    assert!(warnings[0].starts_with(expected), "{warnings:?}");
}

#[test]
fn poses_that_cannot_be_used_are_refused_in_one_sentence() {
    type Fault = fn(&mut PoseStamped);
    let cases: [(Fault, &str); 7] = [
        (|m| m.pose.position.z = 0.01, "pose.position: found 0.01 out of the plane, expected 0"),
        (|m| m.pose.orientation.x = 0.01, "pose.orientation: found 0.01 out of the plane"),
        (|m| m.pose.orientation.y = 0.01, "pose.orientation: found 0.01 out of the plane"),
        (|m| m.pose.position.x = f64::NAN, "pose.position: found NaN, expected finite numbers"),
        (
            |m| m.pose.orientation = Quaternion::default(),
            "pose.orientation: found a length of 0, expected a quaternion of length 1",
        ),
        (
            |m| m.header.frame_id = "map".into(),
            "header.frame_id: found \"map\", expected \"world\"",
        ),
        (
            |m| m.header.stamp = stamp(-1).into(),
            "header.stamp: found -0.001 s, expected more than 0 s, that of the pose before",
        ),
    ];
    for (fault, expected) in cases {
        let mut cup = cup();
        cup.on_pose("/cup", &pose(0, 0.5, 0.0), START);
        let mut bad = pose(10, 0.6, 0.0);
        fault(&mut bad);
        cup.on_pose("/cup", &bad, START);
        cup.on_pose("/cup", &bad, START);
        let warnings = cup.warnings();
        assert_eq!(warnings.len(), 1, "{warnings:?}");
        let expected = format!("tool \"cup\" on /cup: {expected}");
        assert!(warnings[0].starts_with(&expected), "{warnings:?}, expected {expected}");
        // It goes on without them; what is off by less is in the plane.
        let mut good = pose(20, 0.7, 0.0);
        good.pose.position.z = 0.0009;
        cup.on_pose("/cup", &good, START);
        cup.on_frame(place(0, 10), START);
        assert_eq!(first(&cup.due(START)[0]), [0.6, 0.0, 10.0, 0.0]);
        assert_eq!(cup.counts().refused, 2);
    }
}

#[test]
fn transforms_that_cannot_be_used_are_named_if_a_tool_depends_on_them() {
    let mut cup = follower(vec![disc("cup", None, Some("cup_link"))]);
    cup.on_transforms(&transforms(["base", "cup_link"], 0, 0.0, 0.0), true, START);
    for (child, numbers, expected) in [
        ("base", [f64::NAN, 1.0], "transform.position: found NaN, expected finite numbers"),
        ("base", [0.0, 0.0], "transform.orientation: found a length of 0"),
        ("wheel", [f64::NAN, 1.0], ""),
    ] {
        let mut bad = transforms(["world", child], 5, 0.0, 0.0);
        bad.transforms[0].transform.translation.x = numbers[0];
        bad.transforms[0].transform.rotation.w = numbers[1];
        // Later, so that the warning is not suppressed.
        let now = START + Duration::from_secs(if numbers[1] == 0.0 { 20 } else { 0 });
        cup.on_transforms(&bad, false, now);
        let warnings = cup.warnings();
        if expected.is_empty() {
            assert_eq!(warnings, [""; 0]);
            continue;
        }
        let start = format!("tool \"cup\" in cup_link: transform of \"base\": {expected}");
        assert!(warnings.len() == 1 && warnings[0].starts_with(&start), "{warnings:?}");
    }
}

#[test]
fn waiting_frames_are_bounded() {
    let mut cup = cup();
    cup.on_pose("/cup", &pose(0, 0.5, 0.0), START);
    for sequence in 0..10_000 {
        cup.on_frame(place(sequence, 1), START);
    }
    let held = cup.due(START);
    assert_eq!(held.len(), 10_000 - 4096);
    assert!(held.iter().map(|frame| frame.sequence).eq(0..held.len() as u64), "the oldest");
}

/// A message of one of the topics.
#[derive(Clone, Debug)]
enum Message {
    Frame(FramePlace),
    Pose(PoseStamped),
    Transforms(TFMessage),
    Static(TFMessage),
}

/// The messages of a world, by topic, in the order of each.
fn topics(steps: &[(i64, f64, f64)]) -> [Vec<Message>; 4] {
    let mut times = 0;
    let stamped = steps.iter().map(|&(step, x, angle)| {
        times += step;
        (times, x, angle)
    });
    let stamped: Vec<_> = stamped.collect();
    let tf = |&(at, x, angle): &(i64, f64, f64)| {
        Message::Transforms(transforms(["world", "base"], at, x, 0.5 * angle))
    };
    let frame = |k: i64| Message::Frame(place(k as u64, 16 * k));
    let fixed = transforms(["base", "blade_link"], 0, 0.25, 0.5);
    [
        // None before the first poses.
        ((steps[0].0 + 15) / 16..=times / 16).map(frame).collect(),
        stamped.iter().map(|&(at, x, angle)| Message::Pose(pose(at, x, angle))).collect(),
        stamped.iter().map(tf).collect(),
        vec![Message::Static(fixed)],
    ]
}

/// What comes of messages whose topics are taken in this order, the rest one after the other; all within the wait.
fn followed(topics: &[Vec<Message>; 4], order: &[usize]) -> Vec<ToolFrame> {
    let mut both =
        follower(vec![disc("cup", Some("/cup"), None), disc("blade", None, Some("blade_link"))]);
    let mut rest = topics.clone().map(|messages| messages.into_iter());
    let (mut frames, mut now) = (Vec::new(), START);
    let last = [0, 1, 2, 3].into_iter().flat_map(|topic| vec![topic; topics[topic].len()]);
    for topic in order.iter().copied().chain(last) {
        let Some(message) = rest[topic].next() else { continue };
        now += Duration::from_micros(10);
        match message {
            Message::Frame(place) => both.on_frame(place, now),
            Message::Pose(pose) => both.on_pose("/cup", &pose, now),
            Message::Transforms(tree) => both.on_transforms(&tree, false, now),
            Message::Static(tree) => both.on_transforms(&tree, true, now),
        }
        frames.extend(both.due(now));
    }
    frames.extend(both.finish(now));
    frames
}

proptest! {
    #[test]
    fn the_order_in_which_topics_arrive_does_not_matter(
        steps in prop::collection::vec((1i64..40, -1.0..1.0f64, -3.0..3.0f64), 1..40),
        orders in [prop::collection::vec(0usize..4, 0..200), prop::collection::vec(0usize..4, 0..200)],
    ) {
        let topics = topics(&steps);
        let [one, other] = orders.map(|order| followed(&topics, &order));
        prop_assert_eq!(one.len(), topics[0].len());
        prop_assert_eq!(one, other);
    }
}
