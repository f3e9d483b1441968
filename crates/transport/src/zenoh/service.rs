//! Answers the requests of one service.
//!
//! A request is a query for the service's key, with the request's CDR as its payload and the client's attachment;
//! the reply has an attachment with the same sequence and GID, by which the client knows it
//! (`rmw_zenoh_cpp/src/detail/rmw_service_data.cpp`). Queries come on zenoh's threads and are answered on a
//! thread of the service's own.

use std::{
    io,
    sync::{
        Arc,
        mpsc::{Receiver, SyncSender, TrySendError, sync_channel},
    },
    thread::{self, JoinHandle},
};

use zenoh::{
    Wait,
    liveliness::LivelinessToken,
    query::{Query, Queryable},
};

use super::{ZenohNode, attachment::Attachment, graph, keys::Endpoint, middleware};
use crate::{Handler, Link, Served, TransportError};
use eddy_frames::clock;

/// Requests that may wait, as rmw_zenoh's services have it.
pub(super) const DEPTH: usize = 10;

/// A service that is answered as long as this lives.
pub(crate) struct ZenohService {
    _token: LivelinessToken,
    queryable: Option<Queryable<()>>,
    /// `None` ends the thread.
    requests: SyncSender<Option<Query>>,
    thread: Option<JoinHandle<()>>,
    /// The session ends with its last user.
    _node: Arc<ZenohNode>,
}

impl ZenohService {
    pub(super) fn open(
        node: &Arc<ZenohNode>,
        endpoint: Endpoint,
        handler: Handler,
    ) -> Result<Self, TransportError> {
        let Endpoint { link, key, token, .. } = endpoint;
        let (requests, taken) = sync_channel(DEPTH);
        let desk = Desk { link: link.clone(), key: key.clone(), handler };
        let thread = thread::Builder::new()
            .name("zenoh service".to_owned())
            .spawn(move || desk.run(&taken))
            .map_err(|error: io::Error| middleware(&link, "offer the service", &error))?;
        let arrivals = requests.clone();
        // Clients ask those only that answer for the whole key.
        let queryable = node
            .session
            .declare_queryable(key)
            .complete(true)
            .callback(move |query| take(&arrivals, query))
            .wait()
            .map_err(|error| middleware(&link, "offer the service", &error))?;
        let token = graph::declare(&node.session, &token)
            .map_err(|error| middleware(&link, "declare the liveliness token", &error))?;
        let (queryable, thread, _node) = (Some(queryable), Some(thread), Arc::clone(node));
        Ok(Self { _token: token, queryable, requests, thread, _node })
    }
}

impl Served for ZenohService {}

impl Drop for ZenohService {
    fn drop(&mut self) {
        drop(self.queryable.take());
        // What was asked before is still answered.
        if self.requests.send(None).is_ok()
            && let Some(thread) = self.thread.take()
        {
            let _ = thread.join();
        }
    }
}

/// Zenoh's thread waits for nothing: who asks a service that is behind is told so.
fn take(requests: &SyncSender<Option<Query>>, query: Query) {
    if let Err(TrySendError::Full(Some(query))) = requests.try_send(Some(query)) {
        refuse(&query, "busy: too many requests wait to be answered");
    }
}

/// Where requests are answered.
struct Desk {
    link: Link,
    key: String,
    handler: Handler,
}

impl Desk {
    fn run(mut self, requests: &Receiver<Option<Query>>) {
        while let Ok(Some(query)) = requests.recv() {
            self.answer(&query);
        }
    }

    fn answer(&mut self, query: &Query) {
        let request = query.payload().map(|bytes| bytes.to_bytes()).unwrap_or_default();
        let Some(response) = (self.handler)(&request) else {
            return refuse(
                query,
                "no answer: the payload is no request of this service, or who should answer is busy",
            );
        };
        // Who sent none, or one of another form, is not ROS and expects none.
        let attachment = query.attachment().and_then(|bytes| Attachment::parse(&bytes.to_bytes()));
        let attachment =
            attachment.map(|asked| Attachment { source_time: clock::wall().0, ..asked }.to_bytes());
        let reply = query.reply(self.key.as_str(), response).attachment(attachment);
        if let Err(error) = reply.wait() {
            tracing::warn!("{}: {error}", self.link);
        }
    }
}

fn refuse(query: &Query, reason: &str) {
    if let Err(error) = query.reply_err(reason).wait() {
        tracing::warn!("{}: {error}", query.key_expr());
    }
}
