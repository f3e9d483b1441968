//! Values and bytes, each from the other.

use super::*;
use crate::{
    DiagnosticArray, DiagnosticStatus, Header, KeyValue, Message, ParticleFrame,
    cdr::{self, HEADER},
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
