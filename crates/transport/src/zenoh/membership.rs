//! Membership of a group: one liveliness token per process.
//!
//! Zenoh withdraws the tokens of a process when its connection ends: at once when it dies, since the system closes its
//! sockets, and after its lease (`transport/link/tx/lease`, which a process announces to its peers) when it is silent. A
//! router withdraws the tokens of its clients from all others in the same way.

use std::{
    collections::BTreeSet,
    sync::{Arc, Mutex},
};

use zenoh::{Wait, liveliness::LivelinessToken, pubsub, sample::SampleKind};

use super::{ZenohNode, graph, middleware};
use crate::{Lease, Link, TransportError, lock, membership::Membership};

pub(super) struct ZenohMembership {
    link: Link,
    /// Prefix of the tokens: `eddy/group/<domain>/<topic, / as %>/<group>`
    prefix: String,
    /// Id of this process: `<session>-<left>-<label>`
    id: String,
    /// How often it has left.
    left: u64,
    label: String,
    members: Arc<Mutex<BTreeSet<String>>>,
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
        let members = Arc::<Mutex<BTreeSet<String>>>::default();
        let seen = Arc::clone(&members);
        let watch = node
            .session
            .liveliness()
            .declare_subscriber(format!("{prefix}/*"))
            .history(true)
            .callback(move |sample| {
                let Some((_, id)) = sample.key_expr().as_str().rsplit_once('/') else { return };
                match sample.kind() {
                    SampleKind::Put => lock(&seen).insert(id.to_owned()),
                    SampleKind::Delete => lock(&seen).remove(id),
                };
            })
            .wait()
            .map_err(|error| middleware(link, "watch the members of the group", &error))?;
        Ok(Self {
            link: link.clone(),
            prefix,
            id: id(node, 0, label),
            left: 0,
            label: label.to_owned(),
            members,
            token: None,
            _watch: watch,
            node: Arc::clone(node),
        })
    }
}

/// Two nodes never have the same id, nor one node twice.
fn id(node: &ZenohNode, left: u64, label: &str) -> String {
    format!("{}-{left}-{label}", node.node.zid)
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
        // The tokens of this process that are still on their way do not count.
        let own = format!("{}-", self.node.node.zid);
        let is_known =
            |id: &&String| !id.starts_with(&own) || self.token.is_some() && **id == self.id;
        lock(&self.members).iter().filter(is_known).cloned().collect()
    }

    fn is_connected(&self) -> bool {
        let info = self.node.session.info();
        info.peers_zid().wait().next().is_some() || info.routers_zid().wait().next().is_some()
    }

    fn lease(&self) -> Lease {
        self.node.lease
    }
}
