//! Rust twins of the `.srv` files that nodes answer: `std_srvs/srv/Trigger` and the parameter services
//! of `rcl_interfaces` (<https://github.com/ros2/rcl_interfaces>), field by field.

use serde::{Deserialize, Serialize};

/// A request or response without fields; on the wire it has one byte, as IDL knows no empty struct.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Empty {
    /// Means nothing.
    pub structure_needs_at_least_one_member: u8,
}

/// Response of `std_srvs/srv/Trigger`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct TriggerResponse {
    /// Whether it was done.
    pub success: bool,
    /// What was done, or why not.
    pub message: String,
}

/// What a [`ParameterValue`] holds (`rcl_interfaces/msg/ParameterType`).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum ParameterKind {
    /// Nothing.
    NotSet = 0,
    /// A truth value.
    Bool = 1,
    /// A whole number.
    Integer = 2,
    /// A floating-point number.
    Double = 3,
    /// A text.
    String = 4,
    /// Bytes.
    Bytes = 5,
    /// Truth values.
    Bools = 6,
    /// Whole numbers.
    Integers = 7,
    /// Floating-point numbers.
    Doubles = 8,
    /// Texts.
    Strings = 9,
}

impl ParameterKind {
    /// Every kind, in the order of its number.
    const ALL: [Self; 10] = [
        Self::NotSet,
        Self::Bool,
        Self::Integer,
        Self::Double,
        Self::String,
        Self::Bytes,
        Self::Bools,
        Self::Integers,
        Self::Doubles,
        Self::Strings,
    ];

    /// With its article, for sentences.
    pub fn name(self) -> &'static str {
        match self {
            Self::NotSet => "nothing",
            Self::Bool => "a bool",
            Self::Integer => "an integer",
            Self::Double => "a double",
            Self::String => "a string",
            Self::Bytes => "a list of bytes",
            Self::Bools => "a list of bools",
            Self::Integers => "a list of integers",
            Self::Doubles => "a list of doubles",
            Self::Strings => "a list of strings",
        }
    }
}

/// `rcl_interfaces/msg/ParameterValue`: the field that `kind` names counts.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ParameterValue {
    /// A [`ParameterKind`] as its number.
    #[serde(rename = "type")]
    pub kind: u8,
    /// For 1.
    pub bool_value: bool,
    /// For 2.
    pub integer_value: i64,
    /// For 3.
    pub double_value: f64,
    /// For 4.
    pub string_value: String,
    /// For 5.
    pub byte_array_value: Vec<u8>,
    /// For 6.
    pub bool_array_value: Vec<bool>,
    /// For 7.
    pub integer_array_value: Vec<i64>,
    /// For 8.
    pub double_array_value: Vec<f64>,
    /// For 9.
    pub string_array_value: Vec<String>,
}

impl ParameterValue {
    /// A truth value.
    pub fn bool(value: bool) -> Self {
        Self { bool_value: value, ..Self::of(ParameterKind::Bool) }
    }

    /// A whole number.
    pub fn integer(value: i64) -> Self {
        Self { integer_value: value, ..Self::of(ParameterKind::Integer) }
    }

    /// A floating-point number.
    pub fn double(value: f64) -> Self {
        Self { double_value: value, ..Self::of(ParameterKind::Double) }
    }

    /// A text.
    pub fn string(value: String) -> Self {
        Self { string_value: value, ..Self::of(ParameterKind::String) }
    }

    /// Truth values.
    pub fn bools(values: Vec<bool>) -> Self {
        Self { bool_array_value: values, ..Self::of(ParameterKind::Bools) }
    }

    /// Whole numbers.
    pub fn integers(values: Vec<i64>) -> Self {
        Self { integer_array_value: values, ..Self::of(ParameterKind::Integers) }
    }

    /// Floating-point numbers.
    pub fn doubles(values: Vec<f64>) -> Self {
        Self { double_array_value: values, ..Self::of(ParameterKind::Doubles) }
    }

    /// Texts.
    pub fn strings(values: Vec<String>) -> Self {
        Self { string_array_value: values, ..Self::of(ParameterKind::Strings) }
    }

    fn of(kind: ParameterKind) -> Self {
        Self { kind: kind as u8, ..Self::default() }
    }

    /// What it holds; the number itself if that means nothing.
    pub fn kind(&self) -> Result<ParameterKind, u8> {
        ParameterKind::ALL.get(usize::from(self.kind)).copied().ok_or(self.kind)
    }
}

/// `rcl_interfaces/msg/Parameter`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Parameter {
    /// Its name.
    pub name: String,
    /// Its value.
    pub value: ParameterValue,
}

/// Names of parameters: the request of `GetParameters`, `GetParameterTypes` and `DescribeParameters`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ParameterNames {
    /// The names.
    pub names: Vec<String>,
}

/// Response of `rcl_interfaces/srv/GetParameters`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct GetParametersResponse {
    /// One value a name; of kind 0 where there is no such parameter.
    pub values: Vec<ParameterValue>,
}

/// Response of `rcl_interfaces/srv/GetParameterTypes`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct GetParameterTypesResponse {
    /// One kind a name.
    pub types: Vec<u8>,
}

/// Request of `rcl_interfaces/srv/SetParameters` and `SetParametersAtomically`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SetParametersRequest {
    /// The new values.
    pub parameters: Vec<Parameter>,
}

/// `rcl_interfaces/msg/SetParametersResult`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SetParametersResult {
    /// Whether it was set.
    pub successful: bool,
    /// Why not.
    pub reason: String,
}

/// Response of `rcl_interfaces/srv/SetParameters`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SetParametersResponse {
    /// One result a parameter.
    pub results: Vec<SetParametersResult>,
}

/// Response of `rcl_interfaces/srv/SetParametersAtomically`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SetParametersAtomicallyResponse {
    /// For all of them.
    pub result: SetParametersResult,
}

/// Request of `rcl_interfaces/srv/ListParameters`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ListParametersRequest {
    /// Only parameters below these, all if there is none.
    pub prefixes: Vec<String>,
    /// How many levels of names; 0 for all.
    pub depth: u64,
}

/// Response of `rcl_interfaces/srv/ListParameters`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ListParametersResponse {
    /// The parameters' names.
    pub names: Vec<String>,
    /// Their prefixes.
    pub prefixes: Vec<String>,
}

/// `rcl_interfaces/msg/IntegerRange`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct IntegerRange {
    /// Smallest value.
    pub from_value: i64,
    /// Largest value.
    pub to_value: i64,
    /// Distance of values; 0 for any.
    pub step: u64,
}

/// `rcl_interfaces/msg/FloatingPointRange`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct FloatingPointRange {
    /// Smallest value.
    pub from_value: f64,
    /// Largest value.
    pub to_value: f64,
    /// Distance of values; 0 for any.
    pub step: f64,
}

/// `rcl_interfaces/msg/ParameterDescriptor`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ParameterDescriptor {
    /// The parameter's name.
    pub name: String,
    /// The kind of its value.
    #[serde(rename = "type")]
    pub kind: u8,
    /// What it does.
    pub description: String,
    /// What else it must fulfil.
    pub additional_constraints: String,
    /// Whether it cannot be set.
    pub read_only: bool,
    /// Whether its kind may change.
    pub dynamic_typing: bool,
    /// Range of a floating-point value; at most one.
    pub floating_point_range: Vec<FloatingPointRange>,
    /// Range of an integer; at most one.
    pub integer_range: Vec<IntegerRange>,
}

/// Response of `rcl_interfaces/srv/DescribeParameters`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct DescribeParametersResponse {
    /// One descriptor a name.
    pub descriptors: Vec<ParameterDescriptor>,
}
