//! What the value of a setting may be, and how it travels as a ROS parameter.

use std::ops::RangeInclusive;

use eddy_messages::services::{ParameterKind, ParameterValue};

/// The values that a setting accepts.
#[derive(Clone, Debug, PartialEq)]
pub enum Values {
    /// True or false.
    Bool,
    /// A whole number.
    Integer {
        /// Smallest and largest.
        range: RangeInclusive<i64>,
        /// What is counted, in the plural.
        unit: &'static str,
    },
    /// A number.
    Number {
        /// Smallest and largest.
        range: RangeInclusive<f64>,
        /// Its unit, in the plural.
        unit: &'static str,
    },
    /// A name of letters, digits and `_` that does not start with a digit, or nothing.
    Name,
    /// One of these words, each with its meaning.
    Word(&'static [(&'static str, &'static str)]),
}

impl Values {
    /// The type of the parameter.
    pub fn kind(&self) -> ParameterKind {
        match self {
            Self::Bool => ParameterKind::Bool,
            Self::Integer { .. } => ParameterKind::Integer,
            Self::Number { .. } => ParameterKind::Double,
            Self::Name | Self::Word(_) => ParameterKind::String,
        }
    }

    /// A value as a double if it is whole and a number is expected.
    pub(super) fn with_kind(&self, value: &ParameterValue) -> ParameterValue {
        match (self, value.kind()) {
            (Self::Number { .. }, Ok(ParameterKind::Integer)) => {
                ParameterValue::double(value.integer_value as f64)
            }
            _ => value.clone(),
        }
    }

    /// The values of a text in words; nothing otherwise.
    pub(super) fn words(&self) -> String {
        match self {
            Self::Word(words) => {
                words.iter().map(|(word, _)| *word).collect::<Vec<_>>().join(" or ")
            }
            Self::Name => "a name of letters, digits and _, or nothing".to_owned(),
            Self::Bool | Self::Integer { .. } | Self::Number { .. } => String::new(),
        }
    }
}

/// A type of settings.
pub(super) trait Setting: Sized {
    fn to_parameter(&self) -> ParameterValue;

    /// From a value of the right kind within its [`Values`].
    fn from_parameter(value: &ParameterValue) -> Self;
}

impl Setting for bool {
    fn to_parameter(&self) -> ParameterValue {
        ParameterValue::bool(*self)
    }

    fn from_parameter(value: &ParameterValue) -> Self {
        value.bool_value
    }
}

impl Setting for u64 {
    /// Numbers beyond the largest ROS integer saturate.
    fn to_parameter(&self) -> ParameterValue {
        ParameterValue::integer(i64::try_from(*self).unwrap_or(i64::MAX))
    }

    fn from_parameter(value: &ParameterValue) -> Self {
        value.integer_value as Self
    }
}

impl Setting for u32 {
    fn to_parameter(&self) -> ParameterValue {
        u64::from(*self).to_parameter()
    }

    fn from_parameter(value: &ParameterValue) -> Self {
        value.integer_value as Self
    }
}

impl Setting for usize {
    fn to_parameter(&self) -> ParameterValue {
        (*self as u64).to_parameter()
    }

    fn from_parameter(value: &ParameterValue) -> Self {
        value.integer_value as Self
    }
}

impl Setting for String {
    fn to_parameter(&self) -> ParameterValue {
        ParameterValue::string(self.clone())
    }

    fn from_parameter(value: &ParameterValue) -> Self {
        value.string_value.clone()
    }
}

/// `None` is 0 as a parameter.
impl Setting for Option<u64> {
    fn to_parameter(&self) -> ParameterValue {
        self.unwrap_or(0).to_parameter()
    }

    fn from_parameter(value: &ParameterValue) -> Self {
        Some(u64::from_parameter(value)).filter(|&number| number > 0)
    }
}

/// `None` is 0 as a parameter.
impl Setting for Option<f64> {
    fn to_parameter(&self) -> ParameterValue {
        ParameterValue::double(self.unwrap_or(0.0))
    }

    fn from_parameter(value: &ParameterValue) -> Self {
        Some(value.double_value).filter(|&number| number > 0.0)
    }
}
