//! Values from CDR.

use hiroz_schema::{FieldTypeDescription, TypeId};

use super::{Count, InvalidValue, Value, described, element_of, unsupported};
use crate::{
    TypeSupport,
    cdr::{HEADER, MAX_PADDING},
};

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
