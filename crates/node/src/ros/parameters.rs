//! Parameter overrides at startup: `-p name:=value`, and files such as
//!
//! ```yaml
//! /**:                  # every node
//!   ros__parameters:
//!     use_sim_time: true
//! robot1:               # a namespace, or a node if parameters follow
//!   eddy_node:
//!     ros__parameters:
//!       horizon: 10
//! ```

use std::{fs, path::Path};

use super::{
    InvalidArgument, TopicQos,
    remap::quoted,
    yaml::{self, Yaml},
};
use eddy_messages::services::Parameter;
use eddy_transport::is_name_token;

/// The key above the parameters of a node.
const PARAMETERS: &str = "ros__parameters";

/// Matches every node.
const ALL_NODES: &str = "/**";

/// A parameter of every node of ROS 2 (`rclcpp::Node`) that eddy accepts without an effect: types are always described.
const TYPE_DESCRIPTIONS: &str = "start_type_description_service";

/// Parameters of every node of ROS 2 that are the same in all of them.
const OF_EVERY_NODE: [&str; 2] = ["use_sim_time", TYPE_DESCRIPTIONS];

/// A parameter override and the nodes it applies to.
#[derive(Clone, Debug, PartialEq)]
pub struct ParameterOverride {
    /// Name and value.
    pub parameter: Parameter,
    /// The argument that it comes from.
    pub argument: String,
    /// Whether it is given to nodes of any name; nodes without such a parameter ignore it.
    pub for_all: bool,
    /// Full name of the nodes; `*` matches one part of the name, `**` any number.
    nodes: String,
}

impl ParameterOverride {
    /// Whether every node of ROS 2 has this parameter, so that a file for several nodes may set it.
    pub fn is_of_every_node(&self) -> bool {
        let name = self.parameter.name.as_str();
        OF_EVERY_NODE.contains(&name) || TopicQos::is_parameter(name)
    }

    /// Whether it is a parameter of every node that has no effect on eddy's.
    pub fn is_without_effect(&self) -> bool {
        self.parameter.name == TYPE_DESCRIPTIONS
    }

    /// Whether it is given to the node with this full name.
    pub(super) fn is_for(&self, node: &str) -> bool {
        let words = |name: &'_ str| -> Vec<String> {
            name.split('/').filter(|word| !word.is_empty()).map(str::to_owned).collect()
        };
        matches(&words(&self.nodes), &words(node))
    }
}

fn matches(pattern: &[String], name: &[String]) -> bool {
    match (pattern.split_first(), name.split_first()) {
        (None, None) => true,
        (Some((first, rest)), _) if first == "**" => {
            (0..=name.len()).any(|skipped| matches(rest, &name[skipped..]))
        }
        (Some((first, rest)), Some((word, others))) => {
            (first == "*" || first == word) && matches(rest, others)
        }
        _ => false,
    }
}

/// The parameter in `[node:]name:=value`.
pub(crate) fn parse(text: &str) -> Result<ParameterOverride, InvalidArgument> {
    let argument = format!("-p {text}");
    let invalid = |found: String, expected: &str| InvalidArgument::new(&argument, found, expected);
    let (left, value) = text
        .split_once(":=")
        .ok_or_else(|| invalid(quoted(text), "NAME:=VALUE, for example horizon:=10"))?;
    let (node, name) = match left.split_once(':') {
        Some((node, name)) => (Some(node), name),
        None => (None, left),
    };
    if let Some(node) = node.filter(|node| !is_name_token(node)) {
        return Err(invalid(quoted(node), "the name of a node before the colon"));
    }
    if name.is_empty() {
        return Err(invalid("no name".to_owned(), "NAME:=VALUE, for example horizon:=10"));
    }
    let value = yaml::read(value)
        .map_err(|_| quoted(value))
        .and_then(Yaml::into_value)
        .map_err(|found| invalid(found, "a value, or a list of one type, in YAML"))?;
    Ok(ParameterOverride {
        parameter: Parameter { name: name.to_owned(), value },
        // As in rcl, a bare name does not match a node in a namespace.
        nodes: node.map_or(ALL_NODES.to_owned(), |node| format!("/{node}")),
        argument,
        for_all: false,
    })
}

/// The parameters in a file, in its order.
pub(super) fn read(file: &Path) -> Result<Vec<ParameterOverride>, InvalidArgument> {
    let argument = format!("--params-file {}", file.display());
    let text = fs::read_to_string(file)
        .map_err(|error| InvalidArgument::new(&argument, error.to_string(), "a file to read"))?;
    parse_file(&argument, &text)
}

fn parse_file(argument: &str, text: &str) -> Result<Vec<ParameterOverride>, InvalidArgument> {
    let form = "a map of nodes with ros__parameters, in YAML";
    let yaml = yaml::read(text)
        .map_err(|error| InvalidArgument::new(argument, yaml::words(&error), form))?;
    let Yaml::Map(nodes) = yaml else {
        return Err(InvalidArgument::new(argument, "no map", form));
    };
    let mut given = Vec::new();
    collect_nodes(argument, "", nodes, &mut given)?;
    Ok(given)
}

/// The nodes below a namespace.
fn collect_nodes(
    argument: &str,
    namespace: &str,
    entries: Vec<(String, Yaml)>,
    given: &mut Vec<ParameterOverride>,
) -> Result<(), InvalidArgument> {
    for (key, below) in entries {
        let place = format!("{argument}: {namespace}/{}", key.trim_start_matches('/'));
        let Yaml::Map(below) = below else {
            let expected = format!("{PARAMETERS}, or nodes with it");
            return Err(InvalidArgument::new(&place, "a value", expected));
        };
        if key == PARAMETERS {
            if namespace.is_empty() {
                let expected = "the name of a node above it, or /** for every node";
                return Err(InvalidArgument::new(argument, PARAMETERS, expected));
            }
            collect_parameters(argument, namespace, "", below, given)?;
        } else {
            let name = format!("{namespace}/{}", key.trim_matches('/'));
            collect_nodes(argument, &name, below, given)?;
        }
    }
    Ok(())
}

/// The parameters of a node below a prefix; levels are joined by dots.
fn collect_parameters(
    argument: &str,
    nodes: &str,
    prefix: &str,
    entries: Vec<(String, Yaml)>,
    given: &mut Vec<ParameterOverride>,
) -> Result<(), InvalidArgument> {
    for (key, value) in entries {
        let name = format!("{prefix}{key}");
        if let Yaml::Map(below) = value {
            collect_parameters(argument, nodes, &format!("{name}."), below, given)?;
            continue;
        }
        let argument = format!("{argument}: {nodes}: {name}");
        let value = value.into_value().map_err(|found| {
            InvalidArgument::new(&argument, found, "a value, or a list of one type")
        })?;
        let last = nodes.rsplit('/').next().unwrap_or_default();
        given.push(ParameterOverride {
            parameter: Parameter { name, value },
            argument,
            for_all: last.contains('*'),
            nodes: nodes.to_owned(),
        });
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use eddy_messages::services::ParameterValue;

    fn for_node(text: &str, node: &str) -> Vec<(String, ParameterValue)> {
        let given = parse_file("file", text).unwrap().into_iter();
        let wanted = given.filter(|given| given.is_for(node));
        wanted.map(|given| (given.parameter.name, given.parameter.value)).collect()
    }

    #[test]
    fn a_file_selects_nodes_by_name_by_namespace_or_all() {
        let text = "
            /**: {ros__parameters: {use_sim_time: true}}
            eddy_node: {ros__parameters: {horizon: 2}}
            robot1:
              eddy_node: {ros__parameters: {horizon: 3, deep: {er: [1, 2]}}}
            /*/eddy_node: {ros__parameters: {max_gap: 4}}
            /robot1/**: {ros__parameters: {publish: all}}
        ";
        let all = ("use_sim_time".to_owned(), ParameterValue::bool(true));
        let horizon = |frames| ("horizon".to_owned(), ParameterValue::integer(frames));
        let gap = ("max_gap".to_owned(), ParameterValue::integer(4));
        assert_eq!(for_node(text, "/eddy_node"), [all.clone(), horizon(2)]);
        let deep = ("deep.er".to_owned(), ParameterValue::integers(vec![1, 2]));
        let publish = ("publish".to_owned(), ParameterValue::string("all".into()));
        let robot1 = [all.clone(), horizon(3), deep, gap.clone(), publish];
        assert_eq!(for_node(text, "/robot1/eddy_node"), robot1);
        assert_eq!(for_node(text, "/robot2/eddy_node"), [all.clone(), gap]);
        assert_eq!(for_node(text, "/robot2/arm/other"), [all]);
    }

    #[test]
    fn a_parameter_argument_is_for_every_node_or_for_one_without_a_namespace() {
        let given = parse("horizon:=10").unwrap();
        assert!(given.is_for("/eddy_node") && given.is_for("/a/b/c") && !given.for_all);
        let given = parse("eddy_node:horizon:=10").unwrap();
        assert!(given.is_for("/eddy_node"));
        assert!(!given.is_for("/a/eddy_node") && !given.is_for("/other"));
    }

    #[test]
    fn invalid_parameters_are_named_with_their_place() {
        for (text, expected) in [
            ("horizon", "-p horizon: found `horizon`, expected NAME:=VALUE"),
            (":=1", "-p :=1: found no name, expected NAME:=VALUE"),
            ("a b:c:=1", "-p a b:c:=1: found `a b`, expected the name of a node"),
            ("a:=[1, x]", "-p a:=[1, x]: found a list of mixed types, expected a value"),
            ("a:=", "-p a:=: found nothing, expected a value"),
            ("a:=[1", "-p a:=[1: found `[1`, expected a value"),
        ] {
            let message = parse(text).unwrap_err().to_string();
            assert!(message.starts_with(expected), "{message}");
        }
        for (text, expected) in [
            ("ros__parameters: {a: 1}", "f: found ros__parameters, expected the name of a node"),
            ("/a: 1", "f: /a: found a value, expected ros__parameters"),
            ("- a", "f: found no map, expected a map of nodes"),
            ("a: {ros__parameters: {b: {c: }}}", "f: /a: b.c: found nothing, expected a value"),
            ("a: {ros__parameters: 1}", "f: /a/ros__parameters: found a value"),
            (
                "a:\n  ros__parameters:\n    b: 2\n    b: 5\n",
                "f: found duplicate mapping key `b` is not allowed here at line 4, column 5, expected a map of nodes",
            ),
        ] {
            let message = parse_file("f", text).unwrap_err().to_string();
            assert!(message.starts_with(expected), "{message}");
            // Those are settings of a library.
            assert!(!message.contains("Policy") && !message.contains("Options"), "{message}");
        }
    }
}
