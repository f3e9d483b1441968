//! Answers the requests of a service.
//!
//! A request is a query for the key of the service, with the CDR of the request as payload and the client's attachment;
//! the attachment of the reply has the same sequence number and GID, which identify it to the client
//! (`rmw_zenoh_cpp/src/detail/rmw_service_data.cpp`). Queries arrive on Zenoh's threads and are answered on a thread of
//! the service.

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

/// Capacity of the queue of requests, as in rmw_zenoh.
pub(super) const DEPTH: usize = 10;

/// A service; requests are answered until it is dropped.
pub(crate) struct ZenohService {
    _token: LivelinessToken,
    queryable: Option<Queryable<()>>,
    /// `None` stops the thread.
    requests: SyncSender<Option<Query>>,
    thread: Option<JoinHandle<()>>,
    /// Keeps the session open.
    _node: Arc<ZenohNode>,
}

impl ZenohService {
    pub(super) fn open(
        node: &Arc<ZenohNode>,
        endpoint: Endpoint,
        handler: Handler,
    ) -> Result<Self, TransportError> {
        let Endpoint { link, key, token, .. } = endpoint;
        let (requests, received) = sync_channel(DEPTH);
        let worker = Worker { link: link.clone(), key: key.clone(), handler };
        let thread = thread::Builder::new()
            .name("zenoh service".to_owned())
            .spawn(move || worker.run(&received))
            .map_err(|error: io::Error| middleware(&link, "offer the service", &error))?;
        let sender = requests.clone();
        // Clients query complete queryables only.
        let queryable = node
            .session
            .declare_queryable(key)
            .complete(true)
            .callback(move |query| enqueue(&sender, query))
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
        // Requests in the queue are still answered.
        if self.requests.send(None).is_ok()
            && let Some(thread) = self.thread.take()
        {
            let _ = thread.join();
        }
    }
}

/// Rejects the request if the queue is full, so that Zenoh's thread never waits.
fn enqueue(requests: &SyncSender<Option<Query>>, query: Query) {
    if let Err(TrySendError::Full(Some(query))) = requests.try_send(Some(query)) {
        reject(&query, "busy: too many pending requests");
    }
}

/// Answers requests.
struct Worker {
    link: Link,
    key: String,
    handler: Handler,
}

impl Worker {
    fn run(mut self, requests: &Receiver<Option<Query>>) {
        while let Ok(Some(query)) = requests.recv() {
            self.answer(&query);
        }
    }

    fn answer(&mut self, query: &Query) {
        let request = query.payload().map(|bytes| bytes.to_bytes()).unwrap_or_default();
        let Some(response) = (self.handler)(&request) else {
            return reject(
                query,
                "no response: the payload is not a request of this service, or the node is busy",
            );
        };
        // Clients without a valid attachment are not ROS and expect none.
        let attachment = query.attachment().and_then(|bytes| Attachment::parse(&bytes.to_bytes()));
        let attachment = attachment
            .map(|request| Attachment { source_time: clock::wall().0, ..request }.to_bytes());
        let reply = query.reply(self.key.as_str(), response).attachment(attachment);
        if let Err(error) = reply.wait() {
            tracing::warn!("{}: {error}", self.link);
        }
    }
}

fn reject(query: &Query, reason: &str) {
    if let Err(error) = query.reply_err(reason).wait() {
        tracing::warn!("{}: {error}", query.key_expr());
    }
}
