//! The `.msg` language (docs.ros.org, "Interfaces"): parsed into a type description, and written from one.
//!
//! MCAP's `ros2msg` is the text of a message, then that of each dependency after a line of 80 `=` and a line
//! `MSG: package/Type` (MCAP specification, appendix "ros2msg").

use hiroz_schema::{FieldDescription, FieldTypeDescription, TypeDescription, TypeId};

/// Shortest line of `=` before a dependency; rosbag2 and rosbags write 80.
const SEPARATOR: &str = "================";
/// Names of dependencies follow it.
const MSG: &str = "MSG: ";

/// A message definition that cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[expect(missing_docs, reason = "the message of each variant says what its fields are")]
pub enum InvalidDefinition {
    /// A line is not a field, constant or comment.
    #[error(
        "definition of {type_name}: found `{line}`, expected a field `type name` or a constant"
    )]
    Line { type_name: String, line: String },
    /// The definition of a referenced type, or of the type itself, is missing.
    #[error("definition of {type_name}: found none, expected one for {of}")]
    Missing { type_name: String, of: String },
    /// The definition has another hash than the publisher announces.
    #[error("definition of {type_name}: found type hash {found}, expected {expected}")]
    Hash { type_name: String, found: String, expected: String },
}

/// Splits a `ros2msg` text: each part with its name; the first has none unless it begins with `MSG:`.
pub(crate) fn parts(text: &str) -> Vec<(Option<&str>, &str)> {
    let mut parts = Vec::new();
    let (mut begin, mut at) = (0, 0);
    for line in text.split_inclusive('\n') {
        if line.starts_with(SEPARATOR) && line.trim_end().bytes().all(|byte| byte == b'=') {
            parts.push(&text[begin..at]);
            begin = at + line.len();
        }
        at += line.len();
    }
    parts.push(&text[begin..]);
    let named = parts.into_iter().enumerate().filter_map(|(index, part)| {
        match part.strip_prefix(MSG).map(|part| part.split_once('\n').unwrap_or((part, ""))) {
            Some((name, body)) => Some((Some(name.trim()), body)),
            None => (index == 0 && !part.trim().is_empty()).then_some((None, part)),
        }
    });
    named.collect()
}

/// `geometry_msgs/Twist` is `geometry_msgs/msg/Twist`; longer names are unchanged.
pub(crate) fn full_name(name: &str) -> String {
    match name.split_once('/') {
        Some((package, last)) if !last.contains('/') => format!("{package}/msg/{last}"),
        _ => name.to_owned(),
    }
}

/// The name in a `.msg` file: `geometry_msgs/msg/Twist` is `geometry_msgs/Twist`.
pub(crate) fn short_name(name: &str) -> String {
    name.replacen("/msg/", "/", 1)
}

/// Parses a `.msg` text: comments and constants are skipped, defaults ignored.
pub(crate) fn parse(name: &str, text: &str) -> Result<TypeDescription, InvalidDefinition> {
    let package = name.split('/').next().unwrap_or_default();
    let invalid =
        |line: &str| InvalidDefinition::Line { type_name: name.to_owned(), line: line.to_owned() };
    let mut fields = Vec::new();
    for line in text.lines().map(|line| without_comment(line).trim()) {
        if line.is_empty() {
            continue;
        }
        let (kind, rest) = line.split_once(char::is_whitespace).ok_or_else(|| invalid(line))?;
        let rest = rest.trim_start();
        let end = rest.find(|c: char| !c.is_ascii_alphanumeric() && c != '_').unwrap_or(rest.len());
        let (field_name, rest) = rest.split_at(end);
        if field_name.is_empty() {
            return Err(invalid(line));
        }
        if !rest.trim_start().starts_with('=') {
            let kind = field_type(package, kind).ok_or_else(|| invalid(line))?;
            fields.push(field(field_name, kind));
        }
    }
    if fields.is_empty() {
        // IDL has no empty structs: the message is this byte on the wire.
        let byte = FieldTypeDescription::primitive(TypeId::UINT8);
        fields.push(field("structure_needs_at_least_one_member", byte));
    }
    Ok(TypeDescription { type_name: name.to_owned(), fields })
}

/// The line before a `#` that is not in quotation marks.
fn without_comment(line: &str) -> &str {
    let mut quote = None;
    for (at, c) in line.char_indices() {
        match (quote, c) {
            (None, '#') => return &line[..at],
            (None, '"' | '\'') => quote = Some(c),
            (Some(open), _) if open == c => quote = None,
            _ => {}
        }
    }
    line
}

pub(crate) fn field(name: &str, field_type: FieldTypeDescription) -> FieldDescription {
    FieldDescription { name: name.to_owned(), field_type, default_value: String::new() }
}

/// Primitive types with their names in `.msg` files. `byte` is IDL's `octet`, `char` its `uint8`.
const PRIMITIVES: [(&str, u8); 16] = [
    ("bool", TypeId::BOOL),
    ("byte", TypeId::BYTE),
    ("char", TypeId::UINT8),
    ("int8", TypeId::INT8),
    ("uint8", TypeId::UINT8),
    ("int16", TypeId::INT16),
    ("uint16", TypeId::UINT16),
    ("int32", TypeId::INT32),
    ("uint32", TypeId::UINT32),
    ("int64", TypeId::INT64),
    ("uint64", TypeId::UINT64),
    ("float32", TypeId::FLOAT32),
    ("float64", TypeId::FLOAT64),
    ("string", TypeId::STRING),
    ("wstring", TypeId::WSTRING),
    ("wchar", WCHAR),
];

/// `FIELD_TYPE_WCHAR` of `type_description_interfaces/msg/FieldType`, which hiroz-schema lacks.
const WCHAR: u8 = 14;

fn field_type(package: &str, kind: &str) -> Option<FieldTypeDescription> {
    let (element, offset, capacity) = match kind.strip_suffix(']').and_then(|k| k.rsplit_once('['))
    {
        None => (kind, 0, 0),
        Some((element, "")) => (element, TypeId::UNBOUNDED_SEQUENCE_OFFSET, 0),
        Some((element, bound)) => match bound.strip_prefix("<=") {
            Some(most) => (element, TypeId::BOUNDED_SEQUENCE_OFFSET, most.parse().ok()?),
            None => (element, TypeId::ARRAY_OFFSET, bound.parse().ok()?),
        },
    };
    if let Some((string, most)) = element.split_once("<=") {
        let bounded = match string {
            "string" => TypeId::BOUNDED_STRING,
            "wstring" => TypeId::BOUNDED_WSTRING,
            _ => return None,
        };
        let string_capacity = most.parse().ok()?;
        let of = FieldTypeDescription::array(bounded + offset, capacity);
        return Some(FieldTypeDescription { string_capacity, ..of });
    }
    if let Some((_, primitive)) = PRIMITIVES.iter().find(|(name, _)| *name == element) {
        return Some(FieldTypeDescription::array(primitive + offset, capacity));
    }
    let is_name = |part: &str| {
        !part.is_empty() && part.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'_')
    };
    if !element.split('/').all(is_name) {
        return None;
    }
    let name =
        if element.contains('/') { full_name(element) } else { format!("{package}/msg/{element}") };
    Some(FieldTypeDescription::nested_array(TypeId::NESTED_TYPE + offset, capacity, name))
}

/// The `.msg` text of a type description; the inverse of [`parse`] without constants and comments. `None` if a field
/// has a type that the language lacks.
pub(crate) fn render(description: &TypeDescription) -> Option<String> {
    let line = |field: &FieldDescription| {
        let kind = kind_of(&field.field_type)?;
        Some(format!("{kind} {}\n", field.name))
    };
    description.fields.iter().map(line).collect()
}

fn kind_of(kind: &FieldTypeDescription) -> Option<String> {
    let FieldTypeDescription { type_id, capacity, string_capacity, nested_type_name } = kind;
    let offsets = [
        TypeId::UNBOUNDED_SEQUENCE_OFFSET,
        TypeId::BOUNDED_SEQUENCE_OFFSET,
        TypeId::ARRAY_OFFSET,
        0,
    ];
    let offset = offsets.into_iter().find(|offset| type_id > offset)?;
    let element = match type_id - offset {
        TypeId::NESTED_TYPE => short_name(nested_type_name),
        TypeId::BOUNDED_STRING => format!("string<={string_capacity}"),
        TypeId::BOUNDED_WSTRING => format!("wstring<={string_capacity}"),
        primitive => PRIMITIVES
            .iter()
            .rfind(|(_, id)| *id == primitive)
            .map(|(name, _)| (*name).to_owned())?,
    };
    Some(match offset {
        0 => element,
        TypeId::UNBOUNDED_SEQUENCE_OFFSET => format!("{element}[]"),
        TypeId::BOUNDED_SEQUENCE_OFFSET => format!("{element}[<={capacity}]"),
        _ => format!("{element}[{capacity}]"),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::library;

    #[test]
    fn fields_and_constants_are_told_apart() {
        let text = "# a comment\nuint8 A=1 # = one\nstring<=10 bounded \"a=b # c\"\nint32[<=3] list [1, 2]\n\
                    string MOTTO = 'x#y'\nNested[2] pair\nother/Type[] many\nwstring wide\n";
        let description = parse("acme/msg/Test", text).unwrap();
        let fields: Vec<_> = description
            .fields
            .iter()
            .map(|field| (field.name.as_str(), kind_of(&field.field_type).unwrap()))
            .collect();
        let expected = [
            ("bounded", "string<=10"),
            ("list", "int32[<=3]"),
            ("pair", "acme/Nested[2]"),
            ("many", "other/Type[]"),
            ("wide", "wstring"),
        ]
        .map(|(name, kind)| (name, kind.to_owned()));
        assert_eq!(fields, expected);
    }

    #[test]
    fn invalid_lines_are_named() {
        for line in ["float64", "int32[x] a", "int32[ a", "string<=many a", "a/!b c", "int32 =3"] {
            let message = parse("acme/msg/Test", line).unwrap_err().to_string();
            assert!(message.contains(&format!("acme/msg/Test: found `{line}`")), "{message}");
        }
    }

    #[test]
    fn every_built_in_definition_is_written_and_read_back() {
        for name in library::names() {
            let read = parse(name, library::text_of(name).unwrap()).unwrap();
            let again = parse(name, &render(&read).unwrap()).unwrap();
            assert_eq!(format!("{read:?}"), format!("{again:?}"));
        }
    }

    #[test]
    fn parts_begin_after_separators() {
        let separator = "=".repeat(80);
        let text = format!("int8 a\n{separator}\nMSG: a/B\nint8 b\n{separator}\nMSG: a/msg/C\n");
        let expected = [(None, "int8 a\n"), (Some("a/B"), "int8 b\n"), (Some("a/msg/C"), "")];
        assert_eq!(parts(&text), expected);
        assert_eq!(parts("").len(), 0);
    }
}
