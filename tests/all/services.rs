//! `eddy service` and `eddy param`, the lifecycle of a node, its log and its types, on the transports of ROS 2.

use std::process::{Command, Output};

use eddy_messages::{
    DiagnosticArray, Log, Message, QosProfile, cdr,
    lifecycle::TransitionEvent,
    qos::{DurabilityPolicy, HistoryPolicy, ReliabilityPolicy},
};
use eddy_transport::{Link, Subscriber, TransportKind, TransportOptions, Transports};

use crate::support::{DEADLINE, Process, domain, fail, free_port, talking_eddy, unique, wait_for};

/// A node in a world of its own.
struct World {
    transport: TransportKind,
    name: String,
    domain: u16,
    port: u16,
}

impl World {
    fn new(transport: TransportKind) -> Self {
        Self { transport, name: unique("served"), domain: domain(), port: free_port() }
    }

    /// How all but the node find it on Zenoh.
    fn overrides(&self) -> String {
        format!(r#"connect/endpoints=["tcp/127.0.0.1:{}"]"#, self.port)
    }

    fn node(&self, arguments: &[&str]) -> Process {
        let listen = format!(r#"listen/endpoints=["tcp/127.0.0.1:{}"]"#, self.port);
        let mut command = talking_eddy();
        command.env("ROS_DOMAIN_ID", self.domain.to_string()).env("ZENOH_CONFIG_OVERRIDE", listen);
        let link = |topic: &str| format!("{}:/{topic}", self.transport);
        command.args(["node", "--input", &link("particles"), "--output", &link("prediction")]);
        command.args(arguments);
        command.args(["--ros-args", "-r", &format!("__node:={}", self.name)]);
        command.args(["-p", "qos_overrides./diagnostics.publisher.durability:=transient_local"]);
        command.args(["-p", "qos_overrides./diagnostics.publisher.depth:=3"]);
        Process::start_until(&mut command, "predicting")
    }

    fn run(&self, arguments: &[&str]) -> Output {
        let mut command: Command = talking_eddy();
        command.env("ROS_DOMAIN_ID", self.domain.to_string());
        command.env("ZENOH_CONFIG_OVERRIDE", self.overrides());
        command.args(arguments).output().unwrap()
    }

    /// What a command prints.
    fn says(&self, arguments: &[&str]) -> String {
        let Output { status, stdout, stderr } = self.run(arguments);
        let errors = String::from_utf8_lossy(&stderr);
        assert!(status.success(), "{arguments:?}: {status}: {errors}");
        String::from_utf8(stdout).unwrap()
    }

    /// The errors of a command that fails.
    fn refuses(&self, arguments: &[&str]) -> String {
        let Output { status, stderr, .. } = self.run(arguments);
        assert_eq!(status.code(), Some(1), "{arguments:?}");
        String::from_utf8(stderr).unwrap()
    }

    /// The link of the node, or of a name below it.
    fn of_node(&self, below: &str) -> String {
        format!("{}:/{}{below}", self.transport, self.name)
    }

    fn call(&self, service: &str, request: &str) -> String {
        let service = self.of_node(&format!("/{service}"));
        match service.ends_with("change_state") {
            true => {
                let kind = "lifecycle_msgs/srv/ChangeState";
                self.says(&["service", "call", &service, kind, request])
            }
            false => self.says(&["service", "call", &service]),
        }
    }

    fn transports(&self) -> Transports {
        let mut options = TransportOptions::new("services_test");
        options.domain_id = self.domain;
        options.zenoh.overrides = self.overrides();
        Transports::new(options)
    }
}

const ROS: [TransportKind; 2] = [TransportKind::Zenoh, TransportKind::Dds];

#[test]
fn parameters_are_read_set_and_dumped() {
    for transport in ROS {
        let world = World::new(transport);
        let _node = world.node(&[]);
        let node = world.of_node("");
        let names = world.says(&["param", "list", &node]);
        let names: Vec<_> = names.lines().collect();
        assert!(names.contains(&"horizon") && names.is_sorted(), "{names:?}");
        assert_eq!(world.says(&["param", "get", &node, "horizon"]), "Integer value is: 1\n");
        let set = world.says(&["param", "set", &node, "horizon", "7"]);
        assert_eq!(set, "Set parameter successful\n");
        assert_eq!(world.says(&["param", "get", "--hide-type", &node, "horizon"]), "7\n");
        let refused = world.refuses(&["param", "set", &node, "horizon", "-1"]);
        assert!(
            refused.contains("horizon was not set: horizon: found -1, expected 1"),
            "{refused}"
        );
        let unknown = world.refuses(&["param", "get", &node, "depth"]);
        assert!(unknown.contains("parameter depth is not set"), "{unknown}");
        let dumped = world.says(&["param", "dump", &node]);
        assert!(dumped.contains("ros__parameters:") && dumped.contains("horizon: 7"), "{dumped}");
        let search = ["param", "list", "--from", transport.name(), "--wait", "1"];
        let nodes = wait_for("the node is listed", || {
            Some(world.says(&search)).filter(|nodes| nodes.contains(&node))
        });
        assert!(nodes.contains("\n  horizon\n"), "{nodes}");
    }
}

#[test]
fn services_are_listed_and_called() {
    for transport in ROS {
        let world = World::new(transport);
        let _node = world.node(&[]);
        let reset = world.of_node("/reset");
        assert_eq!(world.says(&["service", "type", &reset]), "std_srvs/srv/Trigger\n");
        let called = world.says(&["service", "call", &reset, "std_srvs/srv/Trigger", "{}"]);
        assert_eq!(called, "success: true\nmessage: 0 streams reset\n");
        let other = world.refuses(&["service", "call", &reset, "std_srvs/srv/SetBool"]);
        assert!(other.contains("found type std_srvs/srv/Trigger, expected std_srvs/srv/SetBool"));
        let list = world.of_node("/list_parameters");
        let request = ["service", "call", &list, "rcl_interfaces/srv/ListParameters"];
        let one = world.says(&[&request[..], &["{prefixes: [queue]}"]].concat());
        assert!(one.contains("- queue\n") && !one.contains("horizon"), "{one}");
        let wrong = world.refuses(&[&request[..], &["{prefixes: 3}"]].concat());
        assert!(wrong.contains("prefixes: found 3, expected a list"), "{wrong}");
        let none = ["service", "call", &world.of_node("/none"), "--timeout", "1"];
        let none = world.refuses(&none);
        assert!(none.contains("no such service within 1 s") && none.contains("/reset"), "{none}");
        let search = ["service", "list", "-t", "--from", transport.name(), "--wait", "1"];
        let expected = format!("{reset} [std_srvs/srv/Trigger]\n");
        wait_for("the service is listed", || world.says(&search).contains(&expected).then_some(()));
    }
}

#[test]
fn shared_memory_has_no_services() {
    for arguments in [
        &["service", "list", "--from", "shm"][..],
        &["service", "call", "shm:/a"],
        &["param", "list", "shm:/a"],
        &["node", "--lifecycle", "--input", "shm:/a", "--output", "shm:/b"],
    ] {
        let message = fail(2, arguments);
        assert!(message.contains("expected") && message.contains("zenoh or dds"), "{message}");
    }
}

fn next<M: Message>(subscriber: &mut dyn Subscriber) -> M {
    let payload = subscriber.receive(DEADLINE).unwrap().expect("a message comes");
    cdr::decode(&payload.into_cdr()).unwrap()
}

#[test]
fn a_managed_node_changes_its_state_and_says_so() {
    for transport in ROS {
        let world = World::new(transport);
        let transports = world.transports();
        let mut node = world.node(&["--lifecycle"]);
        let link = |topic: &str| -> Link { format!("{transport}:{topic}").parse().unwrap() };
        let events = link(&format!("/{}/transition_event", world.name));
        let mut events = transports.subscriber(&events, TransitionEvent::TYPE).unwrap();
        let mut diagnostics =
            transports.subscriber(&link("/diagnostics"), DiagnosticArray::TYPE).unwrap();
        let first: DiagnosticArray = next(&mut *diagnostics);
        assert_eq!(first.status[0].message, "unconfigured");
        let state = || world.call("get_state", "");
        assert!(state().contains("label: unconfigured"), "{}", state());
        let change = |label: &str| {
            world.call("change_state", &format!("{{transition: {{label: {label}}}}}"))
        };
        assert_eq!(change("activate"), "success: false\n");
        for (label, then) in [
            ("configure", "inactive"),
            ("activate", "active"),
            ("deactivate", "inactive"),
            ("shutdown", "finalized"),
        ] {
            assert_eq!(change(label), "success: true\n");
            assert!(state().contains(&format!("label: {then}\n")), "{}", state());
            let [to, done] = [(); 2].map(|()| next::<TransitionEvent>(&mut *events));
            assert_eq!(
                (to.transition.label.as_str(), done.goal_state.label.as_str()),
                (label, then)
            );
            assert!(done.timestamp > 0);
        }
        assert_eq!(world.call("get_available_transitions", ""), "available_transitions: []\n");
        // Its log, for a late subscriber.
        let mut log = transports.subscriber(&link("/rosout"), Log::TYPE).unwrap();
        let mut said = Vec::new();
        wait_for("the last transition is logged", || {
            let record: Log = next(&mut *log);
            assert_eq!(record.name, world.name, "{record:?}");
            // On a slow machine it waits long enough to warn that no frames come.
            let expected = if record.msg.contains("no frames") { 30 } else { 20 };
            assert_eq!(record.level, expected, "{record:?}");
            said.push(record.msg);
            said.last()?.ends_with("shuttingdown -> finalized").then_some(())
        });
        assert!(said.iter().any(|text| text.starts_with("predicting ")), "{said:?}");
        node.interrupt();
        assert!(node.wait().success());
    }
}

#[test]
fn the_qos_of_topics_and_their_types_are_told() {
    for transport in ROS {
        let world = World::new(transport);
        let transports = world.transports();
        let _node = world.node(&[]);
        let topic = |name: &str| {
            let link: Link = format!("{transport}:{name}").parse().unwrap();
            wait_for("the topic is seen", || {
                let topics = transports.topics(transport).unwrap();
                topics.into_iter().find(|topic| topic.link == link)
            })
        };
        let history = match transport {
            TransportKind::Dds => HistoryPolicy::Unknown,
            _ => HistoryPolicy::KeepLast(3),
        };
        let durability = DurabilityPolicy::TransientLocal;
        let expected = QosProfile { durability, history, ..QosProfile::default() };
        assert_eq!(topic("/diagnostics").offered, [expected]);
        assert_eq!(topic("/prediction").offered[0].reliability, ReliabilityPolicy::BestEffort);
        let mut seen = topic("/prediction");
        let known = seen.type_support();
        // DDS: RustDDS cannot announce the hash.
        seen.hash.get_or_insert(known.hash.clone());
        let described = wait_for("the node describes its type", || {
            transports.described_type(&seen, DEADLINE).unwrap()
        });
        assert_eq!((described.hash, described.schema), (known.hash, known.schema));
    }
}
