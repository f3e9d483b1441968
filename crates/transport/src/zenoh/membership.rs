//! Membership of a group: one liveliness token per process.
//!
//! Zenoh withdraws the tokens of a process when its connection ends: at once when it dies, since the system closes its
//! sockets, and after its lease (`transport/link/tx/lease`, which a process announces to its peers) when it is silent. A
//! router withdraws the tokens of its clients from all others in the same way.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::{Arc, Mutex},
    time::Duration,
};

use eddy_frames::clock::Clock;

use zenoh::{Wait, liveliness::LivelinessToken, pubsub, sample::SampleKind};

use super::{ZenohNode, graph, middleware};
use crate::{Lease, Link, TransportError, lock, membership::Membership};

/// Longest interruption that [`Membership::is_connected`] may miss by looking at the connections.
const BRIEF: Duration = Duration::from_millis(200);

pub(super) struct ZenohMembership {
    link: Link,
    /// Prefix of the tokens: `eddy/group/<domain>/<topic, / as %>/<group>`
    prefix: String,
    /// Id of this process: `<session>-<left>-<label>`
    id: String,
    /// How often it has left.
    left: u64,
    label: String,
    tokens: Arc<Mutex<Tokens>>,
    token: Option<LivelinessToken>,
    _watch: pubsub::Subscriber<()>,
    node: Arc<ZenohNode>,
}

impl ZenohMembership {
    /// Watches the members of `group` among the processes that read the topic of `link`, which see `label` in the id of
    /// this one.
    pub(super) fn open(
        node: &Arc<ZenohNode>,
        link: &Link,
        group: &str,
        label: &str,
    ) -> Result<Self, TransportError> {
        let prefix =
            format!("eddy/group/{}/{}/{group}", node.node.domain_id, link.topic.replace('/', "%"));
        let tokens = Arc::new(Mutex::new(Tokens::new(own(node))));
        let (seen, clock) = (Arc::clone(&tokens), Clock::start());
        let watch = node
            .session
            .liveliness()
            .declare_subscriber(format!("{prefix}/*"))
            .history(true)
            .callback(move |sample| {
                let Some((_, id)) = sample.key_expr().as_str().rsplit_once('/') else { return };
                match sample.kind() {
                    SampleKind::Put => lock(&seen).appears(id, clock.now()),
                    SampleKind::Delete => lock(&seen).vanishes(id, clock.now()),
                }
            })
            .wait()
            .map_err(|error| middleware(link, "watch the members of the group", &error))?;
        Ok(Self {
            link: link.clone(),
            prefix,
            id: id(node, 0, label),
            left: 0,
            label: label.to_owned(),
            tokens,
            token: None,
            _watch: watch,
            node: Arc::clone(node),
        })
    }
}

/// What the ids of this process begin with.
fn own(node: &ZenohNode) -> String {
    format!("{}-", node.node.zid)
}

/// Two nodes never have the same id, nor one node twice.
fn id(node: &ZenohNode, left: u64, label: &str) -> String {
    format!("{}{left}-{label}", own(node))
}

impl Membership for ZenohMembership {
    fn id(&self) -> &str {
        &self.id
    }

    fn join(&mut self) -> Result<(), TransportError> {
        let token = graph::declare(&self.node.session, &format!("{}/{}", self.prefix, self.id))
            .map_err(|error| middleware(&self.link, "join the group", &error))?;
        self.token = Some(token);
        Ok(())
    }

    fn leave(&mut self) {
        self.token = None;
        self.left += 1;
        self.id = id(&self.node, self.left, &self.label);
    }

    fn members(&self) -> BTreeSet<String> {
        let own = self.token.is_some().then(|| self.id.clone());
        lock(&self.tokens).others.iter().cloned().chain(own).collect()
    }

    fn is_connected(&mut self) -> bool {
        let was_interrupted = std::mem::take(&mut lock(&self.tokens).was_interrupted);
        let info = self.node.session.info();
        let mut connections = info.peers_zid().wait().chain(info.routers_zid().wait());
        !was_interrupted && connections.next().is_some()
    }

    fn lease(&self) -> Lease {
        self.node.lease
    }
}

/// The tokens of other processes.
#[derive(Debug)]
struct Tokens {
    own: String,
    others: BTreeSet<String>,
    /// When those that are gone vanished.
    vanished: BTreeMap<String, Duration>,
    was_interrupted: bool,
}

impl Tokens {
    fn new(own: String) -> Self {
        Self { own, others: BTreeSet::new(), vanished: BTreeMap::new(), was_interrupted: false }
    }

    /// Zenoh announces the tokens that exist when it connects again: when all have vanished and one comes back, the
    /// connections were interrupted, however briefly. Nobody else joins under an id that has vanished.
    fn appears(&mut self, id: &str, now: Duration) {
        // This process knows of its own tokens without zenoh, which may still be on their way.
        if id.starts_with(&self.own) {
            return;
        }
        let is_back = self.vanished.remove(id).is_some_and(|then| now.saturating_sub(then) < BRIEF);
        self.was_interrupted |= is_back && self.others.is_empty();
        self.others.insert(id.to_owned());
    }

    fn vanishes(&mut self, id: &str, now: Duration) {
        if self.others.remove(id) {
            self.vanished.retain(|_, then| now.saturating_sub(*then) < BRIEF);
            self.vanished.insert(id.to_owned(), now);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ms(milliseconds: u64) -> Duration {
        Duration::from_millis(milliseconds)
    }

    fn two_others() -> Tokens {
        let mut tokens = Tokens::new("me-".to_owned());
        ["a-0", "b-0"].into_iter().for_each(|id| tokens.appears(id, ms(0)));
        tokens
    }

    #[test]
    fn the_connections_were_interrupted_when_all_others_vanish_and_one_comes_back() {
        let mut tokens = two_others();
        ["a-0", "b-0"].into_iter().for_each(|id| tokens.vanishes(id, ms(1_000)));
        assert!(!tokens.was_interrupted);
        ["a-0", "b-0"].into_iter().for_each(|id| tokens.appears(id, ms(1_003)));
        assert!(tokens.was_interrupted);
        assert_eq!(tokens.others, ["a-0", "b-0"].map(str::to_owned).into());
    }

    #[test]
    fn others_that_die_join_or_were_cut_off_are_no_interruption_here() {
        let mut tokens = two_others();
        // One of two is cut off for a moment.
        tokens.vanishes("a-0", ms(1_000));
        tokens.appears("a-0", ms(1_003));
        // Both die, and another one joins.
        ["a-0", "b-0"].into_iter().for_each(|id| tokens.vanishes(id, ms(2_000)));
        tokens.appears("c-0", ms(2_003));
        // The last one is cut off for longer, while this process was connected to others.
        tokens.vanishes("c-0", ms(3_000));
        tokens.appears("c-0", ms(4_000));
        assert!(!tokens.was_interrupted);
    }

    #[test]
    fn own_tokens_are_not_among_the_others() {
        let mut tokens = two_others();
        tokens.appears("me-0-label", ms(0));
        assert_eq!(tokens.others.len(), 2);
    }
}
