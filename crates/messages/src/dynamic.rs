//! Messages of any type whose definition is known: CDR from values, values from CDR.

use hiroz_schema::{FieldTypeDescription, TypeDescription, TypeId};
use serde::{Serialize, Serializer, ser::SerializeMap as _};

use super::{
    TypeSupport,
    cdr::{HEADER, MAX_PADDING},
};

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

/// The value of a message of CDR bytes with their header, of either byte order.
///
/// # Errors
/// [`InvalidValue`] where the bytes are no message of this type.
pub fn decode(support: &TypeSupport, bytes: &[u8]) -> Result<Value, InvalidValue> {
    Decoder::new(support, bytes, true)?.all()
}

/// Checks that [`decode`] has no error, without the memory for the value.
///
/// # Errors
/// Those of [`decode`].
pub fn check(support: &TypeSupport, bytes: &[u8]) -> Result<(), InvalidValue> {
    Decoder::new(support, bytes, false)?.all().map(drop)
}

/// Whether messages of this type can be decoded: wide strings and characters cannot, for which middlewares have several encodings.
pub fn is_decodable(support: &TypeSupport) -> bool {
    let description = &support.description;
    let all = description.referenced_type_descriptions.iter();
    let mut all = all.chain([&description.type_description]);
    all.all(|of| {
        let mut elements = of.fields.iter().map(|field| element_of(&field.field_type).0);
        elements.all(|element| element == TypeId::NESTED_TYPE || is_decoded(element))
    })
}

fn is_decoded(element: u8) -> bool {
    size_of(element).is_some() || matches!(element, TypeId::STRING | TypeId::BOUNDED_STRING)
}

/// Bytes of a primitive type; `None` for others.
fn size_of(element: u8) -> Option<usize> {
    Some(match element {
        TypeId::BOOL | TypeId::INT8 | TypeId::UINT8 | TypeId::BYTE => 1,
        TypeId::INT16 | TypeId::UINT16 => 2,
        TypeId::INT32 | TypeId::UINT32 | TypeId::FLOAT32 => 4,
        TypeId::INT64 | TypeId::UINT64 | TypeId::FLOAT64 => 8,
        _ => return None,
    })
}

struct Decoder<'t> {
    support: &'t TypeSupport,
    body: &'t [u8],
    at: usize,
    is_little: bool,
    /// Whether the value is wanted; else its lists and maps stay empty.
    keeps: bool,
}

/// Reads a number of the decoder's byte order.
macro_rules! number {
    ($decoder:expr, $path:expr, $type:ty) => {{
        let bytes = $decoder.take($path)?;
        if $decoder.is_little {
            <$type>::from_le_bytes(bytes)
        } else {
            <$type>::from_be_bytes(bytes)
        }
    }};
}

impl<'t> Decoder<'t> {
    fn new(support: &'t TypeSupport, bytes: &'t [u8], keeps: bool) -> Result<Self, InvalidValue> {
        let is_little = match bytes {
            [0, 1, _, _, ..] => true,
            [0, 0, _, _, ..] => false,
            _ => {
                return Err(InvalidValue {
                    path: format!("{}: CDR header", support.name),
                    found: format!("{:02x?}", &bytes[..bytes.len().min(HEADER.len())]),
                    expected: "[00, 01, 00, 00] (plain CDR, little-endian) or [00, 00, 00, 00] (big-endian)".to_owned(),
                });
            }
        };
        Ok(Self { support, body: &bytes[HEADER.len()..], at: 0, is_little, keeps })
    }

    /// The whole message.
    fn all(mut self) -> Result<Value, InvalidValue> {
        let name = &self.support.name;
        let value = self.message(name, name)?;
        if self.body.len() > self.at + MAX_PADDING {
            return Err(InvalidValue {
                path: name.clone(),
                found: format!("a message of {} bytes", self.body.len() + HEADER.len()),
                expected: format!("one of {}", self.at + HEADER.len()),
            });
        }
        Ok(value)
    }

    /// The next primitive, aligned to its own length.
    fn take<const N: usize>(&mut self, path: &str) -> Result<[u8; N], InvalidValue> {
        self.align(N);
        self.bytes(N, path).map(|bytes| {
            let mut taken = [0; N];
            taken.copy_from_slice(bytes);
            taken
        })
    }

    fn align(&mut self, to: usize) {
        self.at = self.at.next_multiple_of(to);
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
        let mut fields = Vec::new();
        for field in &description.fields {
            let value = self.field(&field.field_type, &format!("{path}: {}", field.name))?;
            if self.keeps {
                fields.push((field.name.clone(), value));
            }
        }
        Ok(Value::Map(fields))
    }

    fn field(&mut self, kind: &FieldTypeDescription, path: &str) -> Result<Value, InvalidValue> {
        let (element, count) = element_of(kind);
        let length = match count {
            Count::One => return self.element(element, kind, path),
            Count::Array(length) => length,
            Count::Sequence(_) => number!(self, path, u32).into(),
        };
        // A message of primitives may be large: an image has a million bytes.
        if let Some(size) = size_of(element).filter(|_| !self.keeps && length > 0) {
            self.align(size);
            let length = usize::try_from(length).unwrap_or(usize::MAX);
            self.bytes(length.saturating_mul(size), path)?;
            return Ok(Value::List(Vec::new()));
        }
        // An element has a byte at least, so that a false length ends with the bytes.
        let mut values = Vec::new();
        for _ in 0..length {
            let value = self.element(element, kind, path)?;
            if self.keeps {
                values.push(value);
            }
        }
        Ok(Value::List(values))
    }

    fn element(
        &mut self,
        element: u8,
        kind: &FieldTypeDescription,
        path: &str,
    ) -> Result<Value, InvalidValue> {
        Ok(match element {
            TypeId::NESTED_TYPE => return self.message(&kind.nested_type_name, path),
            TypeId::BOOL => Value::Bool(number!(self, path, u8) != 0),
            TypeId::INT8 => Value::Integer(number!(self, path, i8).into()),
            TypeId::UINT8 | TypeId::BYTE => Value::Unsigned(number!(self, path, u8).into()),
            TypeId::INT16 => Value::Integer(number!(self, path, i16).into()),
            TypeId::UINT16 => Value::Unsigned(number!(self, path, u16).into()),
            TypeId::INT32 => Value::Integer(number!(self, path, i32).into()),
            TypeId::UINT32 => Value::Unsigned(number!(self, path, u32).into()),
            TypeId::INT64 => Value::Integer(number!(self, path, i64)),
            TypeId::UINT64 => Value::Unsigned(number!(self, path, u64)),
            TypeId::FLOAT32 => Value::Single(number!(self, path, f32)),
            TypeId::FLOAT64 => Value::Double(number!(self, path, f64)),
            TypeId::STRING | TypeId::BOUNDED_STRING => {
                let length = number!(self, path, u32) as usize;
                let keeps = self.keeps;
                let bytes = self.bytes(length, path)?;
                let text = bytes.strip_suffix(&[0]).unwrap_or(bytes);
                let text = if keeps { String::from_utf8_lossy(text) } else { "".into() };
                Value::Text(text.into_owned())
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
        let longer = [&empty[..], &[0; 4]].concat();
        for bytes in [&long[..], &empty[..9], &[0, 0, 0, 0, 1], &longer, &[]] {
            let error = decode(&support, bytes).unwrap_err();
            assert_eq!(check(&support, bytes), Err(error));
        }
        // CDR may be padded to a multiple of four bytes.
        for bytes in [&empty[..], &longer[..longer.len() - 1]] {
            assert_eq!((decode(&support, bytes).is_ok(), check(&support, bytes)), (true, Ok(())));
        }
    }

    #[test]
    fn both_byte_orders_are_read() {
        let support = TypeSupport::from_schema("acme/msg/Pair", "int16 a\nfloat32[] b\n").unwrap();
        let big = [0, 0, 0, 0, 0xff, 0xfe, 0, 0, 0, 0, 0, 1, 0x3f, 0x80, 0, 0];
        let fields = [
            ("a".to_owned(), Value::Integer(-2)),
            ("b".to_owned(), Value::List(vec![Value::Single(1.0)])),
        ];
        assert_eq!(decode(&support, &big), Ok(Value::Map(fields.to_vec())));
        assert_eq!(check(&support, &big), Ok(()));
        check(&support, &big[..15]).unwrap_err();
    }

    #[test]
    fn types_with_wide_strings_are_not_decoded() {
        for (text, expected) in [
            ("int8 a\nstring b\nstd_msgs/Header c\n", true),
            ("wstring a\n", false),
            ("wstring[<=3] a\n", false),
        ] {
            let support = TypeSupport::from_schema("acme/msg/Text", text).unwrap();
            assert_eq!(is_decodable(&support), expected, "{text}");
        }
    }
}
