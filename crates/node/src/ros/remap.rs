//! Rules that rename nodes, topics and services.

use std::str::FromStr;

use super::InvalidArgument;
use eddy_transport::{is_absolute_name, is_name_token};

/// `[node:][rostopic://|rosservice://]from:=to`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Rule {
    /// Name (without namespace) of the only node that it applies to.
    pub(super) node: Option<String>,
    pub(super) target: Target,
    /// The new name, not yet expanded.
    pub(super) to: String,
}

/// What a rule renames.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Target {
    /// `__node` or `__name`.
    Node,
    /// `__ns`.
    Namespace,
    /// Topics or services, not yet expanded.
    Name { from: String, topics: bool, services: bool },
}

impl FromStr for Rule {
    type Err = InvalidArgument;

    fn from_str(text: &str) -> Result<Self, InvalidArgument> {
        let argument = format!("-r {text}");
        let invalid =
            |found: &str, expected: &str| InvalidArgument::new(&argument, quoted(found), expected);
        let (left, to) = text.split_once(":=").ok_or_else(|| {
            invalid(text, "FROM:=TO, for example /particles:=/truth or __node:=predictor")
        })?;
        let (node, from) = match left.split_once(':') {
            // The colon of `rostopic://`.
            Some((_, rest)) if rest.starts_with("//") => (None, left),
            Some((node, _)) if !is_name_token(node) => {
                return Err(invalid(node, "the name of a node before the colon"));
            }
            Some((node, from)) => (Some(node.to_owned()), from),
            None => (None, left),
        };
        let target = match from {
            "__node" | "__name" if is_name_token(to) => Target::Node,
            "__node" | "__name" => {
                return Err(invalid(to, "the name of a node: letters, digits and _"));
            }
            "__ns" if to == "/" || is_absolute_name(to) => Target::Namespace,
            "__ns" => return Err(invalid(to, "an absolute namespace such as /robot1")),
            _ => {
                let (from, topics, services) =
                    match (from.strip_prefix("rostopic://"), from.strip_prefix("rosservice://")) {
                        (Some(topic), _) => (topic, true, false),
                        (_, Some(service)) => (service, false, true),
                        _ => (from, true, true),
                    };
                for name in [from, to] {
                    if !is_name(name) {
                        return Err(invalid(
                            name,
                            "the name of a topic or service, such as /a, a/b or ~/a",
                        ));
                    }
                }
                Target::Name { from: from.to_owned(), topics, services }
            }
        };
        Ok(Self { node, target, to: to.to_owned() })
    }
}

/// A name that is absolute (`/a`), relative (`a/b`) or private (`~/a`).
fn is_name(name: &str) -> bool {
    let relative = name.strip_prefix("~/").or(name.strip_prefix('/')).unwrap_or(name);
    is_absolute_name(&format!("/{relative}"))
}

pub(super) fn quoted(text: &str) -> String {
    format!("`{text}`")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rules_are_parsed() {
        let rule = |text: &str| text.parse::<Rule>().unwrap();
        let name =
            |from: &str, topics, services| Target::Name { from: from.into(), topics, services };
        for (text, node, target, to) in [
            ("__node:=a", None, Target::Node, "a"),
            ("__name:=a", None, Target::Node, "a"),
            ("__ns:=/a/b", None, Target::Namespace, "/a/b"),
            ("n:__ns:=/", Some("n"), Target::Namespace, "/"),
            ("/a:=b", None, name("/a", true, true), "b"),
            ("n:a/b:=~/c", Some("n"), name("a/b", true, true), "~/c"),
            ("rostopic://~/a:=/b", None, name("~/a", true, false), "/b"),
            ("n:rosservice:///a:=/b", Some("n"), name("/a", false, true), "/b"),
        ] {
            assert_eq!(rule(text), Rule { node: node.map(str::to_owned), target, to: to.into() });
        }
    }

    #[test]
    fn invalid_rules_are_named() {
        for (text, expected) in [
            ("/a", "-r /a: found `/a`, expected FROM:=TO"),
            ("/a:=", "-r /a:=: found ``, expected the name of a topic or service"),
            ("/a/*:=/b", "-r /a/*:=/b: found `/a/*`, expected the name"),
            ("__ns:=a", "-r __ns:=a: found `a`, expected an absolute namespace"),
            ("__node:=/a", "-r __node:=/a: found `/a`, expected the name of a node"),
            ("/n:a:=b", "-r /n:a:=b: found `/n`, expected the name of a node before"),
        ] {
            let message = text.parse::<Rule>().unwrap_err().to_string();
            assert!(message.starts_with(expected), "{message}");
        }
    }
}
