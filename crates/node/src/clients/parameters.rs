//! The parameters of a node, by its services (`rcl_interfaces`).

use std::{collections::BTreeSet, time::Duration};

use serde::{Serialize, de::DeserializeOwned};

use super::{ClientError, find_service};
use crate::ros::InvalidArgument;
use eddy_messages::{
    cdr,
    dynamic::Value,
    services::{
        GetParametersResponse, ListParametersRequest, ListParametersResponse, Parameter,
        ParameterKind, ParameterNames, ParameterValue, SetParametersRequest, SetParametersResponse,
        SetParametersResult,
    },
};
use eddy_transport::{Link, SeenService, TransportError, TransportKind, Transports};

/// Name of the service that lists the parameters of a node.
const LIST: &str = "list_parameters";

/// The nodes on a transport that have parameters.
///
/// # Errors
/// [`TransportError`] when the transport cannot list its services.
pub fn nodes_with_parameters(
    transports: &Transports,
    transport: TransportKind,
) -> Result<BTreeSet<Link>, TransportError> {
    let services = transports.services(transport)?;
    let node = |service: &SeenService| {
        let name = service.link.topic.strip_suffix(&format!("/{LIST}"))?;
        Some(service.link.with_topic(name))
    };
    Ok(services.iter().filter_map(node).collect())
}

/// A node whose parameters are read and set.
pub struct ParameterClient<'a> {
    transports: &'a Transports,
    /// Transport and full name of the node.
    node: Link,
    timeout: Duration,
}

impl<'a> ParameterClient<'a> {
    /// The node at `node`, once it offers its parameters. `None` when `is_stopped` first.
    ///
    /// # Errors
    /// [`ClientError`] when there is no such node within `timeout`.
    pub fn open(
        transports: &'a Transports,
        node: Link,
        timeout: Duration,
        is_stopped: impl Fn() -> bool,
    ) -> Result<Option<Self>, ClientError> {
        let list = node.with_topic(&format!("{}/{LIST}", node.topic));
        let found = find_service(transports, &list, timeout, is_stopped)?;
        Ok(found.map(|_| Self { transports, node, timeout }))
    }

    /// The names of all parameters, sorted.
    ///
    /// # Errors
    /// [`ClientError`].
    pub fn names(&self) -> Result<Vec<String>, ClientError> {
        let all = ListParametersRequest::default();
        let response: ListParametersResponse = self.call(LIST, "ListParameters", &all)?;
        let mut names = response.names;
        names.sort();
        Ok(names)
    }

    /// The values of parameters; of kind `NotSet` for those that the node does not have.
    ///
    /// # Errors
    /// [`ClientError`].
    pub fn values(&self, names: Vec<String>) -> Result<Vec<ParameterValue>, ClientError> {
        let names = ParameterNames { names };
        let response: GetParametersResponse =
            self.call("get_parameters", "GetParameters", &names)?;
        Ok(response.values)
    }

    /// Sets a parameter.
    ///
    /// # Errors
    /// [`ClientError`]; that the node rejects the value is a result.
    pub fn set(&self, parameter: Parameter) -> Result<SetParametersResult, ClientError> {
        let request = SetParametersRequest { parameters: vec![parameter] };
        let response: SetParametersResponse =
            self.call("set_parameters", "SetParameters", &request)?;
        let mut results = response.results;
        results.pop().ok_or_else(|| self.invalid("SetParameters", "found no result"))
    }

    /// All parameters as a file for `--params-file`.
    ///
    /// # Errors
    /// [`ClientError`].
    pub fn dump(&self) -> Result<Value, ClientError> {
        let names = self.names()?;
        let values = self.values(names.clone())?;
        let parameters = names.into_iter().zip(&values);
        let parameters = parameters.filter_map(|(name, value)| Some((name, dynamic(value)?)));
        let parameters = Value::Map(parameters.collect());
        let below = Value::Map(vec![("ros__parameters".to_owned(), parameters)]);
        Ok(Value::Map(vec![(self.node.topic.clone(), below)]))
    }

    fn call<B: DeserializeOwned>(
        &self,
        name: &str,
        kind: &str,
        request: &impl Serialize,
    ) -> Result<B, ClientError> {
        let link = self.node.with_topic(&format!("{}/{name}", self.node.topic));
        let type_name = format!("rcl_interfaces/srv/{kind}");
        let service = SeenService { link, type_name, hash: None };
        let response = self.transports.call(&service, &cdr::encode(request), self.timeout)?;
        let (link, timeout) = (service.link, self.timeout);
        let response = response.ok_or(ClientError::NoResponse { link, timeout })?;
        cdr::decode(&response).map_err(|error| self.invalid(kind, &error.to_string()))
    }

    fn invalid(&self, kind: &str, reason: &str) -> ClientError {
        ClientError::Response {
            link: self.node.clone(),
            type_name: format!("rcl_interfaces/srv/{kind}"),
            reason: reason.to_owned(),
        }
    }
}

/// A value as `-p` and parameter files have it.
fn dynamic(value: &ParameterValue) -> Option<Value> {
    let list = |values: Vec<Value>| Some(Value::List(values));
    match value.kind().ok()? {
        ParameterKind::NotSet => None,
        ParameterKind::Bool => Some(Value::Bool(value.bool_value)),
        ParameterKind::Integer => Some(Value::Integer(value.integer_value)),
        ParameterKind::Double => Some(Value::Double(value.double_value)),
        ParameterKind::String => Some(Value::Text(value.string_value.clone())),
        ParameterKind::Bytes => {
            list(value.byte_array_value.iter().map(|&byte| Value::Unsigned(byte.into())).collect())
        }
        ParameterKind::Bools => {
            list(value.bool_array_value.iter().copied().map(Value::Bool).collect())
        }
        ParameterKind::Integers => {
            list(value.integer_array_value.iter().copied().map(Value::Integer).collect())
        }
        ParameterKind::Doubles => {
            list(value.double_array_value.iter().copied().map(Value::Double).collect())
        }
        ParameterKind::Strings => {
            list(value.string_array_value.iter().cloned().map(Value::Text).collect())
        }
    }
}

/// A value in the words of `ros2 param get`: its type and the value. `None` if the parameter is not set.
pub fn value_text(value: &ParameterValue) -> Option<(&'static str, String)> {
    let name = match value.kind().ok()? {
        ParameterKind::NotSet => return None,
        ParameterKind::Bool => "Boolean",
        ParameterKind::Integer => "Integer",
        ParameterKind::Double => "Double",
        ParameterKind::String => "String",
        ParameterKind::Bytes => "Byte values",
        ParameterKind::Bools => "Boolean values",
        ParameterKind::Integers => "Integer values",
        ParameterKind::Doubles => "Double values",
        ParameterKind::Strings => "String values",
    };
    Some((name, text(&dynamic(value)?)))
}

/// As Python prints it.
fn text(value: &Value) -> String {
    match value {
        Value::Bool(value) => if *value { "True" } else { "False" }.to_owned(),
        Value::Integer(value) => value.to_string(),
        Value::Unsigned(value) => value.to_string(),
        Value::Single(value) => format!("{value:?}"),
        Value::Double(value) => format!("{value:?}"),
        Value::Text(value) => value.clone(),
        Value::List(values) => {
            format!("[{}]", values.iter().map(text).collect::<Vec<_>>().join(", "))
        }
        Value::Map(_) => String::new(), // not a value of a parameter
    }
}

/// The value in a command line, with the type that ROS gives it.
///
/// # Errors
/// [`InvalidArgument`].
pub fn parse_value(text: &str) -> Result<ParameterValue, InvalidArgument> {
    let given = crate::ros::parse_parameter(&format!("value:={text}"))?;
    Ok(given.parameter.value)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_printed_as_by_ros2() {
        for (value, name, text) in [
            (ParameterValue::bool(true), "Boolean", "True"),
            (ParameterValue::integer(-3), "Integer", "-3"),
            (ParameterValue::double(2.0), "Double", "2.0"),
            (ParameterValue::string("last".into()), "String", "last"),
            (ParameterValue::integers(vec![1, 2]), "Integer values", "[1, 2]"),
        ] {
            assert_eq!(value_text(&value), Some((name, text.to_owned())));
        }
        assert_eq!(value_text(&ParameterValue::default()), None);
    }

    #[test]
    fn a_value_has_the_type_that_ros_gives_it() {
        assert_eq!(parse_value("3").unwrap(), ParameterValue::integer(3));
        assert_eq!(parse_value("3.0").unwrap(), ParameterValue::double(3.0));
        assert_eq!(parse_value("on").unwrap(), ParameterValue::bool(true));
        assert_eq!(parse_value("all").unwrap(), ParameterValue::string("all".into()));
        parse_value("[1, a]").unwrap_err();
    }
}
