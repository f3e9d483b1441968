//! One node with the ROS arguments applied: its name, topics and parameters.

use super::{
    InvalidArgument, ParameterOverride, RosArguments,
    remap::{Rule, Target},
};
use eddy_transport::{Link, TransportError, TransportOptions};

/// A node with its arguments applied.
#[derive(Clone, Debug, PartialEq)]
pub struct RosNode {
    name: String,
    /// `/`, or for example `/robot1`.
    namespace: String,
    /// Rules for topics and services, in the order in which they are tried.
    renamed: Vec<Renamed>,
    parameters: Vec<ParameterOverride>,
    directives: String,
    has_rosout: bool,
    has_console: bool,
    /// `/` is none.
    enclave: String,
}

/// A rule with absolute names.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Renamed {
    from: String,
    to: String,
    topics: bool,
    services: bool,
}

impl RosNode {
    /// Applies rules in the order of the design: node name, then namespace (with the rules for that node name), then
    /// topics and services. The first matching rule wins.
    pub(super) fn new(arguments: &RosArguments, name: &str) -> Self {
        let first = |name: &str, target: Target| -> Option<String> {
            let rules = &mut for_node(&arguments.rules, name);
            rules.find(|rule| rule.target == target).map(|rule| rule.to.clone())
        };
        let name = first(name, Target::Node).unwrap_or(name.to_owned());
        let namespace = first(&name, Target::Namespace).unwrap_or("/".to_owned());
        let (renamed, parameters) = (Vec::new(), Vec::new());
        let mut node = Self {
            name,
            namespace,
            renamed,
            parameters,
            directives: String::new(),
            has_rosout: !arguments.is_without_rosout,
            has_console: !arguments.is_without_console,
            enclave: arguments.enclave.clone().unwrap_or("/".to_owned()),
        };
        let absolute = |rule: &Rule| match &rule.target {
            Target::Node | Target::Namespace => None,
            &Target::Name { ref from, topics, services } => {
                let (from, to) = (node.absolute(from), node.absolute(&rule.to));
                Some(Renamed { from, to, topics, services })
            }
        };
        node.renamed = for_node(&arguments.rules, &node.name).filter_map(absolute).collect();
        let full_name = node.full_name();
        let given = arguments.parameters.iter().filter(|given| given.is_for(&full_name));
        node.parameters = given.cloned().collect();
        node.directives = arguments.directives(&node);
        node
    }

    /// A node with this name and namespace, without further arguments.
    ///
    /// # Errors
    /// [`InvalidArgument`] when one of them is not a name in ROS 2.
    pub fn named(name: &str, namespace: &str) -> Result<Self, InvalidArgument> {
        let rules = [format!("__node:={name}"), format!("__ns:={namespace}")];
        let words = rules.map(|rule| ["-r".to_owned(), rule]).concat();
        Ok(RosArguments::parse(&words)?.node(name))
    }

    /// Its name without the namespace.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Its namespace: `/`, or for example `/robot1`.
    pub fn namespace(&self) -> &str {
        &self.namespace
    }

    /// Namespace and name, such as `/robot1/eddy_node`.
    pub fn full_name(&self) -> String {
        format!("{}/{}", self.namespace.trim_end_matches('/'), self.name)
    }

    /// The options of its transports: the environment's, with its name, namespace and enclave.
    ///
    /// # Errors
    /// [`TransportError::Environment`].
    pub fn transport_options(&self) -> Result<TransportOptions, TransportError> {
        let options = TransportOptions::from_env(&self.name)?;
        let (namespace, enclave) = (self.namespace.clone(), self.enclave.clone());
        Ok(TransportOptions { namespace, enclave, ..options })
    }

    /// The absolute name of a topic of this node, after remapping.
    pub fn topic(&self, name: &str) -> String {
        let name = self.absolute(name);
        self.rule(&name, |rule| rule.topics).unwrap_or(name)
    }

    /// The absolute name of a service of this node, after remapping.
    pub fn service(&self, name: &str) -> String {
        let name = self.absolute(name);
        self.rule(&name, |rule| rule.services).unwrap_or(name)
    }

    /// A link with its topic after remapping.
    pub fn link(&self, link: &Link) -> Link {
        link.with_topic(&self.topic(&link.topic))
    }

    /// The topic `word` below another one, such as `/prediction/status` below `/prediction`. It follows the new name of
    /// that topic unless it has a rule of its own.
    pub fn subtopic(&self, link: &Link, word: &str) -> Link {
        let own = self.absolute(&format!("{}/{word}", link.topic));
        let followed = || format!("{}/{word}", self.topic(&link.topic));
        link.with_topic(&self.rule(&own, |rule| rule.topics).unwrap_or_else(followed))
    }

    /// Its parameters; the last value of each takes precedence.
    pub fn parameters(&self) -> &[ParameterOverride] {
        &self.parameters
    }

    /// Whether its log is published on `/rosout`.
    pub fn has_rosout(&self) -> bool {
        self.has_rosout
    }

    /// The name of its logger, such as `robot1.eddy_node`.
    pub fn logger(&self) -> String {
        self.full_name().trim_start_matches('/').replace('/', ".")
    }

    /// Adds the log levels of the arguments to a filter such as `warn,zenoh=error`.
    pub fn log_filter(&self, filter: &str) -> String {
        format!("{filter}{}", self.directives)
    }

    /// The filter of what is written to the terminal: nothing with `--disable-stdout-logs`.
    pub fn console_filter(&self, filter: &str) -> String {
        if self.has_console { self.log_filter(filter) } else { "off".to_owned() }
    }

    /// Whether this is the ROS name of the node's logger.
    pub(super) fn is_logger(&self, name: &str) -> bool {
        name == self.name || name == self.logger()
    }

    /// Expands `a` with the namespace and `~/a` with the full name.
    fn absolute(&self, name: &str) -> String {
        if name.starts_with('/') {
            return name.to_owned();
        }
        match name.strip_prefix("~/") {
            Some(private) => format!("{}/{private}", self.full_name()),
            None => format!("{}/{name}", self.namespace.trim_end_matches('/')),
        }
    }

    fn rule(&self, name: &str, counts: impl Fn(&Renamed) -> bool) -> Option<String> {
        let mut rules = self.renamed.iter().filter(|rule| counts(rule));
        rules.find(|rule| rule.from == name).map(|rule| rule.to.clone())
    }
}

/// The rules for a node of this name.
fn for_node<'a>(rules: &'a [Rule], name: &str) -> impl Iterator<Item = &'a Rule> {
    rules.iter().filter(move |rule| rule.node.as_deref().is_none_or(|node| node == name))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn node(words: &[&str]) -> RosNode {
        let words: Vec<_> = words.iter().map(|word| (*word).to_owned()).collect();
        RosArguments::parse(&words).unwrap().node("eddy_node")
    }

    #[test]
    fn without_arguments_names_stay_as_they_are() {
        let node = node(&[]);
        assert_eq!((node.name(), node.namespace()), ("eddy_node", "/"));
        assert_eq!(node.full_name(), "/eddy_node");
        assert_eq!(
            [node.topic("/a"), node.topic("a"), node.topic("~/a")],
            ["/a", "/a", "/eddy_node/a"]
        );
    }

    #[test]
    fn a_namespace_moves_relative_and_private_names_only() {
        let node = node(&["-r", "__ns:=/robot1", "-r", "__node:=predictor"]);
        assert_eq!(node.full_name(), "/robot1/predictor");
        assert_eq!(node.topic("particles"), "/robot1/particles");
        assert_eq!(node.topic("/diagnostics"), "/diagnostics");
        assert_eq!(node.service("~/reset"), "/robot1/predictor/reset");
    }

    #[test]
    fn the_first_rule_for_a_name_wins_and_rules_for_other_nodes_are_ignored() {
        let rules =
            ["-r", "other:/a:=/x", "-r", "eddy_node:/a:=/b", "-r", "/a:=/c", "-r", "/b:=/d"];
        let node = node(&rules);
        assert_eq!(node.topic("/a"), "/b", "the result of a rule is not remapped again");
        assert_eq!(node.topic("/b"), "/d");
    }

    #[test]
    fn rules_with_relative_names_are_expanded_with_the_namespace_of_the_node() {
        let node = node(&["-r", "a:=~/b", "-r", "__ns:=/n", "-r", "/a:=/c"]);
        assert_eq!(node.topic("/n/a"), "/n/eddy_node/b");
        assert_eq!(node.topic("/a"), "/c");
    }

    #[test]
    fn a_rule_may_apply_to_topics_or_to_services_only() {
        let node = node(&["-r", "rostopic://a:=t", "-r", "rosservice://a:=s"]);
        assert_eq!([node.topic("a"), node.service("a")], ["/t", "/s"]);
    }

    #[test]
    fn a_dependent_topic_follows_its_parent_unless_it_has_a_rule_of_its_own() {
        let link: Link = "shm:/prediction".parse().unwrap();
        let node = node(&["-r", "/prediction:=/p", "-r", "/prediction/cloud:=/points"]);
        assert_eq!(node.link(&link).to_string(), "shm:/p");
        assert_eq!(node.subtopic(&link, "status").to_string(), "shm:/p/status");
        assert_eq!(node.subtopic(&link, "cloud").to_string(), "shm:/points");
    }

    #[test]
    fn rules_for_a_node_refer_to_its_new_name() {
        let node = node(&[
            "-r",
            "__node:=b",
            "-r",
            "b:__ns:=/n",
            "-r",
            "eddy_node:/a:=/x",
            "-r",
            "b:/a:=/y",
        ]);
        assert_eq!(node.full_name(), "/n/b");
        assert_eq!(node.topic("/a"), "/y");
    }

    #[test]
    fn parameters_are_those_for_its_full_name() {
        let node = node(&["-r", "__ns:=/n", "-p", "a:=1", "-p", "x:b:=2", "-p", "eddy_node:c:=3"]);
        let names: Vec<_> = node.parameters().iter().map(|g| g.parameter.name.as_str()).collect();
        assert_eq!(names, ["a"], "as in rcl, c is for /eddy_node");
    }
}
