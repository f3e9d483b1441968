//! CDR from values.

use hiroz_schema::{FieldTypeDescription, TypeId};

use super::{Count, InvalidValue, Value, described, element_of, invalid, unsuitable, unsupported};
use crate::{TypeSupport, cdr::HEADER};

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
