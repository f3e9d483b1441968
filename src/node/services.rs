//! The services of a node, as CDR in and CDR out: parameters and reset.
//!
//! What each service is called, what type it has and what it answers; a transport brings the bytes.

use std::{sync::Arc, time::Duration};

use serde::{Serialize, de::DeserializeOwned};

use super::{Answer, Control, HORIZON, Request, Unanswered};
use crate::{
    msg::{
        cdr,
        services::{
            DescribeParametersResponse, Empty, GetParameterTypesResponse, GetParametersResponse,
            INTEGER, IntegerRange, ListParametersRequest, ListParametersResponse, Parameter,
            ParameterDescriptor, ParameterNames, ParameterValue, SetParametersAtomicallyResponse,
            SetParametersRequest, SetParametersResponse, SetParametersResult, TriggerResponse,
        },
    },
    transport::Handler,
};

/// How long a node may take to answer.
const PATIENCE: Duration = Duration::from_secs(5);

/// The one parameter: frames predicted ahead of each observed frame.
const PARAMETER: &str = "horizon";

/// A service of a node.
pub struct Service {
    /// Its absolute name, such as `/eddy_node/reset`.
    pub name: String,
    /// Its type, such as `std_srvs/srv/Trigger`.
    pub type_name: &'static str,
    /// Request to response.
    pub handler: Handler,
}

/// The services of the node called `node`, which is asked through `control`.
pub fn services(node: &str, control: &Arc<Control>) -> Vec<Service> {
    let service = |name: &str, type_name, handler| Service {
        name: format!("/{node}/{name}"),
        type_name,
        handler,
    };
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

/// Bytes around a function of messages. Bytes that are no request get no answer.
fn answer<A: DeserializeOwned + 'static, B: Serialize + 'static>(
    control: &Arc<Control>,
    function: fn(&Control, A) -> B,
) -> Handler {
    let control = Arc::clone(control);
    Box::new(move |request| match cdr::decode(request) {
        Ok(request) => Some(cdr::encode(&function(&control, request))),
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
    // Asked once, however often it is named.
    let asked = request.names.iter().any(|name| name == PARAMETER);
    let horizon = asked.then(|| control.ask(Request::Horizon, PATIENCE));
    let value = |name: &String| match horizon {
        Some(Ok(Answer::Horizon(frames))) if name == PARAMETER => {
            ParameterValue::integer(frames.into())
        }
        _ => ParameterValue::default(),
    };
    GetParametersResponse { values: request.names.iter().map(value).collect() }
}

fn types(_: &Control, request: ParameterNames) -> GetParameterTypesResponse {
    let kind = |name: &String| if name == PARAMETER { INTEGER } else { 0 };
    GetParameterTypesResponse { types: request.names.iter().map(kind).collect() }
}

fn list(_: &Control, request: ListParametersRequest) -> ListParametersResponse {
    let wanted = request.prefixes.is_empty() || request.prefixes.iter().any(|p| p == PARAMETER);
    let names = if wanted { vec![PARAMETER.to_owned()] } else { Vec::new() };
    ListParametersResponse { names, prefixes: Vec::new() }
}

fn describe(_: &Control, request: ParameterNames) -> DescribeParametersResponse {
    let descriptor = |name: String| match name.as_str() {
        PARAMETER => ParameterDescriptor {
            name,
            kind: INTEGER,
            description: "frames predicted ahead of each observed frame".to_owned(),
            integer_range: vec![IntegerRange {
                from_value: (*HORIZON.start()).into(),
                to_value: (*HORIZON.end()).into(),
                step: 1,
            }],
            ..ParameterDescriptor::default()
        },
        _ => ParameterDescriptor { name, ..ParameterDescriptor::default() },
    };
    DescribeParametersResponse { descriptors: request.names.into_iter().map(descriptor).collect() }
}

fn set(control: &Control, request: SetParametersRequest) -> SetParametersResponse {
    let result = |parameter: &Parameter| set_one(control, parameter, false).into();
    SetParametersResponse { results: request.parameters.iter().map(result).collect() }
}

/// All or none: each is tried before the first is set.
fn set_atomically(
    control: &Control,
    request: SetParametersRequest,
) -> SetParametersAtomicallyResponse {
    let try_all =
        |dry| request.parameters.iter().try_for_each(|parameter| set_one(control, parameter, dry));
    SetParametersAtomicallyResponse { result: try_all(true).and_then(|()| try_all(false)).into() }
}

/// Why a parameter was not set.
#[derive(Debug, thiserror::Error)]
enum NotSet {
    #[error("parameter: found {found}, expected {PARAMETER}")]
    Unknown { found: String },
    #[error("{PARAMETER}: found a value of type {found}, expected an integer (type {INTEGER})")]
    Kind { found: u8 },
    #[error("{PARAMETER}: found {found}, expected {} to {}", HORIZON.start(), HORIZON.end())]
    Range { found: i64 },
    #[error(transparent)]
    Unanswered(#[from] Unanswered),
}

fn set_one(control: &Control, parameter: &Parameter, dry: bool) -> Result<(), NotSet> {
    let Parameter { name, value } = parameter;
    if name != PARAMETER {
        return Err(NotSet::Unknown { found: name.clone() });
    }
    if value.kind != INTEGER {
        return Err(NotSet::Kind { found: value.kind });
    }
    let found = value.integer_value;
    let frames = u32::try_from(found).map_err(|_| NotSet::Range { found })?;
    control.ask(Request::SetHorizon { frames, dry }, PATIENCE)?;
    Ok(())
}

impl From<Result<(), NotSet>> for SetParametersResult {
    fn from(outcome: Result<(), NotSet>) -> Self {
        match outcome {
            Ok(()) => Self { successful: true, reason: String::new() },
            Err(reason) => Self { successful: false, reason: reason.to_string() },
        }
    }
}
