//! The services of a node, as CDR in and CDR out: parameters and reset.
//!
//! What each service is called, what type it has and what it answers; a transport brings the bytes.

use std::{sync::Arc, time::Duration};

use serde::{Serialize, de::DeserializeOwned};

use super::{Answer, Control, PARAMETERS, Request, parameter};
use eddy_messages::{
    cdr,
    services::{
        DescribeParametersResponse, Empty, GetParameterTypesResponse, GetParametersResponse,
        ListParametersRequest, ListParametersResponse, Parameter, ParameterDescriptor,
        ParameterKind, ParameterNames, SetParametersAtomicallyResponse, SetParametersRequest,
        SetParametersResponse, SetParametersResult, TriggerResponse,
    },
};
use eddy_transport::Handler;

/// How long a node may take to begin with an answer.
const PATIENCE: Duration = Duration::from_secs(5);

/// A service of a node.
pub struct Service {
    /// Its absolute name, such as `/eddy_node/reset`.
    pub name: String,
    /// Its type, such as `std_srvs/srv/Trigger`.
    pub type_name: &'static str,
    /// Request to response.
    pub handler: Handler,
}

impl Service {
    /// The service `name` of the node with the full name `node`.
    pub(super) fn of(node: &str, name: &str, type_name: &'static str, handler: Handler) -> Self {
        Self { name: format!("{node}/{name}"), type_name, handler }
    }
}

/// The services of the node with the full name `node`, such as `/eddy_node`, which is asked through
/// `control`.
pub fn services(node: &str, control: &Arc<Control>) -> Vec<Service> {
    let service = |name, type_name, handler| Service::of(node, name, type_name, handler);
    vec![
        service("reset", "std_srvs/srv/Trigger", answer(control, reset)),
        service("get_parameters", "rcl_interfaces/srv/GetParameters", answer(control, get)),
        service("set_parameters", "rcl_interfaces/srv/SetParameters", answer(control, set)),
        service(
            "set_parameters_atomically",
            "rcl_interfaces/srv/SetParametersAtomically",
            answer(control, set_atomically),
        ),
        service("list_parameters", "rcl_interfaces/srv/ListParameters", answer(control, list)),
        service(
            "describe_parameters",
            "rcl_interfaces/srv/DescribeParameters",
            answer(control, describe),
        ),
        service(
            "get_parameter_types",
            "rcl_interfaces/srv/GetParameterTypes",
            answer(control, types),
        ),
    ]
}

/// The answer of a function of messages to a request in bytes.
fn answer<A: DeserializeOwned + 'static, B: Serialize + 'static>(
    control: &Arc<Control>,
    function: fn(&Control, A) -> B,
) -> Handler {
    handler(control, move |control, request| Some(function(control, request)))
}

/// Bytes around a function of messages. Bytes that are no request get no answer.
pub(super) fn handler<C: Send + Sync + 'static, A: DeserializeOwned, B: Serialize>(
    context: &Arc<C>,
    function: impl Fn(&C, A) -> Option<B> + Send + 'static,
) -> Handler {
    let context = Arc::clone(context);
    Box::new(move |request| match cdr::decode(request) {
        Ok(request) => function(&context, request).map(|response| cdr::encode(&response)),
        Err(error) => {
            tracing::warn!("request: {error}");
            None
        }
    })
}

fn reset(control: &Control, _: Empty) -> TriggerResponse {
    match control.ask(Request::Reset, PATIENCE) {
        Ok(Answer::Forgot(streams)) => {
            TriggerResponse { success: true, message: format!("{streams} streams were forgotten") }
        }
        Ok(_) => TriggerResponse { success: true, message: String::new() },
        Err(reason) => TriggerResponse { success: false, message: reason.to_string() },
    }
}

fn get(control: &Control, request: ParameterNames) -> GetParametersResponse {
    let settings = match control.ask(Request::Settings, PATIENCE) {
        Ok(Answer::Settings(settings)) => Some(settings),
        _ => None,
    };
    let value = |name: &String| {
        let (spec, settings) = (parameter(name)?, settings.as_ref()?);
        Some(spec.get(settings))
    };
    let values = request.names.iter().map(|name| value(name).unwrap_or_default());
    GetParametersResponse { values: values.collect() }
}

fn types(_: &Control, request: ParameterNames) -> GetParameterTypesResponse {
    let kind = |name: &String| match parameter(name) {
        Some(spec) => spec.values.kind() as u8,
        None => ParameterKind::NotSet as u8,
    };
    GetParameterTypesResponse { types: request.names.iter().map(kind).collect() }
}

fn list(_: &Control, request: ListParametersRequest) -> ListParametersResponse {
    // No name has a point in it: nothing is below a prefix but what is called like it.
    let wanted = |name: &&str| {
        request.prefixes.is_empty() || request.prefixes.iter().any(|prefix| prefix == name)
    };
    let names = PARAMETERS.iter().map(|spec| spec.name).filter(wanted).map(str::to_owned);
    ListParametersResponse { names: names.collect(), prefixes: Vec::new() }
}

fn describe(_: &Control, request: ParameterNames) -> DescribeParametersResponse {
    let descriptor = |name: String| match parameter(&name) {
        Some(spec) => spec.descriptor(),
        None => ParameterDescriptor { name, ..ParameterDescriptor::default() },
    };
    DescribeParametersResponse { descriptors: request.names.into_iter().map(descriptor).collect() }
}

/// Each for itself.
fn set(control: &Control, request: SetParametersRequest) -> SetParametersResponse {
    let each = request.parameters.into_iter();
    SetParametersResponse { results: each.map(|one| set_all(control, vec![one])).collect() }
}

fn set_atomically(
    control: &Control,
    request: SetParametersRequest,
) -> SetParametersAtomicallyResponse {
    SetParametersAtomicallyResponse { result: set_all(control, request.parameters) }
}

/// All or none.
fn set_all(control: &Control, parameters: Vec<Parameter>) -> SetParametersResult {
    match control.ask(Request::Set(parameters), PATIENCE) {
        Ok(_) => SetParametersResult { successful: true, reason: String::new() },
        Err(reason) => SetParametersResult { successful: false, reason: reason.to_string() },
    }
}
