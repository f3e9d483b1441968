//! Other endpoints of a topic, by their liveliness tokens.

use std::{
    collections::{BTreeMap, HashSet},
    num::NonZeroUsize,
    sync::{Arc, Mutex},
};

use zenoh::{Session, Wait, liveliness::LivelinessToken, pubsub, sample::SampleKind};

use super::keys::{Endpoint, kept_in, publishers, topic_in, type_in};
use crate::{SeenTopic, TransportKind, lock};

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

/// The topics with a publisher. The kept messages of several publishers add up; a volatile publisher makes the topic
/// volatile.
pub(super) fn topics(session: &Session, domain_id: u16) -> zenoh::Result<Vec<SeenTopic>> {
    let replies = session.liveliness().get(publishers(domain_id)).wait()?;
    let seen = |token: &str| {
        let (topic, (type_name, hash)) = (topic_in(token)?, type_in(token)?);
        let link = format!("{}:{topic}", TransportKind::Zenoh).parse().ok()?;
        Some(SeenTopic { link, type_name, hash: Some(hash.to_owned()), kept: 0 })
    };
    let mut topics: BTreeMap<SeenTopic, Option<usize>> = BTreeMap::new();
    for token in replies.iter().filter_map(|reply| reply.into_result().ok()) {
        let token = token.key_expr().as_str();
        let Some(topic) = seen(token) else { continue };
        let kept = kept_in(token).map(NonZeroUsize::get);
        topics
            .entry(topic)
            .and_modify(|sum| *sum = sum.zip(kept).map(|(sum, kept)| sum.saturating_add(kept)))
            .or_insert(kept);
    }
    let with_kept =
        |(topic, kept): (_, Option<_>)| SeenTopic { kept: kept.unwrap_or_default(), ..topic };
    Ok(topics.into_iter().map(with_kept).collect())
}

/// Announces a node or an endpoint until the token is dropped.
pub(super) fn declare(session: &Session, token: &str) -> zenoh::Result<LivelinessToken> {
    session.liveliness().declare_token(token.to_owned()).wait()
}
