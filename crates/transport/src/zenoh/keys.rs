//! Names on the wire: key expressions, liveliness tokens, QoS, GIDs
//! (`rmw_zenoh_cpp/src/detail/liveliness_utils.cpp`).

use std::num::NonZeroUsize;

use zenoh::session::ZenohId;

use crate::{Link, Reliability};
use eddy_messages::{TypeSupport, dds_type, ros_type};

/// First chunk of every liveliness token.
const ADMIN_SPACE: &str = "@ros2_lv";
/// Replaces an empty enclave or namespace, and `/` in names.
const EMPTY: &str = "%";
/// Code of the durability transient local.
const TRANSIENT_LOCAL: &str = "1";
/// History depth advertised for dropping publishers (the default of ROS 2).
const ADVERTISED_DEPTH: usize = 10;

/// Kinds of endpoints.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Side {
    Publisher,
    Subscription,
    Service,
}

impl Side {
    /// Code in tokens.
    fn code(self) -> &'static str {
        match self {
            Self::Publisher => "MP",
            Self::Subscription => "MS",
            Self::Service => "SS",
        }
    }

    /// Code of the endpoints on the other side.
    fn peer_code(self) -> &'static str {
        match self {
            Self::Publisher => Self::Subscription.code(),
            Self::Subscription => Self::Publisher.code(),
            Self::Service => "SC",
        }
    }
}

/// This process in the ROS graph.
pub(super) struct Node {
    pub(super) domain_id: u16,
    pub(super) zid: ZenohId,
    /// ROS namespace, such as `/robot1`.
    pub(super) namespace: String,
    pub(super) name: String,
}

impl Node {
    /// `@ros2_lv/<domain>/<zid>/<nid>/<nid>/NN/<enclave>/<namespace>/<node>`; the node has id 0.
    pub(super) fn token(&self) -> String {
        let Self { domain_id, zid, name, .. } = self;
        let namespace = self.mangled_namespace();
        format!("{ADMIN_SPACE}/{domain_id}/{zid}/0/0/NN/{EMPTY}/{namespace}/{name}")
    }

    /// `/` becomes `%`, `/robot1` becomes `%robot1`.
    fn mangled_namespace(&self) -> String {
        self.namespace.replace('/', EMPTY)
    }
}

/// A publisher, subscriber or service in the ROS graph.
pub(super) struct Endpoint {
    pub(super) link: Link,
    /// ROS name of the type, such as `eddy_msgs/msg/ParticleFrame`.
    pub(super) type_name: String,
    /// `<domain>/<topic>/<type>/<hash>`
    pub(super) key: String,
    /// `@ros2_lv/<domain>/<zid>/<nid>/<eid>/<MP|MS|SS>/<enclave>/<namespace>/<node>/<topic>/<type>/<hash>/<qos>`
    pub(super) token: String,
    /// Key expression of the tokens on the other side of the topic, of any type.
    pub(super) peers: String,
}

impl Endpoint {
    /// The endpoint `id` of a node.
    pub(super) fn new(
        node: &Node,
        id: usize,
        side: Side,
        link: &Link,
        support: &TypeSupport,
        qos: &str,
    ) -> Self {
        let Node { domain_id, zid, name, .. } = node;
        let namespace = node.mangled_namespace();
        let (topic, mangled) = (link.topic.trim_matches('/'), link.topic.replace('/', "%"));
        let (type_name, hash) = (dds_type(&support.name), &support.hash);
        let (code, other) = (side.code(), side.peer_code());
        Self {
            link: link.clone(),
            type_name: support.name.clone(),
            key: format!("{domain_id}/{topic}/{type_name}/{hash}"),
            token: format!(
                "{ADMIN_SPACE}/{domain_id}/{zid}/0/{id}/{code}/{EMPTY}/{namespace}/{name}/{mangled}/{type_name}/{hash}/{qos}"
            ),
            peers: format!("{ADMIN_SPACE}/{domain_id}/*/*/*/{other}/*/*/*/{mangled}/*/*/*"),
        }
    }

    /// The id in attachments: XXH3-128 of the token, little-endian.
    pub(super) fn gid(&self) -> [u8; 16] {
        gid(&self.token)
    }
}

fn gid(token: &str) -> [u8; 16] {
    xxhash_rust::xxh3::xxh3_128(token.as_bytes()).to_le_bytes()
}

/// ROS name and hash of the type in the token of an endpoint.
pub(crate) fn type_in(token: &str) -> Option<(String, &str)> {
    let mut chunks = token.split('/').skip(10);
    Some((ros_type(chunks.next()?)?, chunks.next()?))
}

/// The topic in the token of an endpoint.
pub(crate) fn topic_in(token: &str) -> Option<String> {
    Some(token.split('/').nth(9)?.replace('%', "/"))
}

/// The tokens of all publishers of a domain.
pub(super) fn publishers(domain_id: u16) -> String {
    format!("{ADMIN_SPACE}/{domain_id}/*/*/*/{}/*/*/*/*/*/*/*", Side::Publisher.code())
}

/// QoS of a publisher: `reliability:durability:history,depth:deadline:lifespan:liveliness`, each empty for the
/// defaults of rmw_zenoh (reliable, volatile, keep last). A publisher that keeps messages is transient local.
pub(super) fn publisher_qos(reliability: Reliability, kept: Option<NonZeroUsize>) -> String {
    match (reliability, kept) {
        (Reliability::Block, Some(depth)) => format!(":{TRANSIENT_LOCAL}:,{depth}:,:,:,,"),
        (Reliability::Drop, Some(depth)) => format!("2:{TRANSIENT_LOCAL}:,{depth}:,:,:,,"),
        (Reliability::Block, None) => "::2,:,:,:,,".to_owned(),
        (Reliability::Drop, None) => best_effort(ADVERTISED_DEPTH),
    }
}

/// Number of messages that a publisher keeps according to its token; `None` if it is volatile.
pub(super) fn kept_in(token: &str) -> Option<NonZeroUsize> {
    let mut policies = token.split('/').nth(12)?.split(':').skip(1);
    let (durability, history) = (policies.next()?, policies.next()?);
    let depth = history.split(',').nth(1).and_then(|depth| depth.parse().ok());
    (durability == TRANSIENT_LOCAL).then(|| depth.unwrap_or(NonZeroUsize::MIN))
}

/// QoS of a service: reliable, volatile, keep last, as in ROS 2.
pub(super) fn service_qos(depth: usize) -> String {
    format!("::,{depth}:,:,:,,")
}

/// QoS of a subscriber: best effort, which is compatible with every publisher.
pub(super) fn subscriber_qos(depth: usize) -> String {
    best_effort(depth)
}

fn best_effort(depth: usize) -> String {
    format!("2::,{depth}:,:,:,,")
}

#[cfg(test)]
mod tests {
    use super::*;
    use eddy_messages::{Message, ParticleFrame, RosString, type_support};

    const ZID: &str = "1234567890abcdef1234567890abcdef";

    fn node() -> Node {
        let (namespace, name) = ("/".to_owned(), "eddy_node".to_owned());
        Node { domain_id: 7, zid: ZID.parse().unwrap(), namespace, name }
    }

    fn endpoint(link: &str, type_name: &str, side: Side, qos: &str) -> Endpoint {
        Endpoint::new(
            &node(),
            3,
            side,
            &link.parse().unwrap(),
            type_support(type_name).unwrap(),
            qos,
        )
    }

    #[test]
    fn names_are_those_of_rmw_zenoh() {
        let qos = publisher_qos(Reliability::Block, None);
        let endpoint = endpoint("zenoh:/chatter", RosString::TYPE, Side::Publisher, &qos);
        let hash = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18";
        assert_eq!(endpoint.key, format!("7/chatter/std_msgs::msg::dds_::String_/{hash}"));
        assert_eq!(
            endpoint.token,
            format!(
                "@ros2_lv/7/{ZID}/0/3/MP/%/%/eddy_node/%chatter/std_msgs::msg::dds_::String_/{hash}/::2,:,:,:,,"
            )
        );
    }

    #[test]
    fn inner_slashes_stay_in_keys_and_are_replaced_in_tokens() {
        let qos = subscriber_qos(64);
        let endpoint =
            endpoint("zenoh:/prediction/raw", ParticleFrame::TYPE, Side::Subscription, &qos);
        let hash = &type_support(ParticleFrame::TYPE).unwrap().hash;
        let name = "eddy_msgs::msg::dds_::ParticleFrame_";
        assert_eq!(endpoint.key, format!("7/prediction/raw/{name}/{hash}"));
        assert_eq!(
            endpoint.token,
            format!(
                "@ros2_lv/7/{ZID}/0/3/MS/%/%/eddy_node/%prediction%raw/{name}/{hash}/2::,64:,:,:,,"
            )
        );
        assert_eq!(endpoint.peers, "@ros2_lv/7/*/*/*/MP/*/*/*/%prediction%raw/*/*/*");
    }

    #[test]
    fn a_node_has_a_token() {
        assert_eq!(node().token(), format!("@ros2_lv/7/{ZID}/0/0/NN/%/%/eddy_node"));
    }

    #[test]
    fn a_namespace_is_mangled_in_tokens_and_absent_from_keys() {
        let node = Node { namespace: "/robot1/left".to_owned(), ..node() };
        assert_eq!(node.token(), format!("@ros2_lv/7/{ZID}/0/0/NN/%/%robot1%left/eddy_node"));
        let support = type_support(RosString::TYPE).unwrap();
        let link = "zenoh:/a".parse().unwrap();
        let endpoint = Endpoint::new(&node, 1, Side::Publisher, &link, support, "");
        assert!(endpoint.token.contains("/MP/%/%robot1%left/eddy_node/%a/"), "{}", endpoint.token);
        assert!(endpoint.key.starts_with("7/a/"), "{}", endpoint.key);
    }

    #[test]
    fn the_type_is_read_back_from_a_token() {
        for name in [ParticleFrame::TYPE, RosString::TYPE] {
            let endpoint = endpoint("zenoh:/a/b", name, Side::Publisher, "::,:,:,:,,");
            let hash = type_support(name).unwrap().hash.as_str();
            assert_eq!(type_in(&endpoint.token), Some((name.to_owned(), hash)));
            assert_eq!(topic_in(&endpoint.token), Some("/a/b".to_owned()));
        }
        assert_eq!(type_in(&node().token()), None);
    }

    #[test]
    fn the_number_of_kept_messages_is_read_back_from_a_token() {
        for (qos, kept) in [
            (publisher_qos(Reliability::Block, NonZeroUsize::new(7)), 7),
            (publisher_qos(Reliability::Drop, NonZeroUsize::new(3)), 3),
            (publisher_qos(Reliability::Block, None), 0),
            (":1:,:,:,:,,".to_owned(), 1),
            ("nothing".to_owned(), 0),
        ] {
            let endpoint = endpoint("zenoh:/a", RosString::TYPE, Side::Publisher, &qos);
            assert_eq!(kept_in(&endpoint.token).map_or(0, NonZeroUsize::get), kept, "{qos}");
        }
    }

    #[test]
    fn qos_is_encoded_as_in_rmw_zenoh() {
        assert_eq!(publisher_qos(Reliability::Block, None), "::2,:,:,:,,");
        assert_eq!(publisher_qos(Reliability::Drop, None), "2::,10:,:,:,,");
        let one = Some(NonZeroUsize::MIN);
        assert_eq!(publisher_qos(Reliability::Block, one), ":1:,1:,:,:,,");
        assert_eq!(publisher_qos(Reliability::Drop, one), "2:1:,1:,:,:,,");
        assert_eq!(service_qos(10), "::,10:,:,:,,");
        assert_eq!(subscriber_qos(64), "2::,64:,:,:,,");
    }

    /// Computed with the Python package xxhash 4.1.0: `xxh3_128_intdigest(token).to_bytes(16, "little")`.
    #[test]
    fn the_gid_is_the_hash_of_the_token_in_little_endian() {
        let token = "@ros2_lv/0/1234567890abcdef1234567890abcdef/0/0/NN/%/%/eddy_node";
        let expected = [
            0xf5, 0xa6, 0x5f, 0x2e, 0x0b, 0xe1, 0xaf, 0xc6, 0x33, 0x30, 0xca, 0x65, 0x3a, 0x17,
            0xde, 0xff,
        ];
        assert_eq!(gid(token), expected);
    }
}
