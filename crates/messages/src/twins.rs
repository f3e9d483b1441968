//! One struct a message, with the fields of its `.msg` file in the same order.

use serde::{Deserialize, Serialize};

use super::{Message, services::Parameter};
use eddy_frames::Stamp;

/// Nanoseconds in a second.
const NANOSECONDS: i64 = 1_000_000_000;

/// `builtin_interfaces/msg/Time`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Time {
    /// Whole seconds.
    pub sec: i32,
    /// Nanoseconds past them, below 1e9.
    pub nanosec: u32,
}

impl From<Stamp> for Time {
    /// Saturates at the ends of `sec`: about 68 years.
    fn from(stamp: Stamp) -> Self {
        let limit = i64::from(i32::MAX) * NANOSECONDS + (NANOSECONDS - 1);
        let clamped = stamp.0.clamp(i64::from(i32::MIN) * NANOSECONDS, limit);
        Self {
            sec: clamped.div_euclid(NANOSECONDS) as i32,
            nanosec: clamped.rem_euclid(NANOSECONDS) as u32,
        }
    }
}

impl From<Time> for Stamp {
    fn from(time: Time) -> Self {
        Self(i64::from(time.sec) * NANOSECONDS + i64::from(time.nanosec))
    }
}

/// `std_msgs/msg/Header`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Header {
    /// Simulation time.
    pub stamp: Time,
    /// Coordinate frame: `world` in everything eddy writes.
    pub frame_id: String,
}

impl Header {
    /// A header in the frame `world`.
    pub fn world(stamp: Stamp) -> Self {
        Self { stamp: stamp.into(), frame_id: "world".to_owned() }
    }
}

/// `std_msgs/msg/String`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct RosString {
    /// The text.
    pub data: String,
}

impl Message for RosString {
    const TYPE: &'static str = "std_msgs/msg/String";
}

/// `rosgraph_msgs/msg/Clock`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Clock {
    /// Simulation time.
    pub clock: Time,
}

impl Message for Clock {
    const TYPE: &'static str = "rosgraph_msgs/msg/Clock";
}

/// `eddy_msgs/msg/ParticleFrame`, as it travels: unchecked. [`eddy_frames::Frame`] is its checked form.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ParticleFrame {
    /// Stamp and coordinate frame.
    pub header: Header,
    /// Which trajectory.
    pub stream: u64,
    /// Consecutive number within the stream.
    pub sequence: u64,
    /// Time between two frames (s).
    pub dt: f32,
    /// Domain corner, `[D]`.
    pub lower: Vec<f32>,
    /// Opposite domain corner, `[D]`.
    pub upper: Vec<f32>,
    /// Positions, `[N * D]`, interleaved (domain lengths).
    pub position: Vec<f32>,
    /// Velocities, `[N * D]`, interleaved (domain lengths per second).
    pub velocity: Vec<f32>,
    /// Material numbers, `[N]`.
    pub material: Vec<u8>,
}

impl Message for ParticleFrame {
    const TYPE: &'static str = "eddy_msgs/msg/ParticleFrame";
}

/// What a node does with a stream; the numbers are those of `eddy_msgs/msg/PredictionStatus`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum StreamState {
    /// Frames are observed, nothing is published yet.
    WarmingUp = 0,
    /// Every observed frame is followed by its prediction.
    Tracking = 1,
    /// The model is fed with its own output.
    FreeRunning = 2,
}

/// `eddy_msgs/msg/PredictionStatus`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PredictionStatus {
    /// Stamp of the predicted instant, coordinate frame.
    pub header: Header,
    /// Which trajectory.
    pub stream: u64,
    /// Sequence of the last observed frame.
    pub source_sequence: u64,
    /// Frames predicted ahead of it.
    pub horizon: u32,
    /// A [`StreamState`] as its number.
    pub state: u8,
    /// From the frame's arrival to the prediction's publication (s).
    pub latency: f32,
    /// Digest of the checkpoint.
    pub model: String,
}

impl Message for PredictionStatus {
    const TYPE: &'static str = "eddy_msgs/msg/PredictionStatus";
}

/// `diagnostic_msgs/msg/KeyValue`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct KeyValue {
    /// What is reported.
    pub key: String,
    /// Its value, with the unit.
    pub value: String,
}

/// `diagnostic_msgs/msg/DiagnosticStatus`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct DiagnosticStatus {
    /// 0 OK, 1 WARN, 2 ERROR, 3 STALE.
    pub level: u8,
    /// Who reports.
    pub name: String,
    /// In a sentence.
    pub message: String,
    /// Which device: unused, empty.
    pub hardware_id: String,
    /// The details.
    pub values: Vec<KeyValue>,
}

/// `diagnostic_msgs/msg/DiagnosticArray`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct DiagnosticArray {
    /// Wall-clock stamp.
    pub header: Header,
    /// One entry a reporter.
    pub status: Vec<DiagnosticStatus>,
}

impl Message for DiagnosticArray {
    const TYPE: &'static str = "diagnostic_msgs/msg/DiagnosticArray";
}

/// `rcl_interfaces/msg/ParameterEvent`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ParameterEvent {
    /// When it happened.
    pub stamp: Time,
    /// Full name of the node.
    pub node: String,
    /// Parameters it did not have before.
    pub new_parameters: Vec<Parameter>,
    /// Parameters that were set.
    pub changed_parameters: Vec<Parameter>,
    /// Parameters it has no more.
    pub deleted_parameters: Vec<Parameter>,
}

impl Message for ParameterEvent {
    const TYPE: &'static str = "rcl_interfaces/msg/ParameterEvent";
}

/// `sensor_msgs/msg/PointField`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct PointField {
    /// What it is, such as `x`.
    pub name: String,
    /// Where it begins in a point (bytes).
    pub offset: u32,
    /// 2 for `uint8`, 7 for `float32`.
    pub datatype: u8,
    /// How many there are.
    pub count: u32,
}

/// `sensor_msgs/msg/PointCloud2`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct PointCloud2 {
    /// Stamp and coordinate frame.
    pub header: Header,
    /// Rows; 1 for points in no order.
    pub height: u32,
    /// Points of a row.
    pub width: u32,
    /// What a point holds.
    pub fields: Vec<PointField>,
    /// Whether the most significant byte comes first.
    pub is_bigendian: bool,
    /// Length of a point (bytes).
    pub point_step: u32,
    /// Length of a row (bytes).
    pub row_step: u32,
    /// The points, `[height * row_step]`.
    pub data: Vec<u8>,
    /// Whether every point is valid.
    pub is_dense: bool,
}

impl Message for PointCloud2 {
    const TYPE: &'static str = "sensor_msgs/msg/PointCloud2";
}
