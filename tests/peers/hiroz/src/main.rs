//! Tests a running `eddy node` with hiroz, an independent ROS 2 client library on Zenoh.
//!
//! ```text
//! hiroz_peer TOPIC FRAMES
//! ```
//!
//! Discovers the node and its topics with their types, publishes FRAMES frames on TOPIC/particles and reads the
//! predictions on TOPIC/prediction. The domain is ROS_DOMAIN_ID. Prints one line of JSON; exits with 1 and a message
//! if a check fails.

use std::{
    env,
    process::ExitCode,
    thread,
    time::{Duration, Instant},
};

use hiroz::{
    Builder, MessageTypeInfo,
    context::ZContextBuilder,
    entity::EndpointKind,
    msg::{SerdeCdrSerdes, ZMessage},
};
use serde::{Deserialize, Serialize};

/// Ports on the loopback interface where a router and eddy listen.
const PORTS: std::ops::Range<u16> = 7447..7464;
const TIMEOUT: Duration = Duration::from_secs(60);
/// Number of particles, in rows of `COLUMNS`.
const PARTICLES: usize = 2500;
const COLUMNS: usize = 50;
const SPACING: f32 = 1.0 / 128.0;
const DT: f32 = 0.016;
const GRAVITY: f32 = -9.8;

#[derive(Clone, Debug, Default, Serialize, Deserialize, MessageTypeInfo)]
#[ros_msg(type_name = "builtin_interfaces/msg/Time")]
struct Time {
    sec: i32,
    nanosec: u32,
}

#[derive(Clone, Debug, Default, Serialize, Deserialize, MessageTypeInfo)]
#[ros_msg(type_name = "std_msgs/msg/Header")]
struct Header {
    stamp: Time,
    frame_id: String,
}

#[derive(Clone, Debug, Default, Serialize, Deserialize, MessageTypeInfo)]
#[ros_msg(type_name = "eddy_msgs/msg/ParticleFrame")]
struct ParticleFrame {
    header: Header,
    stream: u64,
    sequence: u64,
    dt: f32,
    lower: Vec<f32>,
    upper: Vec<f32>,
    position: Vec<f32>,
    velocity: Vec<f32>,
    material: Vec<u8>,
}

impl ZMessage for ParticleFrame {
    type Serdes = SerdeCdrSerdes<Self>;
}

/// A block of jelly in free fall, `sequence` frames after its release.
fn frame(sequence: u64) -> ParticleFrame {
    let time = sequence as f32 * DT;
    let nanoseconds = sequence * 16_000_000;
    let (sec, nanosec) =
        ((nanoseconds / 1_000_000_000) as i32, (nanoseconds % 1_000_000_000) as u32);
    let place = |particle: usize| {
        let (column, row) = ((particle % COLUMNS) as f32, (particle / COLUMNS) as f32);
        [0.3 + SPACING * column, 0.5 + SPACING * row + 0.5 * GRAVITY * time * time]
    };
    ParticleFrame {
        header: Header { stamp: Time { sec, nanosec }, frame_id: String::new() },
        stream: 21,
        sequence,
        dt: DT,
        lower: vec![0.0; 2],
        upper: vec![1.0; 2],
        position: (0..PARTICLES).flat_map(place).collect(),
        velocity: (0..PARTICLES).flat_map(|_| [0.0, GRAVITY * time]).collect(),
        material: vec![2; PARTICLES],
    }
}

fn run(topic: &str, frames: u64) -> Result<String, String> {
    let (input, output) = (format!("{topic}/particles"), format!("{topic}/prediction"));
    let failed = |what: &'static str| move |error| format!("{what}: {error}");
    let context = ZContextBuilder::default()
        .disable_multicast_scouting()
        .with_connect_endpoints(PORTS.map(|port| format!("tcp/127.0.0.1:{port}")))
        .with_listen_endpoints(["tcp/127.0.0.1:0"])
        .build()
        .map_err(failed("context"))?;
    let node = context.create_node("hiroz_peer").build().map_err(failed("node"))?;
    let subscriber =
        node.create_sub::<ParticleFrame>(&output).build().map_err(failed("subscriber"))?;
    let publisher =
        node.create_pub::<ParticleFrame>(&input).build().map_err(failed("publisher"))?;

    let deadline = Instant::now() + TIMEOUT;
    let graph = context.graph();
    let of_eddy =
        |kind| graph.get_names_and_types_by_node((String::new(), "eddy_node".to_owned()), kind);
    let is_in = |found: &[(String, String)], name: &str, kind: &str| {
        found.iter().any(|(found, its)| found == name && its == kind)
    };
    loop {
        let (reads, writes) =
            (of_eddy(EndpointKind::Subscription), of_eddy(EndpointKind::Publisher));
        if is_in(&reads, &input, ParticleFrame::type_name())
            && is_in(&writes, &output, ParticleFrame::type_name())
            && is_in(&writes, "/diagnostics", "diagnostic_msgs::msg::dds_::DiagnosticArray_")
        {
            break;
        }
        if Instant::now() > deadline {
            let nodes = graph.get_node_names();
            return Err(format!("nodes: {nodes:?}; eddy_node subscribes to {reads:?} and publishes {writes:?}"));
        }
        thread::sleep(Duration::from_millis(50));
    }
    let found = graph.get_topic_names_and_types();

    let (mut predictions, mut last) = (0, 0);
    for sequence in 0..frames {
        publisher.publish(&frame(sequence)).map_err(failed("publish"))?;
        let patience = if last == 0 { DT * 10.0 } else { DT };
        while let Ok(prediction) = subscriber.recv_timeout(Duration::from_secs_f32(patience)) {
            check(&prediction, last)?;
            (predictions, last) = (predictions + 1, prediction.sequence);
        }
    }
    while last < frames {
        let left = deadline.saturating_duration_since(Instant::now());
        let prediction = subscriber.recv_timeout(left).map_err(failed("the last prediction"))?;
        check(&prediction, last)?;
        (predictions, last) = (predictions + 1, prediction.sequence);
    }
    Ok(format!(
        r#"{{"topics": {}, "predictions": {predictions}, "last_sequence": {last}}}"#,
        found.len()
    ))
}

/// Checks a prediction of the block, which continues to fall freely.
fn check(prediction: &ParticleFrame, last: u64) -> Result<(), String> {
    let expected = frame(prediction.sequence);
    let mean = |frame: &ParticleFrame| {
        let heights = frame.position.iter().skip(1).step_by(2);
        heights.map(|y| f64::from(*y)).sum::<f64>() / PARTICLES as f64
    };
    let (found, expected_mean) = (mean(prediction), mean(&expected));
    let holds = prediction.stream == expected.stream
        && prediction.sequence > last
        && prediction.header.stamp.sec == expected.header.stamp.sec
        && prediction.header.stamp.nanosec.abs_diff(expected.header.stamp.nanosec) < 1000
        && prediction.material == expected.material
        && prediction.position.len() == 2 * PARTICLES
        && (found - expected_mean).abs() < 1e-3;
    if holds {
        return Ok(());
    }
    Err(format!(
        "prediction {} of stream {} after {last}: found its centre at height {found}, expected {expected_mean}",
        prediction.sequence, prediction.stream
    ))
}

fn main() -> ExitCode {
    let arguments: Vec<_> = env::args().skip(1).collect();
    let outcome = match arguments.as_slice() {
        [topic, frames] => match frames.parse() {
            Ok(frames) => run(topic, frames),
            Err(error) => Err(format!("FRAMES: found {frames}: {error}")),
        },
        _ => Err("expected TOPIC FRAMES".to_owned()),
    };
    match outcome {
        Ok(line) => {
            println!("{line}");
            ExitCode::SUCCESS
        }
        Err(reason) => {
            eprintln!("hiroz_peer: {reason}");
            ExitCode::FAILURE
        }
    }
}
