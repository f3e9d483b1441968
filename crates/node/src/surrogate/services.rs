//! The ROS services of the surrogate node: parameters, reset, types; the lifecycle of a managed node.

use std::{sync::Arc, time::Duration};

use serde::{Serialize, de::DeserializeOwned};

use super::{
    LifecycleState, NodeHandle, NodeRequest, NodeResponse, PARAMETERS, TRANSITIONS, parameter,
};
use crate::service::{Service, describe_types, handler};
use eddy_frames::counted;
use eddy_messages::{
    lifecycle::{
        ChangeStateRequest, GetAvailableStatesResponse, GetAvailableTransitionsResponse,
        GetStateResponse,
    },
    playback::Success,
    services::{
        DescribeParametersResponse, Empty, GetParameterTypesResponse, GetParametersResponse,
        ListParametersRequest, ListParametersResponse, Parameter, ParameterDescriptor,
        ParameterKind, ParameterNames, SetParametersAtomicallyResponse, SetParametersRequest,
        SetParametersResponse, SetParametersResult, TriggerResponse,
    },
};
use eddy_transport::Handler;

/// Time for the node to accept a request.
const TIMEOUT: Duration = Duration::from_secs(5);

/// The services of the node with the full name `node`, such as `/eddy_node`.
pub fn node_services(node: &str, handle: &Arc<NodeHandle>) -> Vec<Service> {
    let service = |name, type_name, handler| Service::of(node, name, type_name, handler);
    vec![
        service("reset", "std_srvs/srv/Trigger", answer(handle, reset)),
        service("get_parameters", "rcl_interfaces/srv/GetParameters", answer(handle, get)),
        service("set_parameters", "rcl_interfaces/srv/SetParameters", answer(handle, set)),
        service(
            "set_parameters_atomically",
            "rcl_interfaces/srv/SetParametersAtomically",
            answer(handle, set_atomically),
        ),
        service("list_parameters", "rcl_interfaces/srv/ListParameters", answer(handle, list)),
        service(
            "describe_parameters",
            "rcl_interfaces/srv/DescribeParameters",
            answer(handle, describe),
        ),
        service(
            "get_parameter_types",
            "rcl_interfaces/srv/GetParameterTypes",
            answer(handle, types),
        ),
        describe_types(node),
    ]
}

/// The services of a managed node.
pub fn lifecycle_services(node: &str, handle: &Arc<NodeHandle>) -> Vec<Service> {
    let service = |name, kind: &'static str, handler| Service::of(node, name, kind, handler);
    vec![
        service("change_state", "lifecycle_msgs/srv/ChangeState", answer(handle, change_state)),
        service("get_state", "lifecycle_msgs/srv/GetState", handler(handle, get_state)),
        service(
            "get_available_states",
            "lifecycle_msgs/srv/GetAvailableStates",
            answer(handle, all_states),
        ),
        service(
            "get_available_transitions",
            "lifecycle_msgs/srv/GetAvailableTransitions",
            handler(handle, transitions),
        ),
        service(
            "get_transition_graph",
            "lifecycle_msgs/srv/GetAvailableTransitions",
            answer(handle, all_transitions),
        ),
    ]
}

fn answer<A: DeserializeOwned + 'static, B: Serialize + 'static>(
    handle: &Arc<NodeHandle>,
    function: fn(&NodeHandle, A) -> B,
) -> Handler {
    handler(handle, move |handle, request| Some(function(handle, request)))
}

fn reset(handle: &NodeHandle, _: Empty) -> TriggerResponse {
    match handle.request(NodeRequest::Reset, TIMEOUT) {
        Ok(NodeResponse::Reset(streams)) => {
            let streams = counted(streams as u64, "stream");
            TriggerResponse { success: true, message: format!("{streams} reset") }
        }
        Ok(_) => TriggerResponse { success: true, message: String::new() },
        Err(error) => TriggerResponse { success: false, message: error.to_string() },
    }
}

fn get(handle: &NodeHandle, request: ParameterNames) -> GetParametersResponse {
    let settings = match handle.request(NodeRequest::Settings, TIMEOUT) {
        Ok(NodeResponse::Settings(settings)) => Some(settings),
        _ => None,
    };
    let value = |name: &String| {
        let (spec, settings) = (parameter(name)?, settings.as_ref()?);
        Some(spec.get(settings))
    };
    let values = request.names.iter().map(|name| value(name).unwrap_or_default());
    GetParametersResponse { values: values.collect() }
}

fn types(_: &NodeHandle, request: ParameterNames) -> GetParameterTypesResponse {
    let kind = |name: &String| match parameter(name) {
        Some(spec) => spec.values.kind() as u8,
        None => ParameterKind::NotSet as u8,
    };
    GetParameterTypesResponse { types: request.names.iter().map(kind).collect() }
}

fn list(_: &NodeHandle, request: ListParametersRequest) -> ListParametersResponse {
    // Names have no dots, so that a prefix matches only the parameter of the same name.
    let wanted = |name: &&str| {
        request.prefixes.is_empty() || request.prefixes.iter().any(|prefix| prefix == name)
    };
    let names = PARAMETERS.iter().map(|spec| spec.name).filter(wanted).map(str::to_owned);
    ListParametersResponse { names: names.collect(), prefixes: Vec::new() }
}

fn describe(_: &NodeHandle, request: ParameterNames) -> DescribeParametersResponse {
    let descriptor = |name: String| match parameter(&name) {
        Some(spec) => spec.descriptor(),
        None => ParameterDescriptor { name, ..ParameterDescriptor::default() },
    };
    DescribeParametersResponse { descriptors: request.names.into_iter().map(descriptor).collect() }
}

/// Sets each parameter independently of the others.
fn set(handle: &NodeHandle, request: SetParametersRequest) -> SetParametersResponse {
    let each = request.parameters.into_iter();
    SetParametersResponse { results: each.map(|one| set_all(handle, vec![one])).collect() }
}

fn set_atomically(
    handle: &NodeHandle,
    request: SetParametersRequest,
) -> SetParametersAtomicallyResponse {
    SetParametersAtomicallyResponse { result: set_all(handle, request.parameters) }
}

fn set_all(handle: &NodeHandle, parameters: Vec<Parameter>) -> SetParametersResult {
    match handle.request(NodeRequest::Set(parameters), TIMEOUT) {
        Ok(_) => SetParametersResult { successful: true, reason: String::new() },
        Err(error) => SetParametersResult { successful: false, reason: error.to_string() },
    }
}

fn change_state(handle: &NodeHandle, request: ChangeStateRequest) -> Success {
    let changed = handle.request(NodeRequest::ChangeState(request.transition), TIMEOUT);
    Success { success: changed == Ok(NodeResponse::ChangeState(true)) }
}

fn state(handle: &NodeHandle) -> Option<LifecycleState> {
    match handle.request(NodeRequest::State, TIMEOUT) {
        Ok(NodeResponse::State(state)) => state,
        _ => None,
    }
}

fn get_state(handle: &NodeHandle, _: Empty) -> Option<GetStateResponse> {
    state(handle).map(|state| GetStateResponse { current_state: state.into() })
}

fn all_states(_: &NodeHandle, _: Empty) -> GetAvailableStatesResponse {
    GetAvailableStatesResponse { available_states: LifecycleState::ALL.map(Into::into).to_vec() }
}

fn transitions(handle: &NodeHandle, _: Empty) -> Option<GetAvailableTransitionsResponse> {
    let from_here = state(handle)?.transitions().map(Into::into);
    Some(GetAvailableTransitionsResponse { available_transitions: from_here.collect() })
}

fn all_transitions(_: &NodeHandle, _: Empty) -> GetAvailableTransitionsResponse {
    let all = TRANSITIONS.iter().map(Into::into);
    GetAvailableTransitionsResponse { available_transitions: all.collect() }
}
