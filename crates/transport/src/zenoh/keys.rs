//! Names on the wire: key expressions, liveliness tokens, QoS, GIDs
//! (`rmw_zenoh_cpp/src/detail/liveliness_utils.cpp`).

use zenoh::session::ZenohId;

use crate::Link;
use eddy_messages::{
    QosProfile, TypeSupport, dds_type,
    qos::{DurabilityPolicy, HistoryPolicy, ReliabilityPolicy},
    ros_type, service_hash,
    type_descriptions::{GET_TYPE_DESCRIPTION, SERVICE_NAME},
};

/// First chunk of every liveliness token.
const ADMIN_SPACE: &str = "@ros2_lv";
/// The QoS of an endpoint, and chunks after it: ROS 2 Lyrical appends the memory that an endpoint accepts, such as
/// `backends:cpu`, to the tokens of messages with a `uint8[]` field (rmw_zenoh, pull request 930).
const QOS_AND_MORE: &str = "*/**";
/// Replaces an empty enclave or namespace, and `/` in names.
const EMPTY: &str = "%";
/// Codes of policies (`rmw/types.h`); the others are the defaults, which are left out.
const BEST_EFFORT: &str = "2";
const TRANSIENT_LOCAL: &str = "1";
const KEEP_ALL: &str = "2";
/// Depth that is left out (`RMW_ZENOH_DEFAULT_HISTORY_DEPTH` of `rmw_zenoh_cpp/src/detail/qos.cpp`).
const DEFAULT_DEPTH: usize = 42;

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
    /// Security enclave, such as `/robots`; `/` is none.
    pub(super) enclave: String,
    /// ROS namespace, such as `/robot1`.
    pub(super) namespace: String,
    pub(super) name: String,
}

impl Node {
    /// `@ros2_lv/<domain>/<zid>/<nid>/<nid>/NN/<enclave>/<namespace>/<node>`; the node has id 0.
    pub(super) fn token(&self) -> String {
        let Self { domain_id, zid, .. } = self;
        format!("{ADMIN_SPACE}/{domain_id}/{zid}/0/0/NN/{}", self.place())
    }

    /// `<enclave>/<namespace>/<node>`: `/` becomes `%`, `/robot1` becomes `%robot1`.
    fn place(&self) -> String {
        let [enclave, namespace] = [&self.enclave, &self.namespace].map(|name| mangled(name));
        format!("{enclave}/{namespace}/{}", self.name)
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
        let (Node { domain_id, zid, .. }, place) = (node, node.place());
        let (topic, mangled) = (link.topic.trim_matches('/'), mangled(&link.topic));
        let (type_name, hash) = (dds_type(&support.name), &support.hash);
        let (code, other) = (side.code(), side.peer_code());
        Self {
            link: link.clone(),
            type_name: support.name.clone(),
            key: format!("{domain_id}/{topic}/{type_name}/{hash}"),
            token: format!(
                "{ADMIN_SPACE}/{domain_id}/{zid}/0/{id}/{code}/{place}/{mangled}/{type_name}/{hash}/{qos}"
            ),
            peers: format!(
                "{ADMIN_SPACE}/{domain_id}/*/*/*/{other}/*/*/*/{mangled}/*/*/{QOS_AND_MORE}"
            ),
        }
    }

    /// The id in attachments: XXH3-128 of the token, little-endian.
    pub(super) fn gid(&self) -> [u8; 16] {
        gid(&self.token)
    }
}

/// A name as one chunk of a token.
fn mangled(name: &str) -> String {
    name.replace('/', EMPTY)
}

pub(super) fn gid(token: &str) -> [u8; 16] {
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
    endpoints(domain_id, Side::Publisher)
}

/// The tokens of all services of a domain.
pub(super) fn services(domain_id: u16) -> String {
    endpoints(domain_id, Side::Service)
}

fn endpoints(domain_id: u16, side: Side) -> String {
    format!("{ADMIN_SPACE}/{domain_id}/*/*/*/{}/*/*/*/*/*/*/{QOS_AND_MORE}", side.code())
}

/// The key of a service.
pub(super) fn service(domain_id: u16, name: &str, type_name: &str, hash: &str) -> String {
    let name = name.trim_start_matches('/');
    format!("{domain_id}/{name}/{}/{hash}", dds_type(type_name))
}

/// The tokens of the publishers of a topic with this type.
pub(super) fn publishers_of(domain_id: u16, topic: &str, type_name: &str, hash: &str) -> String {
    let (code, mangled) = (Side::Publisher.code(), mangled(topic));
    let type_name = dds_type(type_name);
    format!(
        "{ADMIN_SPACE}/{domain_id}/*/*/*/{code}/*/*/*/{mangled}/{type_name}/{hash}/{QOS_AND_MORE}"
    )
}

/// The key of the service of the node with this token, or of the node of this endpoint, that describes its types.
pub(super) fn describing_service(domain_id: u16, token: &str) -> Option<String> {
    let mut chunks = token.split('/').skip(7);
    let (namespace, node) = (chunks.next()?.replace(EMPTY, "/"), chunks.next()?);
    let name = format!("{}/{node}/{SERVICE_NAME}", namespace.trim_end_matches('/'));
    let hash = service_hash(GET_TYPE_DESCRIPTION).ok()?;
    Some(service(domain_id, &name, GET_TYPE_DESCRIPTION, hash))
}

/// QoS of an endpoint: `reliability:durability:history,depth:deadline:lifespan:liveliness`, each empty for the
/// defaults of rmw_zenoh (reliable, volatile, keep last).
pub(super) fn qos(profile: &QosProfile) -> String {
    let reliability = match profile.reliability {
        ReliabilityPolicy::Reliable => "",
        ReliabilityPolicy::BestEffort => BEST_EFFORT,
    };
    let durability = match profile.durability {
        DurabilityPolicy::Volatile => "",
        DurabilityPolicy::TransientLocal => TRANSIENT_LOCAL,
    };
    let history = match profile.history {
        HistoryPolicy::KeepLast(depth) => format!(",{}", depth.max(1)),
        HistoryPolicy::KeepAll => format!("{KEEP_ALL},"),
        HistoryPolicy::Unknown => ",".to_owned(),
    };
    format!("{reliability}:{durability}:{history}:,:,:,,")
}

/// QoS in the token of an endpoint.
pub(crate) fn qos_in(token: &str) -> Option<QosProfile> {
    let mut policies = token.split('/').nth(12)?.split(':');
    let (reliability, durability) = (policies.next()?, policies.next()?);
    let (history, depth) = policies.next()?.split_once(',')?;
    Some(QosProfile {
        reliability: match reliability {
            BEST_EFFORT => ReliabilityPolicy::BestEffort,
            _ => ReliabilityPolicy::Reliable,
        },
        durability: match durability {
            TRANSIENT_LOCAL => DurabilityPolicy::TransientLocal,
            _ => DurabilityPolicy::Volatile,
        },
        history: match history {
            KEEP_ALL => HistoryPolicy::KeepAll,
            _ => HistoryPolicy::KeepLast(match depth {
                "" => DEFAULT_DEPTH,
                depth => depth.parse().ok()?,
            }),
        },
    })
}

/// QoS of a service: reliable, volatile, keep last, as in ROS 2.
pub(super) fn service_qos(depth: usize) -> String {
    format!("::,{depth}:,:,:,,")
}

/// QoS of a subscriber: best effort, which is compatible with every publisher.
pub(super) fn subscriber_qos(depth: usize) -> QosProfile {
    best_effort(depth)
}

fn best_effort(depth: usize) -> QosProfile {
    let (reliability, history) = (ReliabilityPolicy::BestEffort, HistoryPolicy::KeepLast(depth));
    QosProfile { reliability, history, ..QosProfile::default() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Reliability, default_qos};
    use eddy_messages::{Message, ParticleFrame, RosString, type_support};

    const ZID: &str = "1234567890abcdef1234567890abcdef";

    fn node() -> Node {
        let [enclave, namespace] = ["/"; 2].map(str::to_owned);
        let (zid, name) = (ZID.parse().unwrap(), "eddy_node".to_owned());
        Node { domain_id: 7, zid, enclave, namespace, name }
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
        let qos = qos(&default_qos(Reliability::Block, RosString::TYPE));
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
        let qos = qos(&subscriber_qos(64));
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
        assert_eq!(endpoint.peers, "@ros2_lv/7/*/*/*/MP/*/*/*/%prediction%raw/*/*/*/**");
    }

    #[test]
    fn a_node_has_a_token() {
        assert_eq!(node().token(), format!("@ros2_lv/7/{ZID}/0/0/NN/%/%/eddy_node"));
    }

    #[test]
    fn enclave_and_namespace_are_mangled_in_tokens_and_absent_from_keys() {
        let (enclave, namespace) = ("/robots".to_owned(), "/robot1/left".to_owned());
        let node = Node { enclave, namespace, ..node() };
        let expected = format!("@ros2_lv/7/{ZID}/0/0/NN/%robots/%robot1%left/eddy_node");
        assert_eq!(node.token(), expected);
        let support = type_support(RosString::TYPE).unwrap();
        let link = "zenoh:/a".parse().unwrap();
        let endpoint = Endpoint::new(&node, 1, Side::Publisher, &link, support, "");
        assert!(
            endpoint.token.contains("/MP/%robots/%robot1%left/eddy_node/%a/"),
            "{}",
            endpoint.token
        );
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
    fn qos_is_encoded_as_in_rmw_zenoh_and_read_back() {
        let latched = QosProfile {
            durability: DurabilityPolicy::TransientLocal,
            history: HistoryPolicy::KeepLast(1),
            ..QosProfile::default()
        };
        for (profile, expected) in [
            (default_qos(Reliability::Block, RosString::TYPE), "::2,:,:,:,,"),
            (default_qos(Reliability::Drop, ParticleFrame::TYPE), "2::,10:,:,:,,"),
            (subscriber_qos(64), "2::,64:,:,:,,"),
            (QosProfile::default(), "::,10:,:,:,,"),
            (latched, ":1:,1:,:,:,,"),
        ] {
            let text = qos(&profile);
            assert_eq!(text, expected);
            let endpoint = endpoint("zenoh:/a", RosString::TYPE, Side::Publisher, &text);
            assert_eq!(qos_in(&endpoint.token), Some(profile), "{text}");
        }
        assert_eq!(service_qos(10), "::,10:,:,:,,");
    }

    #[test]
    fn a_depth_that_is_left_out_is_that_of_rmw_zenoh() {
        let of = |qos| qos_in(&endpoint("zenoh:/a", RosString::TYPE, Side::Publisher, qos).token);
        assert_eq!(of(":1:,:,:,:,,").map(|profile| profile.kept()), Some(42));
        assert_eq!([of("nothing"), of("::,many:,:,:,,")], [None, None]);
    }

    #[test]
    fn the_service_that_describes_types_is_that_of_the_node() {
        let hash = service_hash(GET_TYPE_DESCRIPTION).unwrap();
        let name = "type_description_interfaces::srv::dds_::GetTypeDescription_";
        for (namespace, path) in [("/", "eddy_node"), ("/robot1/left", "robot1/left/eddy_node")] {
            let node = Node { namespace: namespace.to_owned(), ..node() };
            let expected = format!("7/{path}/get_type_description/{name}/{hash}");
            assert_eq!(describing_service(7, &node.token()), Some(expected));
        }
    }

    /// One chunk more in ROS 2 Lyrical, perhaps more later.
    #[test]
    fn tokens_of_any_length_beyond_the_known_chunks_are_matched_and_read() {
        let known = endpoint("zenoh:/a/b", ParticleFrame::TYPE, Side::Publisher, "::,7:,:,:,,");
        let (type_name, hash) =
            (ParticleFrame::TYPE, &type_support(ParticleFrame::TYPE).unwrap().hash);
        let reader = endpoint("zenoh:/a/b", type_name, Side::Subscription, "");
        let expressions = [publishers(7), publishers_of(7, "/a/b", type_name, hash), reader.peers];
        for more in ["", "/backends:cpu", "/backends:cpu,cuda/later", "/a/b/c/d/e"] {
            let token = format!("{}{more}", known.token);
            for expression in &expressions {
                let expression = zenoh::key_expr::keyexpr::new(expression).unwrap();
                assert!(expression.intersects(token.as_str().try_into().unwrap()), "{token}");
            }
            assert_eq!(topic_in(&token).as_deref(), Some("/a/b"));
            assert_eq!(type_in(&token), Some((type_name.to_owned(), hash.as_str())));
            assert_eq!(qos_in(&token).map(|qos| qos.history), Some(HistoryPolicy::KeepLast(7)));
            assert!(describing_service(7, &token).is_some());
        }
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
