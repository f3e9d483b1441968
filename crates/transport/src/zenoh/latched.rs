//! Messages for subscribers that come later (transient local): their publisher keeps the last ones and
//! answers queries for them.
//!
//! The wire is that of zenoh-ext's `AdvancedPublisher` and `AdvancedSubscriber`, which rmw_zenoh uses for such topics
//! (`zenoh-ext/src/advanced_publisher.rs`, `advanced_cache.rs`): a queryable and a liveliness token, both at
//! `<key>/@adv/pub/<zid>/uhlc/_`, for a publisher whose messages are told apart by their timestamps. It replies
//! under `<key>` itself, with the newest `_max` messages, the oldest first. zenoh-ext itself needs zenoh's features
//! `unstable` and `internal`; what of it eddy uses takes neither.

use std::{
    collections::VecDeque,
    num::NonZeroUsize,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
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

/// How long a publisher may take to give what it kept.
const PATIENCE: Duration = Duration::from_secs(10);

/// The last messages of a publisher, and who gives them away.
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
        let place = format!("{key}/@adv/pub/{}/uhlc/_", session.zid());
        let messages = Arc::<Mutex<VecDeque<Message>>>::default();
        let (asked, key) = (Arc::clone(&messages), key.to_owned());
        let queryable = session
            .declare_queryable(&place)
            .callback(move |query| give(&asked, &key, &query))
            .wait()?;
        let token = graph::declare(session, &place)?;
        Ok(Self { messages, depth, _queryable: queryable, _token: token })
    }

    /// Adds a message, which is published under the same timestamp.
    pub(super) fn keep(&self, payload: ZBytes, attachment: [u8; LENGTH], timestamp: Timestamp) {
        let mut messages = lock(&self.messages);
        if messages.len() >= self.depth.get() {
            messages.pop_front();
        }
        messages.push_back(Message { payload, attachment, timestamp });
    }
}

/// Replies with the newest messages, as many as are wanted. A peer that takes them slowly does not keep the
/// publisher from adding others.
fn give(kept: &Mutex<VecDeque<Message>>, key: &str, query: &Query) {
    let most = query.parameters().get("_max").and_then(|most| most.parse().ok());
    let mut messages = lock(kept).clone();
    messages.drain(..messages.len().saturating_sub(most.unwrap_or(usize::MAX)));
    for Message { payload, attachment, timestamp } in messages {
        let reply = query.reply(key, payload).attachment(attachment).timestamp(timestamp);
        if let Err(error) = reply.wait() {
            tracing::warn!("{key}: a kept message is not given: {error}");
        }
    }
}

/// Hands over what publishers on `key` have kept, of each when it appears: the newest `most` messages.
pub(super) fn collect(
    node: &Arc<ZenohNode>,
    key: &str,
    most: usize,
    take: impl Fn(&Sample) + Clone + Send + Sync + 'static,
) -> zenoh::Result<pubsub::Subscriber<()>> {
    let asking = Arc::downgrade(node);
    node.session
        .liveliness()
        .declare_subscriber(format!("{key}/@adv/pub/**"))
        .history(true)
        .callback(move |token| {
            let Some(node) = asking.upgrade() else { return };
            if token.kind() == SampleKind::Put {
                let place = format!("{}?_max={most}", token.key_expr());
                if let Err(error) = ask(&node.session, &place, take.clone()) {
                    tracing::warn!("{place}: what was kept is not asked for: {error}");
                }
            }
        })
        .wait()
}

fn ask(
    session: &Session,
    place: &str,
    take: impl Fn(&Sample) + Send + Sync + 'static,
) -> zenoh::Result<()> {
    session
        .get(place)
        .target(QueryTarget::All)
        .consolidation(ConsolidationMode::None)
        // They come under the key of the topic.
        .accept_replies(ReplyKeyExpr::Any)
        .timeout(PATIENCE)
        .callback(move |reply| {
            if let Ok(message) = reply.result() {
                take(message);
            }
        })
        .wait()
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // Never left half changed: every change is one push or pop.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
