//! Messages of any type whose definition is known: CDR from values, values from CDR.

use hiroz_schema::{FieldTypeDescription, TypeDescription, TypeId};
use serde::{Serialize, Serializer, ser::SerializeMap as _};

use super::{TypeSupport, cdr::HEADER};

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

/// A message as CDR bytes with their header. Fields that `value` lacks are 0, false or empty.
///
/// # Errors
/// [`InvalidValue`] with the first value that does not suit its field.
pub fn encode(support: &TypeSupport, value: &Value) -> Result<Vec<u8>, InvalidValue> {
    let mut encoder = Encoder { support, bytes: HEADER.to_vec() };
    encoder.message(&support.name, Some(value), &support.name)?;
    Ok(encoder.bytes)
}

struct Encoder<'t> {
    support: &'t TypeSupport,
    bytes: Vec<u8>,
}

impl Encoder<'_> {
    /// Appends a primitive, aligned to its own length.
    fn put(&mut self, bytes: &[u8]) {
        let misaligned = (self.bytes.len() - HEADER.len()) % bytes.len();
        if misaligned > 0 {
            self.bytes.resize(self.bytes.len() + bytes.len() - misaligned, 0);
        }
        self.bytes.extend(bytes);
    }

    fn message(
        &mut self,
        name: &str,
        value: Option<&Value>,
        path: &str,
    ) -> Result<(), InvalidValue> {
        let description = described(self.support, name, path)?;
        let given: &[_] = match value {
            None => &[],
            Some(Value::Map(given)) => given,
            Some(other) => return Err(invalid(path, other, "a map of fields")),
        };
        let fields = &description.fields;
        if let Some((unknown, _)) =
            given.iter().find(|(name, _)| fields.iter().all(|field| field.name != *name))
        {
            let names: Vec<_> = fields.iter().map(|field| field.name.as_str()).collect();
            return Err(InvalidValue {
                path: path.to_owned(),
                found: format!("field {unknown}"),
                expected: format!("one of {}", names.join(", ")),
            });
        }
        for field in fields {
            let value = given.iter().find(|(name, _)| *name == field.name).map(|(_, value)| value);
            self.field(&field.field_type, value, &format!("{path}: {}", field.name))?;
        }
        Ok(())
    }

    fn field(
        &mut self,
        kind: &FieldTypeDescription,
        value: Option<&Value>,
        path: &str,
    ) -> Result<(), InvalidValue> {
        let (element, count) = element_of(kind);
        if let Count::One = count {
            return self.element(element, kind, value, path);
        }
        let values: &[Value] = match value {
            None => &[],
            Some(Value::List(values)) => values,
            Some(other) => return Err(invalid(path, other, "a list")),
        };
        let length = values.len() as u64;
        match count {
            Count::Array(expected) if value.is_none() => {
                return (0..expected).try_for_each(|_| self.element(element, kind, None, path));
            }
            Count::Array(expected) if length != expected => {
                let found = Value::List(values.to_vec());
                return Err(invalid(path, &found, &format!("a list of {expected}")));
            }
            Count::Sequence(Some(most)) if length > most => {
                let found = Value::List(values.to_vec());
                return Err(invalid(path, &found, &format!("a list of at most {most}")));
            }
            Count::Sequence(_) => self.put(&(length as u32).to_le_bytes()),
            Count::Array(_) | Count::One => {}
        }
        values.iter().try_for_each(|value| self.element(element, kind, Some(value), path))
    }

    fn element(
        &mut self,
        element: u8,
        kind: &FieldTypeDescription,
        value: Option<&Value>,
        path: &str,
    ) -> Result<(), InvalidValue> {
        macro_rules! integer {
            ($type:ty) => {{
                let number = match value {
                    None => Some(0),
                    Some(value) => {
                        value.integer().and_then(|number| <$type>::try_from(number).ok())
                    }
                };
                let range = || format!("an integer from {} to {}", <$type>::MIN, <$type>::MAX);
                let number = number.ok_or_else(|| unsuitable(path, value, &range()))?;
                self.put(&number.to_le_bytes());
            }};
        }
        let number = |value: Option<&Value>| match value {
            None => Ok(0.0),
            Some(given) => given.number().ok_or_else(|| unsuitable(path, value, "a number")),
        };
        match element {
            TypeId::NESTED_TYPE => return self.message(&kind.nested_type_name, value, path),
            TypeId::BOOL => match value {
                None => self.put(&[0]),
                Some(Value::Bool(value)) => self.put(&[u8::from(*value)]),
                other => return Err(unsuitable(path, other, "true or false")),
            },
            TypeId::INT8 => integer!(i8),
            TypeId::UINT8 | TypeId::BYTE => integer!(u8),
            TypeId::INT16 => integer!(i16),
            TypeId::UINT16 => integer!(u16),
            TypeId::INT32 => integer!(i32),
            TypeId::UINT32 => integer!(u32),
            TypeId::INT64 => integer!(i64),
            TypeId::UINT64 => integer!(u64),
            TypeId::FLOAT32 => {
                let number = number(value)? as f32;
                self.put(&number.to_le_bytes());
            }
            TypeId::FLOAT64 => {
                let number = number(value)?;
                self.put(&number.to_le_bytes());
            }
            TypeId::STRING | TypeId::BOUNDED_STRING => {
                let text = match value {
                    None => "",
                    Some(Value::Text(text)) => text,
                    other => return Err(unsuitable(path, other, "a text")),
                };
                self.put(&(text.len() as u32 + 1).to_le_bytes());
                self.bytes.extend(text.as_bytes());
                self.bytes.push(0);
            }
            other => return Err(unsupported(path, other)),
        }
        Ok(())
    }
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

/// The value of a message of CDR bytes with their header.
///
/// # Errors
/// [`InvalidValue`] where the bytes are no message of this type.
pub fn decode(support: &TypeSupport, bytes: &[u8]) -> Result<Value, InvalidValue> {
    let body = bytes.strip_prefix(&HEADER).ok_or_else(|| InvalidValue {
        path: support.name.clone(),
        found: "other bytes".to_owned(),
        expected: "plain little-endian CDR (00 01 00 00)".to_owned(),
    })?;
    Decoder { support, body, at: 0 }.message(&support.name, &support.name)
}

struct Decoder<'t> {
    support: &'t TypeSupport,
    body: &'t [u8],
    at: usize,
}

impl Decoder<'_> {
    /// The next primitive, aligned to its own length.
    fn take<const N: usize>(&mut self, path: &str) -> Result<[u8; N], InvalidValue> {
        let start = self.at.next_multiple_of(N);
        self.at = start;
        self.bytes(N, path).map(|bytes| {
            let mut taken = [0; N];
            taken.copy_from_slice(bytes);
            taken
        })
    }

    fn bytes(&mut self, count: usize, path: &str) -> Result<&[u8], InvalidValue> {
        let end = self.at.checked_add(count);
        let bytes = end.and_then(|end| self.body.get(self.at..end));
        let bytes = bytes.ok_or_else(|| InvalidValue {
            path: path.to_owned(),
            found: format!("a message of {} bytes", self.body.len() + HEADER.len()),
            expected: "a longer one".to_owned(),
        })?;
        self.at += count;
        Ok(bytes)
    }

    fn message(&mut self, name: &str, path: &str) -> Result<Value, InvalidValue> {
        let description = described(self.support, name, path)?;
        let fields = description.fields.iter().map(|field| {
            let value = self.field(&field.field_type, &format!("{path}: {}", field.name))?;
            Ok((field.name.clone(), value))
        });
        fields.collect::<Result<_, _>>().map(Value::Map)
    }

    fn field(&mut self, kind: &FieldTypeDescription, path: &str) -> Result<Value, InvalidValue> {
        let (element, count) = element_of(kind);
        let length = match count {
            Count::One => return self.element(element, kind, path),
            Count::Array(length) => length,
            Count::Sequence(_) => u32::from_le_bytes(self.take(path)?).into(),
        };
        // An element has a byte at least, so that a false length ends with the bytes.
        (0..length)
            .map(|_| self.element(element, kind, path))
            .collect::<Result<_, _>>()
            .map(Value::List)
    }

    fn element(
        &mut self,
        element: u8,
        kind: &FieldTypeDescription,
        path: &str,
    ) -> Result<Value, InvalidValue> {
        Ok(match element {
            TypeId::NESTED_TYPE => return self.message(&kind.nested_type_name, path),
            TypeId::BOOL => Value::Bool(u8::from_le_bytes(self.take(path)?) != 0),
            TypeId::INT8 => Value::Integer(i8::from_le_bytes(self.take(path)?).into()),
            TypeId::UINT8 | TypeId::BYTE => {
                Value::Unsigned(u8::from_le_bytes(self.take(path)?).into())
            }
            TypeId::INT16 => Value::Integer(i16::from_le_bytes(self.take(path)?).into()),
            TypeId::UINT16 => Value::Unsigned(u16::from_le_bytes(self.take(path)?).into()),
            TypeId::INT32 => Value::Integer(i32::from_le_bytes(self.take(path)?).into()),
            TypeId::UINT32 => Value::Unsigned(u32::from_le_bytes(self.take(path)?).into()),
            TypeId::INT64 => Value::Integer(i64::from_le_bytes(self.take(path)?)),
            TypeId::UINT64 => Value::Unsigned(u64::from_le_bytes(self.take(path)?)),
            TypeId::FLOAT32 => Value::Single(f32::from_le_bytes(self.take(path)?)),
            TypeId::FLOAT64 => Value::Double(f64::from_le_bytes(self.take(path)?)),
            TypeId::STRING | TypeId::BOUNDED_STRING => {
                let length = u32::from_le_bytes(self.take(path)?) as usize;
                let bytes = self.bytes(length, path)?;
                let text = bytes.strip_suffix(&[0]).unwrap_or(bytes);
                Value::Text(String::from_utf8_lossy(text).into_owned())
            }
            other => return Err(unsupported(path, other)),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        DiagnosticArray, DiagnosticStatus, Header, KeyValue, Message, ParticleFrame, cdr,
        services::{Parameter, ParameterValue, SetParametersRequest},
        type_support,
    };

    /// What the derived encoding of a struct gives must be read and written alike.
    fn agree(name: &str, bytes: &[u8]) -> Value {
        let support = type_support(name).unwrap();
        let value = decode(support, bytes).unwrap();
        assert_eq!(encode(support, &value).unwrap(), bytes);
        value
    }

    #[test]
    fn values_are_those_of_the_structs() {
        let frame = ParticleFrame {
            header: Header { frame_id: "world".to_owned(), ..Header::default() },
            stream: u64::MAX,
            dt: 0.016,
            position: vec![0.25, -1.0],
            material: vec![1, 2, 3],
            ..ParticleFrame::default()
        };
        let value = agree(ParticleFrame::TYPE, &cdr::encode(&frame));
        let Value::Map(fields) = value else { panic!("{value:?}") };
        assert_eq!(fields[1], ("stream".to_owned(), Value::Unsigned(u64::MAX)));
        let positions = [0.25, -1.0].map(Value::Single).to_vec();
        assert_eq!(fields[6], ("position".to_owned(), Value::List(positions)));
        let status = DiagnosticStatus {
            level: 1,
            name: "a".to_owned(),
            values: vec![KeyValue { key: "k".to_owned(), value: String::new() }],
            ..DiagnosticStatus::default()
        };
        let array = DiagnosticArray { status: vec![status.clone(), status], ..Default::default() };
        agree(DiagnosticArray::TYPE, &cdr::encode(&array));
        let parameters = vec![Parameter {
            name: "horizon".to_owned(),
            value: ParameterValue::doubles(vec![0.5, f64::NAN]),
        }];
        let request = cdr::encode(&SetParametersRequest { parameters });
        let support = type_support("rcl_interfaces/srv/SetParameters_Request").unwrap();
        assert_eq!(encode(support, &decode(support, &request).unwrap()).unwrap(), request);
    }

    #[test]
    fn missing_fields_have_defaults_and_wrong_ones_are_named() {
        let support = type_support("rcl_interfaces/srv/SetParameters_Request").unwrap();
        let map = |fields: Vec<(&str, Value)>| {
            Value::Map(fields.into_iter().map(|(name, value)| (name.to_owned(), value)).collect())
        };
        let expected = SetParametersRequest { parameters: vec![Parameter::default()] };
        let one = map(vec![("parameters", Value::List(vec![map(Vec::new())]))]);
        assert_eq!(encode(support, &one).unwrap(), cdr::encode(&expected));
        let of = |value| map(vec![("parameters", Value::List(vec![map(vec![("value", value)])]))]);
        for (value, message) in [
            (map(vec![("a", Value::Bool(true))]), "found field a, expected one of parameters"),
            (Value::Bool(true), "found true, expected a map of fields"),
            (map(vec![("parameters", Value::Integer(1))]), "parameters: found 1, expected a list"),
            (
                of(map(vec![("type", Value::Integer(256))])),
                "value: type: found 256, expected an integer from 0 to 255",
            ),
            (
                of(map(vec![("string_value", Value::Integer(1))])),
                "value: string_value: found 1, expected a text",
            ),
        ] {
            let error = encode(support, &value).unwrap_err().to_string();
            assert!(error.starts_with(&support.name) && error.ends_with(message), "{error}");
        }
    }

    #[test]
    fn lengths_are_checked() {
        let support = TypeSupport::from_schema(
            "acme/msg/Box",
            "float64[2] size\nstring<=3[<=1] names\nuint8[] data\n",
        );
        let support = support.unwrap();
        let empty = encode(&support, &Value::Map(Vec::new())).unwrap();
        assert_eq!(empty.len(), HEADER.len() + 16 + 4 + 4);
        let field = |name: &str, length| {
            let values = vec![Value::Text("a".to_owned()); length];
            Value::Map(vec![(name.to_owned(), Value::List(values))])
        };
        let error = encode(&support, &field("size", 1)).unwrap_err().to_string();
        assert!(error.ends_with("size: found a list of 1, expected a list of 2"), "{error}");
        let error = encode(&support, &field("names", 2)).unwrap_err().to_string();
        assert!(error.ends_with("found a list of 2, expected a list of at most 1"), "{error}");
        encode(&support, &field("names", 1)).unwrap();
        let mut long = empty.clone();
        let at = long.len() - 4;
        long[at..].copy_from_slice(&u32::MAX.to_le_bytes());
        for bytes in [&long[..], &empty[..9], &[0, 0, 0, 0, 1], &[]] {
            decode(&support, bytes).unwrap_err();
        }
    }
}
