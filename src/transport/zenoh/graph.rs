//! Who else is on a topic: the liveliness tokens of the other side.

use std::{
    collections::HashSet,
    sync::{Arc, Mutex, PoisonError},
};

use hiroz_protocol::entity::EndpointKind;
use zenoh::{Session, Wait, key_expr::KeyExpr, liveliness::LivelinessToken, pubsub, sample::SampleKind};

use super::keys::Endpoint;

/// The endpoints of the other kind on our topic: counted, and told from those of another type.
pub(super) struct Graph {
    matching: Arc<Mutex<HashSet<String>>>,
    _watch: pubsub::Subscriber<()>,
}

impl Graph {
    /// Watches the endpoints of `kind` on the topic of `endpoint`.
    ///
    /// Type and hash are part of a topic's key, so messages of another type never arrive. What
    /// would be silence is a warning here, once for each type.
    pub(super) fn watch(
        session: &Session,
        endpoint: &Endpoint,
        kind: EndpointKind,
    ) -> zenoh::Result<Self> {
        let topic = endpoint.link.topic.replace('/', "%");
        let domain = endpoint.domain_id;
        let tokens = format!("@ros2_lv/{domain}/*/*/*/{kind}/*/*/*/{topic}/*/*/*");
        let matching = Arc::new(Mutex::new(HashSet::new()));
        let observed = Arc::clone(&matching);
        let (link, expected) = (endpoint.link.clone(), endpoint.type_name.clone());
        let own_type = type_chunks(&endpoint.token).map(|(name, hash)| (name.to_owned(), hash.to_owned()));
        let foreign = Mutex::new(HashSet::new());
        let watch = session
            .liveliness()
            .declare_subscriber(tokens)
            .history(true)
            .callback(move |sample| {
                let token = sample.key_expr().as_str();
                let found = type_chunks(token).map(|(name, hash)| (name.to_owned(), hash.to_owned()));
                if found == own_type {
                    let mut observed = observed.lock().unwrap_or_else(PoisonError::into_inner);
                    match sample.kind() {
                        SampleKind::Put => observed.insert(token.to_owned()),
                        SampleKind::Delete => observed.remove(token),
                    };
                } else if let Some((name, hash)) = found
                    && sample.kind() == SampleKind::Put
                    && foreign.lock().unwrap_or_else(PoisonError::into_inner).insert((name.clone(), hash.clone()))
                {
                    let found = hiroz_schema::type_name::ros_from_dds_strict(&name);
                    tracing::warn!(
                        "{link}: found message type {found} ({hash}), expected {expected}: its messages are not exchanged"
                    );
                }
            })
            .wait()?;
        Ok(Self { matching, _watch: watch })
    }

    /// How many endpoints there are of our type.
    pub(super) fn matching(&self) -> usize {
        self.matching.lock().unwrap_or_else(PoisonError::into_inner).len()
    }
}

/// Type and hash in an endpoint's token.
fn type_chunks(token: &str) -> Option<(&str, &str)> {
    let mut chunks = token.split('/').skip(10);
    Some((chunks.next()?, chunks.next()?))
}

/// Shows an endpoint to the others until it is dropped.
pub(super) fn declare(session: &Session, token: &KeyExpr<'static>) -> zenoh::Result<LivelinessToken> {
    session.liveliness().declare_token(token.clone()).wait()
}
