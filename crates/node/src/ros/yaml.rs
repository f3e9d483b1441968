//! YAML values as ROS parses them: `on` and `yes` are true, lists hold values of one type.

use std::fmt;

use serde::{
    Deserialize, Deserializer,
    de::{MapAccess, SeqAccess, Visitor},
};

use eddy_messages::{dynamic::Value, services::ParameterValue};

/// Parses YAML as rcl does: `010` is 8, `1_000` a string.
pub(crate) fn read(text: &str) -> Result<Yaml, serde_saphyr::Error> {
    let options = serde_saphyr::options! {
        legacy_octal_numbers: true,
        underscored_numbers_as_strings: true,
        non_finite_float_policy: serde_saphyr::NonFiniteFloatPolicy::PassThrough,
    };
    serde_saphyr::from_str_with_options(text, options)
}

/// An error without advice on settings of the library, in one line.
pub(super) fn words(error: &serde_saphyr::Error) -> String {
    let text = error.without_snippet().render_with_formatter(&serde_saphyr::UserMessageFormatter);
    text.lines().next().unwrap_or_default().to_owned()
}

/// A YAML value.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Yaml {
    Nothing,
    Bool(bool),
    Integer(i64),
    Double(f64),
    Text(String),
    List(Vec<Yaml>),
    Map(Vec<(String, Yaml)>),
}

impl Yaml {
    /// As the value of a message; `None` if a value is missing. Nothing at all is a message without values.
    pub(crate) fn into_dynamic(self) -> Option<Value> {
        fn value(yaml: Yaml) -> Option<Value> {
            Some(match yaml {
                Yaml::Nothing => return None,
                Yaml::Bool(value) => Value::Bool(value),
                Yaml::Integer(value) => Value::Integer(value),
                Yaml::Double(value) => Value::Double(value),
                Yaml::Text(value) => Value::Text(value),
                Yaml::List(items) => {
                    Value::List(items.into_iter().map(value).collect::<Option<_>>()?)
                }
                Yaml::Map(entries) => {
                    let entries =
                        entries.into_iter().map(|(name, yaml)| Some((name, value(yaml)?)));
                    Value::Map(entries.collect::<Option<_>>()?)
                }
            })
        }
        match self {
            Self::Nothing => Some(Value::Map(Vec::new())),
            other => value(other),
        }
    }

    /// As the value of a parameter; otherwise a description of what was found.
    pub(super) fn into_value(self) -> Result<ParameterValue, String> {
        match self {
            Self::Nothing => Err("nothing".to_owned()),
            Self::Bool(value) => Ok(ParameterValue::bool(value)),
            Self::Integer(value) => Ok(ParameterValue::integer(value)),
            Self::Double(value) => Ok(ParameterValue::double(value)),
            Self::Text(value) => Ok(ParameterValue::string(value)),
            Self::List(items) => list(&items).ok_or_else(|| "a list of mixed types".to_owned()),
            Self::Map(_) => Err("a map".to_owned()),
        }
    }
}

/// A list of values of one type.
fn list(items: &[Yaml]) -> Option<ParameterValue> {
    fn all<T>(items: &[Yaml], one: impl Fn(&Yaml) -> Option<T>) -> Option<Vec<T>> {
        items.iter().map(one).collect()
    }
    let bools = || all(items, |item| if let Yaml::Bool(b) = item { Some(*b) } else { None });
    let integers = || all(items, |item| if let Yaml::Integer(i) = item { Some(*i) } else { None });
    let doubles = || all(items, |item| if let Yaml::Double(d) = item { Some(*d) } else { None });
    let strings =
        || all(items, |item| if let Yaml::Text(t) = item { Some(t.clone()) } else { None });
    bools()
        .map(ParameterValue::bools)
        .or_else(|| integers().map(ParameterValue::integers))
        .or_else(|| doubles().map(ParameterValue::doubles))
        .or_else(|| strings().map(ParameterValue::strings))
}

impl<'de> Deserialize<'de> for Yaml {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(AnyYaml)
    }
}

struct AnyYaml;

impl<'de> Visitor<'de> for AnyYaml {
    type Value = Yaml;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("YAML")
    }

    fn visit_unit<E>(self) -> Result<Yaml, E> {
        Ok(Yaml::Nothing)
    }

    fn visit_none<E>(self) -> Result<Yaml, E> {
        Ok(Yaml::Nothing)
    }

    fn visit_some<D: Deserializer<'de>>(self, some: D) -> Result<Yaml, D::Error> {
        Yaml::deserialize(some)
    }

    fn visit_bool<E>(self, value: bool) -> Result<Yaml, E> {
        Ok(Yaml::Bool(value))
    }

    fn visit_i64<E>(self, value: i64) -> Result<Yaml, E> {
        Ok(Yaml::Integer(value))
    }

    /// Numbers beyond the largest ROS integer are doubles, as in rcl.
    fn visit_u64<E>(self, value: u64) -> Result<Yaml, E> {
        Ok(i64::try_from(value).map_or(Yaml::Double(value as f64), Yaml::Integer))
    }

    fn visit_f64<E>(self, value: f64) -> Result<Yaml, E> {
        Ok(Yaml::Double(value))
    }

    fn visit_str<E>(self, value: &str) -> Result<Yaml, E> {
        Ok(Yaml::Text(value.to_owned()))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<Yaml, A::Error> {
        let mut list = Vec::new();
        while let Some(item) = items.next_element()? {
            list.push(item);
        }
        Ok(Yaml::List(list))
    }

    fn visit_map<A: MapAccess<'de>>(self, mut entries: A) -> Result<Yaml, A::Error> {
        let mut map = Vec::new();
        while let Some(entry) = entries.next_entry()? {
            map.push(entry);
        }
        Ok(Yaml::Map(map))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn value(text: &str) -> Result<ParameterValue, String> {
        read(text).unwrap().into_value()
    }

    /// Checked against an rclpy 9.1.2 node with `-p`.
    #[test]
    fn values_have_the_type_that_ros_parses() {
        for (text, expected) in [
            ("20", ParameterValue::integer(20)),
            ("-3", ParameterValue::integer(-3)),
            ("0x10", ParameterValue::integer(16)),
            ("010", ParameterValue::integer(8)),
            ("+5", ParameterValue::integer(5)),
            ("1_000", ParameterValue::string("1_000".into())),
            ("1e3", ParameterValue::double(1e3)),
            ("9223372036854775808", ParameterValue::double(9_223_372_036_854_775_808.0)),
            ("2.0", ParameterValue::double(2.0)),
            (".inf", ParameterValue::double(f64::INFINITY)),
            ("true", ParameterValue::bool(true)),
            ("off", ParameterValue::bool(false)),
            ("y", ParameterValue::bool(true)),
            ("'true'", ParameterValue::string("true".into())),
            ("last", ParameterValue::string("last".into())),
            ("[1, 2]", ParameterValue::integers(vec![1, 2])),
            ("[a, b]", ParameterValue::strings(vec!["a".into(), "b".into()])),
            ("[yes, no]", ParameterValue::bools(vec![true, false])),
            ("[1.5]", ParameterValue::doubles(vec![1.5])),
        ] {
            assert_eq!(value(text), Ok(expected), "{text}");
        }
    }

    #[test]
    fn other_values_are_described() {
        for (text, found) in
            [("[1, a]", "a list of mixed types"), ("{a: 1}", "a map"), ("~", "nothing")]
        {
            assert_eq!(value(text), Err(found.to_owned()), "{text}");
        }
    }
}
