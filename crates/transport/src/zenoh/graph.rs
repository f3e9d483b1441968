//! Other endpoints of a topic, by their liveliness tokens.

use std::{
    collections::{BTreeMap, HashSet},
    sync::{Arc, Mutex},
};

use zenoh::{Session, Wait, liveliness::LivelinessToken, pubsub, sample::SampleKind};

use super::keys::{Endpoint, publishers, qos_in, services as all_services, topic_in, type_in};
use crate::{SeenService, SeenTopic, TransportKind, lock};
use eddy_messages::QosProfile;

/// The endpoints on the other side of a topic with the same type.
pub(super) struct Graph {
    matching: Arc<Mutex<HashSet<String>>>,
    _watch: pubsub::Subscriber<()>,
}

impl Graph {
    /// Watches the other side of the topic of `endpoint`.
    ///
    /// Type and hash are part of the key, so messages of another type never arrive. Endpoints of another type cause a
    /// warning, once per type.
    pub(super) fn watch(session: &Session, endpoint: &Endpoint) -> zenoh::Result<Self> {
        let matching = Arc::new(Mutex::new(HashSet::new()));
        let observed = Arc::clone(&matching);
        let foreign = Mutex::new(HashSet::new());
        let (link, own_token) = (endpoint.link.clone(), endpoint.token.clone());
        let watch = session
            .liveliness()
            .declare_subscriber(&endpoint.peers)
            .history(true)
            .callback(move |sample| {
                let token = sample.key_expr().as_str();
                let (Some(found), Some(expected)) = (type_in(token), type_in(&own_token)) else {
                    return;
                };
                let appears = sample.kind() == SampleKind::Put;
                if found == expected {
                    let mut observed = lock(&observed);
                    if appears { observed.insert(token.to_owned()) } else { observed.remove(token) };
                } else if appears && lock(&foreign).insert((found.0.clone(), found.1.to_owned())) {
                    tracing::warn!(
                        "{link}: found message type {} ({}), expected {} ({}); these messages are not exchanged",
                        found.0, found.1, expected.0, expected.1
                    );
                }
            })
            .wait()?;
        Ok(Self { matching, _watch: watch })
    }

    /// Number of endpoints with the same type.
    pub(super) fn matching(&self) -> usize {
        lock(&self.matching).len()
    }
}

/// The topics with a publisher.
pub(super) fn topics(session: &Session, domain_id: u16) -> zenoh::Result<Vec<SeenTopic>> {
    let seen = |token: &str| {
        let (topic, (type_name, hash)) = (topic_in(token)?, type_in(token)?);
        let link = format!("{}:{topic}", TransportKind::Zenoh).parse().ok()?;
        Some(SeenTopic { hash: Some(hash.to_owned()), ..SeenTopic::new(link, type_name) })
    };
    let mut topics: BTreeMap<SeenTopic, Vec<QosProfile>> = BTreeMap::new();
    for token in tokens(session, &publishers(domain_id))? {
        if let Some(topic) = seen(&token) {
            topics.entry(topic).or_default().extend(qos_in(&token));
        }
    }
    let with_offered = |(topic, mut offered): (_, Vec<_>)| {
        offered.sort();
        SeenTopic { offered, ..topic }
    };
    Ok(topics.into_iter().map(with_offered).collect())
}

/// The services of all nodes.
pub(super) fn services(session: &Session, domain_id: u16) -> zenoh::Result<Vec<SeenService>> {
    let seen = |token: &String| {
        let (name, (type_name, hash)) = (topic_in(token)?, type_in(token)?);
        let link = format!("{}:{name}", TransportKind::Zenoh).parse().ok()?;
        Some(SeenService { link, type_name, hash: Some(hash.to_owned()) })
    };
    Ok(tokens(session, &all_services(domain_id))?.iter().filter_map(seen).collect())
}

/// The tokens that match a key expression.
pub(super) fn tokens(session: &Session, key_expr: &str) -> zenoh::Result<Vec<String>> {
    let replies = session.liveliness().get(key_expr).wait()?;
    let tokens = replies.iter().filter_map(|reply| reply.into_result().ok());
    Ok(tokens.map(|token| token.key_expr().to_string()).collect())
}

/// Announces a node or an endpoint until the token is dropped.
pub(super) fn declare(session: &Session, token: &str) -> zenoh::Result<LivelinessToken> {
    session.liveliness().declare_token(token.to_owned()).wait()
}
