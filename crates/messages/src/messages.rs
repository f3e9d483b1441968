//! One struct per message, with the fields of its `.msg` file in the same order.

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
    /// Nanoseconds, below 1e9.
    pub nanosec: u32,
}

impl From<Stamp> for Time {
    /// Saturates at the limits of `sec`, about 68 years.
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
    /// Coordinate frame; eddy writes `world`.
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

/// `eddy_msgs/msg/ParticleFrame`, unchecked. [`eddy_frames::Frame`] is its checked form.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ParticleFrame {
    /// Stamp and coordinate frame.
    pub header: Header,
    /// Id of the trajectory.
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

/// State of a stream in a node; the numbers are those of `eddy_msgs/msg/PredictionStatus`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum StreamState {
    /// Frames are observed; nothing is published yet.
    WarmingUp = 0,
    /// A prediction is published for every observed frame.
    Tracking = 1,
    /// The model predicts from its own output.
    FreeRunning = 2,
}

/// `eddy_msgs/msg/PredictionStatus`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PredictionStatus {
    /// Stamp of the predicted instant, coordinate frame.
    pub header: Header,
    /// Id of the trajectory.
    pub stream: u64,
    /// Sequence number of the last observed frame.
    pub source_sequence: u64,
    /// Number of frames predicted ahead of it.
    pub horizon: u32,
    /// Number of a [`StreamState`].
    pub state: u8,
    /// Time from the arrival of the frame to the publication of the prediction (s).
    pub latency: f32,
    /// Digest of the checkpoint.
    pub model: String,
}

impl Message for PredictionStatus {
    const TYPE: &'static str = "eddy_msgs/msg/PredictionStatus";
}

/// `eddy_msgs/msg/ToolPart`, unchecked.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ToolPart {
    /// 0 half-space, 1 ball, 2 box, 3 convex hull.
    pub kind: u8,
    /// Radius of a ball or edge lengths of a box (domain lengths).
    pub size: Vec<f32>,
    /// Corners of a hull, `[C * D]`, interleaved (domain lengths).
    pub corners: Vec<f32>,
}

/// `eddy_msgs/msg/Tool`, unchecked. [`eddy_frames::tool::Tool`] is its checked form.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Tool {
    /// Its name.
    pub name: String,
    /// Its shape.
    pub parts: Vec<ToolPart>,
    /// 0 sticky, 1 slip, 2 friction.
    pub contact: u8,
    /// Coefficient of friction.
    pub friction: f32,
}

/// `eddy_msgs/msg/ToolDescription`, unchecked. [`eddy_frames::tool::Tools`] is its checked form.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ToolDescription {
    /// Stamp and coordinate frame.
    pub header: Header,
    /// Id of the trajectory.
    pub stream: u64,
    /// The tools.
    pub tools: Vec<Tool>,
}

impl Message for ToolDescription {
    const TYPE: &'static str = "eddy_msgs/msg/ToolDescription";
}

/// `geometry_msgs/msg/Point`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[expect(missing_docs, reason = "coordinates")]
pub struct Point {
    pub x: f64,
    pub y: f64,
    pub z: f64,
}

/// `geometry_msgs/msg/Quaternion`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[expect(missing_docs, reason = "components")]
pub struct Quaternion {
    pub x: f64,
    pub y: f64,
    pub z: f64,
    pub w: f64,
}

/// `geometry_msgs/msg/Vector3`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[expect(missing_docs, reason = "components")]
pub struct Vector3 {
    pub x: f64,
    pub y: f64,
    pub z: f64,
}

/// `geometry_msgs/msg/Pose`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Pose {
    /// Where it is.
    pub position: Point,
    /// Its rotation.
    pub orientation: Quaternion,
}

/// `geometry_msgs/msg/PoseStamped`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PoseStamped {
    /// Stamp, and the coordinate frame of the pose.
    pub header: Header,
    /// The pose.
    pub pose: Pose,
}

impl Message for PoseStamped {
    const TYPE: &'static str = "geometry_msgs/msg/PoseStamped";
}

/// `geometry_msgs/msg/Transform`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Transform {
    /// Where the origin of the child is in its parent.
    pub translation: Vector3,
    /// The child's rotation in its parent.
    pub rotation: Quaternion,
}

/// `geometry_msgs/msg/TransformStamped`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct TransformStamped {
    /// Stamp, and the parent coordinate frame.
    pub header: Header,
    /// The child coordinate frame.
    pub child_frame_id: String,
    /// The pose of the child in its parent.
    pub transform: Transform,
}

/// `tf2_msgs/msg/TFMessage`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct TFMessage {
    /// Transforms between coordinate frames.
    pub transforms: Vec<TransformStamped>,
}

impl Message for TFMessage {
    const TYPE: &'static str = "tf2_msgs/msg/TFMessage";
}

/// `geometry_msgs/msg/Twist`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Twist {
    /// Velocity.
    pub linear: Vector3,
    /// Angular velocity (rad/s).
    pub angular: Vector3,
}

/// `geometry_msgs/msg/Wrench`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Wrench {
    /// Force.
    pub force: Vector3,
    /// Torque.
    pub torque: Vector3,
}

/// `eddy_msgs/msg/ToolFrame`, unchecked. [`eddy_frames::tool::ToolFrame`] is its checked form.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ToolFrame {
    /// Stamp and coordinate frame.
    pub header: Header,
    /// Id of the trajectory.
    pub stream: u64,
    /// Number of the frame within the stream.
    pub sequence: u64,
    /// Names of the tools.
    pub names: Vec<String>,
    /// Where each tool is (domain lengths).
    pub poses: Vec<Pose>,
    /// Velocity of each (domain lengths per second, rad/s).
    pub twists: Vec<Twist>,
    /// Force and torque on each; empty if unknown.
    pub wrenches: Vec<Wrench>,
}

impl Message for ToolFrame {
    const TYPE: &'static str = "eddy_msgs/msg/ToolFrame";
}

/// `diagnostic_msgs/msg/KeyValue`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct KeyValue {
    /// Name of the value.
    pub key: String,
    /// Value with its unit.
    pub value: String,
}

/// `diagnostic_msgs/msg/DiagnosticStatus`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct DiagnosticStatus {
    /// 0 OK, 1 WARN, 2 ERROR, 3 STALE.
    pub level: u8,
    /// Name of the reporting component.
    pub name: String,
    /// Summary.
    pub message: String,
    /// Device; unused, empty.
    pub hardware_id: String,
    /// Details.
    pub values: Vec<KeyValue>,
}

/// `diagnostic_msgs/msg/DiagnosticArray`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct DiagnosticArray {
    /// Wall-clock stamp.
    pub header: Header,
    /// One entry per component.
    pub status: Vec<DiagnosticStatus>,
}

impl Message for DiagnosticArray {
    const TYPE: &'static str = "diagnostic_msgs/msg/DiagnosticArray";
}

/// `rcl_interfaces/msg/ParameterEvent`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ParameterEvent {
    /// Time of the event.
    pub stamp: Time,
    /// Full name of the node.
    pub node: String,
    /// New parameters.
    pub new_parameters: Vec<Parameter>,
    /// Parameters that were set.
    pub changed_parameters: Vec<Parameter>,
    /// Removed parameters.
    pub deleted_parameters: Vec<Parameter>,
}

impl Message for ParameterEvent {
    const TYPE: &'static str = "rcl_interfaces/msg/ParameterEvent";
}

/// `rcl_interfaces/msg/Log`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Log {
    /// Wall-clock time.
    pub stamp: Time,
    /// 10 DEBUG, 20 INFO, 30 WARN, 40 ERROR, 50 FATAL.
    pub level: u8,
    /// Name of the logger.
    pub name: String,
    /// The message.
    pub msg: String,
    /// Source file.
    pub file: String,
    /// Function or module.
    pub function: String,
    /// Line in the file.
    pub line: u32,
}

impl Message for Log {
    const TYPE: &'static str = "rcl_interfaces/msg/Log";
}

/// `sensor_msgs/msg/PointField`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct PointField {
    /// Name of the field, such as `x`.
    pub name: String,
    /// Offset in a point (bytes).
    pub offset: u32,
    /// 2 for `uint8`, 7 for `float32`.
    pub datatype: u8,
    /// Number of elements.
    pub count: u32,
}

/// `sensor_msgs/msg/PointCloud2`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct PointCloud2 {
    /// Stamp and coordinate frame.
    pub header: Header,
    /// Number of rows; 1 for unordered points.
    pub height: u32,
    /// Points per row.
    pub width: u32,
    /// Fields of a point.
    pub fields: Vec<PointField>,
    /// Whether the data is big-endian.
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
