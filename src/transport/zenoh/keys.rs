//! Names on the wire: key expressions, liveliness tokens, quality of service, GIDs
//! (`rmw_zenoh_cpp/src/detail/liveliness_utils.cpp`; formatted by `hiroz-protocol`).

use hiroz_protocol::{
    EndpointEntity, EndpointKind, NodeEntity, RmwZenohFormatter, TypeHash, TypeInfo,
    format::KeyExprFormatter,
    qos::{QosDurability, QosHistory, QosProfile, QosReliability},
};
use zenoh::{key_expr::KeyExpr, session::ZenohId};

use crate::{
    msg::TypeSupport,
    transport::{Link, Reliability},
};

/// Messages kept for late readers, as advertised for dropping publishers (the ROS 2 default).
const ADVERTISED_DEPTH: usize = 10;

/// This process in the ROS graph.
pub(super) struct Node(NodeEntity);

impl Node {
    pub(super) fn new(domain_id: u16, zid: ZenohId, name: &str) -> Self {
        let (namespace, enclave) = (String::new(), String::new());
        Self(NodeEntity::new(domain_id.into(), zid, 0, name.to_owned(), namespace, enclave))
    }

    /// `@ros2_lv/<domain>/<zid>/<nid>/<nid>/NN/<enclave>/<namespace>/<node>`
    pub(super) fn token(&self) -> zenoh::Result<KeyExpr<'static>> {
        Ok(RmwZenohFormatter::node_liveliness_key_expr(&self.0)?.0)
    }
}

/// A publisher or subscriber of ours, as others see it.
pub(super) struct Endpoint {
    pub(super) link: Link,
    pub(super) domain_id: usize,
    /// ROS name of the type, such as `eddy_msgs/msg/ParticleFrame`.
    pub(super) type_name: String,
    /// `<domain>/<topic>/<type>/<hash>`
    pub(super) key: KeyExpr<'static>,
    /// `@ros2_lv/<domain>/<zid>/<nid>/<eid>/<MP|MS>/<enclave>/<namespace>/<node>/<topic>/<type>/<hash>/<qos>`
    pub(super) token: KeyExpr<'static>,
    /// XXH3-128 of the token, little-endian.
    pub(super) gid: [u8; 16],
}

impl Endpoint {
    pub(super) fn new(
        node: &Node,
        id: usize,
        kind: EndpointKind,
        link: &Link,
        support: &TypeSupport,
        qos: QosProfile,
    ) -> zenoh::Result<Self> {
        let hash = TypeHash::from_rihs_string(&support.hash)
            .ok_or_else(|| format!("type hash: found {}, expected RIHS01", support.hash))?;
        let dds_name = hiroz_schema::type_name::dds_from_canonical(&support.name)
            .ok_or_else(|| format!("type: found {}, expected package/msg/Name", support.name))?;
        let entity = EndpointEntity {
            id,
            node: Some(node.0.clone()),
            kind,
            topic: link.topic.clone(),
            type_info: Some(TypeInfo::new(&dds_name, hash)),
            qos,
        };
        let token = RmwZenohFormatter::liveliness_key_expr(&entity, &node.0.z_id)?.0;
        Ok(Self {
            link: link.clone(),
            domain_id: node.0.domain_id,
            type_name: support.name.clone(),
            key: (*RmwZenohFormatter::topic_key_expr(&entity)?).clone(),
            gid: gid(&token),
            token,
        })
    }
}

fn gid(token: &str) -> [u8; 16] {
    xxhash_rust::xxh3::xxh3_128(token.as_bytes()).to_le_bytes()
}

/// What a publisher promises.
pub(super) fn publisher_qos(reliability: Reliability) -> QosProfile {
    let (reliability, history) = match reliability {
        Reliability::Block => (QosReliability::Reliable, QosHistory::KeepAll),
        Reliability::Drop => (QosReliability::BestEffort, QosHistory::KeepLast(ADVERTISED_DEPTH)),
    };
    QosProfile { reliability, history, durability: QosDurability::Volatile, ..QosProfile::default() }
}

/// What a subscriber asks for: little, so that every publisher suits it.
pub(super) fn subscriber_qos(depth: usize) -> QosProfile {
    QosProfile {
        reliability: QosReliability::BestEffort,
        history: QosHistory::KeepLast(depth),
        durability: QosDurability::Volatile,
        ..QosProfile::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::msg::{Message, ParticleFrame, RosString, type_support};

    const ZID: &str = "1234567890abcdef1234567890abcdef";

    fn endpoint(link: &str, type_name: &str, kind: EndpointKind, qos: QosProfile) -> Endpoint {
        let node = Node::new(7, ZID.parse().unwrap(), "eddy_node");
        let support = type_support(type_name).unwrap();
        Endpoint::new(&node, 3, kind, &link.parse().unwrap(), support, qos).unwrap()
    }

    #[test]
    fn names_are_those_of_rmw_zenoh() {
        let string = endpoint(
            "zenoh:/chatter",
            RosString::TYPE,
            EndpointKind::Publisher,
            publisher_qos(Reliability::Block),
        );
        let hash = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18";
        assert_eq!(string.key.as_str(), format!("7/chatter/std_msgs::msg::dds_::String_/{hash}"));
        assert_eq!(
            string.token.as_str(),
            format!(
                "@ros2_lv/7/{ZID}/0/3/MP/%/%/eddy_node/%chatter/std_msgs::msg::dds_::String_/{hash}/::2,:,:,:,,"
            )
        );
    }

    #[test]
    fn inner_slashes_stay_in_keys_and_are_replaced_in_tokens() {
        let status = endpoint(
            "zenoh:/prediction/status",
            ParticleFrame::TYPE,
            EndpointKind::Subscription,
            subscriber_qos(64),
        );
        let hash = &type_support(ParticleFrame::TYPE).unwrap().hash;
        let name = "eddy_msgs::msg::dds_::ParticleFrame_";
        assert_eq!(status.key.as_str(), format!("7/prediction/status/{name}/{hash}"));
        assert_eq!(
            status.token.as_str(),
            format!("@ros2_lv/7/{ZID}/0/3/MS/%/%/eddy_node/%prediction%status/{name}/{hash}/2::,64:,:,:,,")
        );
    }

    #[test]
    fn the_node_has_a_token_of_its_own() {
        let node = Node::new(0, ZID.parse().unwrap(), "eddy_node");
        let expected = format!("@ros2_lv/0/{ZID}/0/0/NN/%/%/eddy_node");
        assert_eq!(node.token().unwrap().as_str(), expected);
    }

    #[test]
    fn quality_of_service_is_written_as_rmw_zenoh_writes_it() {
        let cases = [
            (publisher_qos(Reliability::Block), "::2,:,:,:,,"),
            (publisher_qos(Reliability::Drop), "2::,10:,:,:,,"),
            (subscriber_qos(64), "2::,64:,:,:,,"),
        ];
        for (qos, expected) in cases {
            assert_eq!(qos.encode(), expected);
        }
    }

    /// Computed with the Python package xxhash 4.1.0: `xxh3_128_intdigest(token).to_bytes(16, "little")`.
    #[test]
    fn the_gid_is_the_hash_of_the_token_in_little_endian() {
        let token = "@ros2_lv/0/1234567890abcdef1234567890abcdef/0/0/NN/%/%/eddy_node";
        let expected = [
            0xf5, 0xa6, 0x5f, 0x2e, 0x0b, 0xe1, 0xaf, 0xc6,
            0x33, 0x30, 0xca, 0x65, 0x3a, 0x17, 0xde, 0xff,
        ];
        assert_eq!(gid(token), expected);
    }
}
