//! Transient local durability: a publisher keeps its last messages and answers queries of late-joining subscribers.
//!
//! The wire format is that of zenoh-ext's `AdvancedPublisher` and `AdvancedSubscriber`, which rmw_zenoh uses
//! (`zenoh-ext/src/advanced_publisher.rs`, `advanced_cache.rs`): a queryable and a liveliness token, both at
//! `<key>/@adv/pub/<zid>/uhlc/_`, where messages are identified by their timestamps. Replies have the key `<key>` and
//! hold the newest `_max` messages, oldest first. zenoh-ext needs zenoh's features `unstable` and `internal`, the parts
//! used here do not.

use std::{
    collections::VecDeque,
    num::NonZeroUsize,
    sync::{Arc, Mutex},
    time::Duration,
};

use zenoh::{
    Session, Wait,
    bytes::ZBytes,
    liveliness::LivelinessToken,
    pubsub,
    query::{ConsolidationMode, Query, QueryTarget, Queryable, ReplyKeyExpr},
    sample::{Sample, SampleKind},
    time::Timestamp,
};

use super::{ZenohNode, attachment::LENGTH, graph};
use crate::lock;

/// Timeout of a query for kept messages.
const QUERY_TIMEOUT: Duration = Duration::from_secs(10);

/// The last messages of a publisher, and the queryable that returns them.
pub(super) struct Kept {
    messages: Arc<Mutex<VecDeque<Message>>>,
    depth: NonZeroUsize,
    _queryable: Queryable<()>,
    _token: LivelinessToken,
}

#[derive(Clone)]
struct Message {
    payload: ZBytes,
    attachment: [u8; LENGTH],
    timestamp: Timestamp,
}

impl Kept {
    /// Keeps the last `depth` messages of the publisher on `key`.
    pub(super) fn open(session: &Session, key: &str, depth: NonZeroUsize) -> zenoh::Result<Self> {
        let key_expr = format!("{key}/@adv/pub/{}/uhlc/_", session.zid());
        let messages = Arc::<Mutex<VecDeque<Message>>>::default();
        let (kept, key) = (Arc::clone(&messages), key.to_owned());
        let queryable = session
            .declare_queryable(&key_expr)
            .callback(move |query| reply(&kept, &key, &query))
            .wait()?;
        let token = graph::declare(session, &key_expr)?;
        Ok(Self { messages, depth, _queryable: queryable, _token: token })
    }

    /// Adds a message that is published with the same timestamp.
    pub(super) fn keep(&self, payload: ZBytes, attachment: [u8; LENGTH], timestamp: Timestamp) {
        let mut messages = lock(&self.messages);
        if messages.len() >= self.depth.get() {
            messages.pop_front();
        }
        messages.push_back(Message { payload, attachment, timestamp });
    }
}

/// Replies with the newest messages, up to the requested number. The messages are copied first, so that a slow peer
/// does not block the publisher.
fn reply(kept: &Mutex<VecDeque<Message>>, key: &str, query: &Query) {
    let most = query.parameters().get("_max").and_then(|most| most.parse().ok());
    let mut messages = lock(kept).clone();
    messages.drain(..messages.len().saturating_sub(most.unwrap_or(usize::MAX)));
    for Message { payload, attachment, timestamp } in messages {
        let reply = query.reply(key, payload).attachment(attachment).timestamp(timestamp);
        if let Err(error) = reply.wait() {
            tracing::warn!("{key}: cannot send a kept message: {error}");
        }
    }
}

/// Calls `take` for the newest `most` messages that each publisher on `key` has kept, when the publisher appears.
pub(super) fn collect(
    node: &Arc<ZenohNode>,
    key: &str,
    most: usize,
    take: impl Fn(&Sample) + Clone + Send + Sync + 'static,
) -> zenoh::Result<pubsub::Subscriber<()>> {
    let weak = Arc::downgrade(node);
    node.session
        .liveliness()
        .declare_subscriber(format!("{key}/@adv/pub/**"))
        .history(true)
        .callback(move |token| {
            let Some(node) = weak.upgrade() else { return };
            if token.kind() == SampleKind::Put {
                let selector = format!("{}?_max={most}", token.key_expr());
                if let Err(error) = request(&node.session, &selector, take.clone()) {
                    tracing::warn!("{selector}: cannot request kept messages: {error}");
                }
            }
        })
        .wait()
}

fn request(
    session: &Session,
    selector: &str,
    take: impl Fn(&Sample) + Send + Sync + 'static,
) -> zenoh::Result<()> {
    session
        .get(selector)
        .target(QueryTarget::All)
        .consolidation(ConsolidationMode::None)
        // Replies have the key of the topic.
        .accept_replies(ReplyKeyExpr::Any)
        .timeout(QUERY_TIMEOUT)
        .callback(move |reply| {
            if let Ok(message) = reply.result() {
                take(message);
            }
        })
        .wait()
}
