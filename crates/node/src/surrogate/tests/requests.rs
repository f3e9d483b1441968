//! Requests to a running node: parameters and resets, directly and through its services.

use std::{sync::Arc, thread, time::Duration};

use serde::{Serialize, de::DeserializeOwned};

use super::{directly, feed, feed_all, frame, node};
use crate::{
    InvalidSettings, NodeHandle, NodeRequest, NodeSettings, PARAMETERS, Publish, RequestError,
    Service, SurrogateNode, surrogate::node_services,
};
use eddy_frames::Frame;
use eddy_messages::{
    cdr,
    services::{
        DescribeParametersResponse, Empty, GetParameterTypesResponse, GetParametersResponse,
        ListParametersRequest, ListParametersResponse, Parameter, ParameterNames, ParameterValue,
        SetParametersAtomicallyResponse, SetParametersRequest, SetParametersResponse,
        SetParametersResult, TriggerResponse,
    },
};

fn of(name: &str, value: ParameterValue) -> Parameter {
    Parameter { name: name.to_owned(), value }
}

#[test]
fn parameters_take_effect_with_the_next_frame_and_invalid_ones_change_nothing() {
    let mut node = node(NodeSettings::default());
    let sequences = |frames: Vec<Frame>| frames.iter().map(|f| f.sequence).collect::<Vec<_>>();
    assert_eq!(sequences(feed_all(&mut node, (0..3).map(|n| frame(1, n)))), [3]);
    node.set(&[of("horizon", ParameterValue::integer(5))]).unwrap();
    assert_eq!(sequences(feed(&mut node, frame(1, 3))), [8]);
    for frames in [0, 10_001] {
        let both = [
            of("publish", ParameterValue::string("all".into())),
            of("horizon", ParameterValue::integer(frames)),
        ];
        let error = node.set(&both).unwrap_err().to_string();
        assert_eq!(error, format!("horizon: found {frames}, expected 1 to 10000"));
    }
    assert_eq!(sequences(feed(&mut node, frame(1, 4))), [9]);
    node.set(&[of("publish", ParameterValue::string("all".into()))]).unwrap();
    assert_eq!(sequences(feed(&mut node, frame(1, 5))), [6, 7, 8, 9, 10]);
}

#[test]
fn fewer_streams_and_shorter_gaps_can_be_set_while_streams_run() {
    let mut node = node(NodeSettings::default());
    feed_all(&mut node, (0..3).flat_map(|n| [frame(1, n), frame(2, n)]));
    node.set(&[of("max_streams", ParameterValue::integer(1))]).unwrap();
    node.set(&[of("max_gap", ParameterValue::integer(0))]).unwrap();
    feed(&mut node, frame(2, 4));
    assert_eq!((node.streams(), node.counters().forgotten_streams), (1, 1));
    assert_eq!((node.counters().filled, node.counters().lost_in_gaps), (0, 1));
}

#[test]
fn a_free_run_set_while_running_begins_with_the_next_frame() {
    let mut node = node(NodeSettings::default());
    feed_all(&mut node, (0..5).map(|n| frame(1, n)));
    assert_eq!(node.next_tick(), None);
    node.set(&[of("free_run", ParameterValue::integer(4))]).unwrap();
    assert_eq!(feed(&mut node, frame(1, 5)), []);
    assert_eq!(node.next_tick(), Some(Duration::from_millis(16)));
    node.set(&[of("free_run", ParameterValue::integer(0))]).unwrap();
    assert_eq!(node.settings().free_run, None);
}

#[test]
fn a_reset_removes_every_stream_and_each_warms_up_again() {
    let mut node = node(NodeSettings::default());
    feed_all(&mut node, (0..3).flat_map(|n| [frame(1, n), frame(2, n)]));
    assert_eq!(node.reset(), 2);
    assert_eq!((node.streams(), node.counters().resets), (0, 2));
    let again = feed_all(&mut node, (3..6).map(|n| frame(1, n)));
    assert_eq!(again.len(), 1, "after the warm-up");
    let (_, _, fresh) = directly((3..6).map(|n| frame(1, n)));
    assert_eq!(again[0], fresh);
}

/// Serves requests until `client` is done, as the driver does between two frames.
fn serve(client: impl FnOnce(Vec<Service>) + Send) -> SurrogateNode {
    let mut node = node(NodeSettings::default());
    let handle = Arc::new(NodeHandle::default());
    let services = node_services("/robot1/eddy_node", &handle);
    thread::scope(|scope| {
        let client = scope.spawn(move || client(services));
        while !client.is_finished() {
            handle.serve(&mut node, |_, _| Ok(()));
            thread::yield_now();
        }
    });
    node
}

/// The response of the service `name`.
fn call<B: DeserializeOwned>(services: &mut [Service], name: &str, request: &impl Serialize) -> B {
    let name = format!("/robot1/eddy_node/{name}");
    let service = services.iter_mut().find(|service| service.name == name).unwrap();
    cdr::decode(&(service.handler)(&cdr::encode(request)).unwrap()).unwrap()
}

fn named(names: &[&str]) -> ParameterNames {
    ParameterNames { names: names.iter().map(|name| (*name).to_owned()).collect() }
}

#[test]
fn parameters_are_set_one_by_one_and_rejected_with_a_reason() {
    let node = serve(|mut services| {
        let parameters = vec![
            of("horizon", ParameterValue::integer(20)),
            of("horizon", ParameterValue::integer(0)),
            of("depth", ParameterValue::integer(1)),
            of("horizon", ParameterValue::string("9".into())),
            of("queue", ParameterValue::integer(9)),
            of("publish", ParameterValue::string("all".into())),
        ];
        let answer: SetParametersResponse =
            call(&mut services, "set_parameters", &SetParametersRequest { parameters });
        let reasons: Vec<_> =
            answer.results.iter().map(|r| (r.successful, r.reason.as_str())).collect();
        let unknown = "parameter: found depth, expected one of horizon, publish, free_run, max_gap, max_streams, max_expected_error, stiffness, queue, cloud, use_sim_time, group";
        assert_eq!(
            reasons,
            [
                (true, ""),
                (false, "horizon: found 0, expected 1 to 10000"),
                (false, unknown),
                (false, "horizon: found a string, expected an integer"),
                (false, "queue: read-only while the node runs; set it at the start"),
                (true, ""),
            ]
        );
        let names = named(&["horizon", "depth", "publish", "use_sim_time"]);
        let got: GetParametersResponse = call(&mut services, "get_parameters", &names);
        let expected = [
            ParameterValue::integer(20),
            ParameterValue::default(),
            ParameterValue::string("all".into()),
            ParameterValue::bool(false),
        ];
        assert_eq!(got.values, expected);
    });
    assert_eq!((node.settings().horizon, node.settings().publish), (20, Publish::All));
}

#[test]
fn parameters_are_listed_with_their_kinds_ranges_and_whether_they_are_read_only() {
    serve(|mut services| {
        let every = ListParametersRequest::default();
        let all: ListParametersResponse = call(&mut services, "list_parameters", &every);
        assert_eq!(all.names.len(), PARAMETERS.len());
        let one = ListParametersRequest { prefixes: vec!["queue".into()], depth: 0 };
        let listed: ListParametersResponse = call(&mut services, "list_parameters", &one);
        assert_eq!(listed.names, ["queue"]);
        let names = ParameterNames { names: all.names };
        let types: GetParameterTypesResponse = call(&mut services, "get_parameter_types", &names);
        let described: DescribeParametersResponse =
            call(&mut services, "describe_parameters", &names);
        for (descriptor, kind) in described.descriptors.iter().zip(types.types) {
            assert_eq!(descriptor.kind, kind, "{}", descriptor.name);
            assert!(!descriptor.description.is_empty());
        }
        let range = described.descriptors[0].integer_range[0];
        assert_eq!((range.from_value, range.to_value), (1, 10_000));
        let read_only = described.descriptors.iter().filter(|d| d.read_only);
        assert_eq!(
            read_only.map(|d| d.name.as_str()).collect::<Vec<_>>(),
            ["stiffness", "queue", "cloud", "group"]
        );
    });
}

#[test]
fn parameters_set_atomically_are_all_set_or_none() {
    let node = serve(|mut services| {
        let mut set = |last: Parameter| -> SetParametersResult {
            let parameters = vec![of("horizon", ParameterValue::integer(9)), last];
            let request = SetParametersRequest { parameters };
            let answer: SetParametersAtomicallyResponse =
                call(&mut services, "set_parameters_atomically", &request);
            answer.result
        };
        let rejected = set(of("max_gap", ParameterValue::integer(2_000)));
        assert_eq!(rejected.reason, "max_gap: found 2000, expected 0 to 1000");
        let got: GetParametersResponse =
            call(&mut services, "get_parameters", &named(&["horizon"]));
        assert_eq!(got.values, [ParameterValue::integer(1)]);
    });
    assert_eq!(node.settings(), &NodeSettings::default());
    let node = serve(|mut services| {
        let parameters = vec![
            of("horizon", ParameterValue::integer(9)),
            of("max_gap", ParameterValue::integer(2)),
        ];
        let answer: SetParametersAtomicallyResponse =
            call(&mut services, "set_parameters_atomically", &SetParametersRequest { parameters });
        assert!(answer.result.successful);
    });
    assert_eq!((node.settings().horizon, node.settings().max_gap), (9, 2));
}

#[test]
fn changed_parameters_are_returned_once() {
    let (mut node, handle) = (node(NodeSettings::default()), NodeHandle::default());
    let horizon = of("horizon", ParameterValue::integer(2));
    let changed = thread::scope(|scope| {
        let set = |parameter: &Parameter| {
            handle.request(NodeRequest::Set(vec![parameter.clone()]), Duration::from_secs(30))
        };
        let client = scope.spawn(move || {
            set(&horizon).unwrap();
            set(&of("horizon", ParameterValue::integer(0))).unwrap_err();
            horizon
        });
        let mut changed = Vec::new();
        while !client.is_finished() {
            changed.extend(handle.serve(&mut node, |_, _| Ok(())));
            thread::yield_now();
        }
        assert_eq!(changed, [client.join().unwrap()]);
        changed
    });
    assert_eq!(changed.len(), 1);
}

#[test]
fn parameters_that_cannot_be_applied_change_nothing() {
    let mut node = node(NodeSettings::default());
    let wanted =
        [of("horizon", ParameterValue::integer(7)), of("use_sim_time", ParameterValue::bool(true))];
    let outcome = node.set_and(&wanted, |_, settings| {
        assert!(settings.use_sim_time);
        Err(InvalidSettings::Clock { reason: "no memory".to_owned() })
    });
    let expected = "use_sim_time: cannot subscribe to /clock: no memory";
    assert_eq!(outcome.unwrap_err().to_string(), expected);
    assert_eq!(node.settings(), &NodeSettings::default());
}

#[test]
fn streams_are_reset_by_a_service_and_invalid_requests_get_no_response() {
    serve(|mut services| {
        let answer: TriggerResponse = call(&mut services, "reset", &Empty::default());
        assert_eq!((answer.success, answer.message.as_str()), (true, "0 streams reset"));
        for service in &mut services {
            assert_eq!((service.handler)(&[0, 1, 0]), None, "{}", service.name);
        }
    });
}

#[test]
fn a_request_to_a_node_that_does_not_answer_times_out() {
    let timeout = Duration::from_millis(10);
    let outcome = NodeHandle::default().request(NodeRequest::Reset, timeout);
    assert_eq!(outcome, Err(RequestError::Timeout { timeout }));
}
