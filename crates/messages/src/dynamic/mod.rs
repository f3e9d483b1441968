//! Messages of any type whose definition is known: CDR from values, values from CDR.

mod decode;
mod encode;
#[cfg(test)]
mod tests;

pub use decode::{check, decode, is_decodable};
pub use encode::encode;

use hiroz_schema::{FieldTypeDescription, TypeDescription, TypeId};
use serde::{Serialize, Serializer, ser::SerializeMap as _};

use super::TypeSupport;

/// A value of a message.
#[derive(Clone, Debug, PartialEq)]
pub enum Value {
    /// `bool`
    Bool(bool),
    /// A signed integer.
    Integer(i64),
    /// An unsigned integer.
    Unsigned(u64),
    /// `float32`
    Single(f32),
    /// `float64`
    Double(f64),
    /// `string`
    Text(String),
    /// Array or sequence.
    List(Vec<Value>),
    /// A message: its fields in order.
    Map(Vec<(String, Value)>),
}

/// A value that a message cannot have, or bytes that are no message of a type.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{path}: found {found}, expected {expected}")]
pub struct InvalidValue {
    /// The type and the fields that lead to the value.
    pub path: String,
    /// What was found there.
    pub found: String,
    /// What was expected.
    pub expected: String,
}

impl Serialize for Value {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Bool(value) => serializer.serialize_bool(*value),
            Self::Integer(value) => serializer.serialize_i64(*value),
            Self::Unsigned(value) => serializer.serialize_u64(*value),
            Self::Single(value) => serializer.serialize_f32(*value),
            Self::Double(value) => serializer.serialize_f64(*value),
            Self::Text(value) => serializer.serialize_str(value),
            Self::List(values) => serializer.collect_seq(values),
            Self::Map(fields) => {
                let mut map = serializer.serialize_map(Some(fields.len()))?;
                fields.iter().try_for_each(|(name, value)| map.serialize_entry(name, value))?;
                map.end()
            }
        }
    }
}

impl Value {
    /// What it is, for error messages.
    fn name(&self) -> String {
        match self {
            Self::Bool(value) => value.to_string(),
            Self::Integer(value) => value.to_string(),
            Self::Unsigned(value) => value.to_string(),
            Self::Single(value) => value.to_string(),
            Self::Double(value) => value.to_string(),
            Self::Text(text) => format!("`{text}`"),
            Self::List(values) => format!("a list of {}", values.len()),
            Self::Map(_) => "a map".to_owned(),
        }
    }

    fn integer(&self) -> Option<i128> {
        match self {
            Self::Integer(value) => Some((*value).into()),
            Self::Unsigned(value) => Some((*value).into()),
            _ => None,
        }
    }

    fn number(&self) -> Option<f64> {
        match self {
            Self::Single(value) => Some((*value).into()),
            Self::Double(value) => Some(*value),
            other => other.integer().map(|value| value as f64),
        }
    }
}

/// How often an element occurs in a field.
#[derive(Clone, Copy)]
enum Count {
    One,
    Array(u64),
    /// With the largest length.
    Sequence(Option<u64>),
}

/// The type of an element and its count. Unlike `TypeId::base_type`, also of bounded strings.
fn element_of(kind: &FieldTypeDescription) -> (u8, Count) {
    let FieldTypeDescription { type_id, capacity, .. } = *kind;
    if type_id > TypeId::UNBOUNDED_SEQUENCE_OFFSET {
        (type_id - TypeId::UNBOUNDED_SEQUENCE_OFFSET, Count::Sequence(None))
    } else if type_id > TypeId::BOUNDED_SEQUENCE_OFFSET {
        (type_id - TypeId::BOUNDED_SEQUENCE_OFFSET, Count::Sequence(Some(capacity)))
    } else if type_id > TypeId::ARRAY_OFFSET {
        (type_id - TypeId::ARRAY_OFFSET, Count::Array(capacity))
    } else {
        (type_id, Count::One)
    }
}

fn described<'t>(
    support: &'t TypeSupport,
    name: &str,
    path: &str,
) -> Result<&'t TypeDescription, InvalidValue> {
    let description = &support.description;
    let all = description.referenced_type_descriptions.iter();
    let mut all = all.chain([&description.type_description]);
    all.find(|of| of.type_name == name).ok_or_else(|| InvalidValue {
        path: path.to_owned(),
        found: "no definition".to_owned(),
        expected: format!("one of {name}"),
    })
}

fn invalid(path: &str, found: &Value, expected: &str) -> InvalidValue {
    unsuitable(path, Some(found), expected)
}

fn unsuitable(path: &str, found: Option<&Value>, expected: &str) -> InvalidValue {
    let found = found.map_or("nothing".to_owned(), Value::name);
    InvalidValue { path: path.to_owned(), found, expected: expected.to_owned() }
}

fn unsupported(path: &str, element: u8) -> InvalidValue {
    let (found, expected) = (format!("field type {element}"), "any but wide strings".to_owned());
    InvalidValue { path: path.to_owned(), found, expected }
}
