//! Requests and responses of `std_srvs/srv/Trigger` and the parameter services of `rcl_interfaces`
//! (<https://github.com/ros2/rcl_interfaces>).

use serde::{Deserialize, Serialize};

/// A request or response without fields; encoded as one byte, since IDL has no empty structs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Empty {
    /// Unused.
    pub structure_needs_at_least_one_member: u8,
}

/// Response of `std_srvs/srv/Trigger`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct TriggerResponse {
    /// Whether the request succeeded.
    pub success: bool,
    /// Description of the result.
    pub message: String,
}

/// Type of a [`ParameterValue`] (`rcl_interfaces/msg/ParameterType`).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum ParameterKind {
    /// No value.
    NotSet = 0,
    /// A boolean.
    Bool = 1,
    /// An integer.
    Integer = 2,
    /// A floating-point number.
    Double = 3,
    /// A string.
    String = 4,
    /// Bytes.
    Bytes = 5,
    /// Booleans.
    Bools = 6,
    /// Integers.
    Integers = 7,
    /// Floating-point numbers.
    Doubles = 8,
    /// Strings.
    Strings = 9,
}

impl ParameterKind {
    /// All kinds, indexed by number.
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

    /// Name with its article, for error messages.
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

/// `rcl_interfaces/msg/ParameterValue`; `kind` selects the field with the value.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ParameterValue {
    /// Number of a [`ParameterKind`].
    #[serde(rename = "type")]
    pub kind: u8,
    /// Value of kind 1.
    pub bool_value: bool,
    /// Value of kind 2.
    pub integer_value: i64,
    /// Value of kind 3.
    pub double_value: f64,
    /// Value of kind 4.
    pub string_value: String,
    /// Value of kind 5.
    pub byte_array_value: Vec<u8>,
    /// Value of kind 6.
    pub bool_array_value: Vec<bool>,
    /// Value of kind 7.
    pub integer_array_value: Vec<i64>,
    /// Value of kind 8.
    pub double_array_value: Vec<f64>,
    /// Value of kind 9.
    pub string_array_value: Vec<String>,
}

impl ParameterValue {
    /// A boolean.
    pub fn bool(value: bool) -> Self {
        Self { bool_value: value, ..Self::of(ParameterKind::Bool) }
    }

    /// An integer.
    pub fn integer(value: i64) -> Self {
        Self { integer_value: value, ..Self::of(ParameterKind::Integer) }
    }

    /// A floating-point number.
    pub fn double(value: f64) -> Self {
        Self { double_value: value, ..Self::of(ParameterKind::Double) }
    }

    /// A string.
    pub fn string(value: String) -> Self {
        Self { string_value: value, ..Self::of(ParameterKind::String) }
    }

    /// Booleans.
    pub fn bools(values: Vec<bool>) -> Self {
        Self { bool_array_value: values, ..Self::of(ParameterKind::Bools) }
    }

    /// Integers.
    pub fn integers(values: Vec<i64>) -> Self {
        Self { integer_array_value: values, ..Self::of(ParameterKind::Integers) }
    }

    /// Floating-point numbers.
    pub fn doubles(values: Vec<f64>) -> Self {
        Self { double_array_value: values, ..Self::of(ParameterKind::Doubles) }
    }

    /// Strings.
    pub fn strings(values: Vec<String>) -> Self {
        Self { string_array_value: values, ..Self::of(ParameterKind::Strings) }
    }

    fn of(kind: ParameterKind) -> Self {
        Self { kind: kind as u8, ..Self::default() }
    }

    /// The kind of the value.
    ///
    /// # Errors
    /// The number, if it is not that of a kind.
    pub fn kind(&self) -> Result<ParameterKind, u8> {
        ParameterKind::ALL.get(usize::from(self.kind)).copied().ok_or(self.kind)
    }
}

/// `rcl_interfaces/msg/Parameter`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Parameter {
    /// Name of the parameter.
    pub name: String,
    /// Value of the parameter.
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
    /// One value per name; of kind 0 if there is no such parameter.
    pub values: Vec<ParameterValue>,
}

/// Response of `rcl_interfaces/srv/GetParameterTypes`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct GetParameterTypesResponse {
    /// One kind per name.
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
    /// Whether the parameter was set.
    pub successful: bool,
    /// Reason of a failure.
    pub reason: String,
}

/// Response of `rcl_interfaces/srv/SetParameters`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SetParametersResponse {
    /// One result per parameter.
    pub results: Vec<SetParametersResult>,
}

/// Response of `rcl_interfaces/srv/SetParametersAtomically`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SetParametersAtomicallyResponse {
    /// The result for all parameters.
    pub result: SetParametersResult,
}

/// Request of `rcl_interfaces/srv/ListParameters`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ListParametersRequest {
    /// Prefixes of the parameters; all parameters if empty.
    pub prefixes: Vec<String>,
    /// Number of levels of the names; 0 for all.
    pub depth: u64,
}

/// Response of `rcl_interfaces/srv/ListParameters`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ListParametersResponse {
    /// Names of the parameters.
    pub names: Vec<String>,
    /// Prefixes of the parameters.
    pub prefixes: Vec<String>,
}

/// `rcl_interfaces/msg/IntegerRange`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct IntegerRange {
    /// Smallest value.
    pub from_value: i64,
    /// Largest value.
    pub to_value: i64,
    /// Distance between values; 0 for any.
    pub step: u64,
}

/// `rcl_interfaces/msg/FloatingPointRange`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct FloatingPointRange {
    /// Smallest value.
    pub from_value: f64,
    /// Largest value.
    pub to_value: f64,
    /// Distance between values; 0 for any.
    pub step: f64,
}

/// `rcl_interfaces/msg/ParameterDescriptor`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ParameterDescriptor {
    /// Name of the parameter.
    pub name: String,
    /// Kind of the value.
    #[serde(rename = "type")]
    pub kind: u8,
    /// Description of the parameter.
    pub description: String,
    /// Constraints in addition to the range.
    pub additional_constraints: String,
    /// Whether the parameter is read-only.
    pub read_only: bool,
    /// Whether the kind may change.
    pub dynamic_typing: bool,
    /// Range of a floating-point value; at most one.
    pub floating_point_range: Vec<FloatingPointRange>,
    /// Range of an integer; at most one.
    pub integer_range: Vec<IntegerRange>,
}

/// Response of `rcl_interfaces/srv/DescribeParameters`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct DescribeParametersResponse {
    /// One descriptor per name.
    pub descriptors: Vec<ParameterDescriptor>,
}
