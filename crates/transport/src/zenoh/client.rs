//! Sends requests to services of other nodes.
//!
//! A request is a query for the key of the service with the attachment of a message; see [`service`](super::service).

use std::{collections::BTreeSet, time::Duration};

use zenoh::{
    Session, Wait,
    query::{ConsolidationMode, QueryTarget},
};

use super::{attachment::Attachment, graph, keys};
use crate::SeenTopic;
use eddy_frames::clock;

/// Asks the nodes of the publishers of a topic for the definition of its type. The answers are CDR bytes.
pub(super) fn describe(
    session: &Session,
    domain_id: u16,
    topic: &SeenTopic,
    request: &[u8],
    timeout: Duration,
) -> zenoh::Result<Vec<Vec<u8>>> {
    let SeenTopic { link, type_name, hash, .. } = topic;
    let hash = hash.as_deref().unwrap_or("*");
    let publishers = keys::publishers_of(domain_id, &link.topic, type_name, hash);
    let tokens = graph::tokens(session, &publishers)?;
    let services: BTreeSet<String> =
        tokens.iter().filter_map(|token| keys::describing_service(domain_id, token)).collect();
    let mut answers = Vec::new();
    for service in services {
        answers.extend(call(session, &service, request, timeout)?);
    }
    Ok(answers)
}

/// The responses of all services with this key.
pub(super) fn call(
    session: &Session,
    key: &str,
    request: &[u8],
    timeout: Duration,
) -> zenoh::Result<Vec<Vec<u8>>> {
    let attachment = Attachment { sequence: 1, source_time: clock::wall().0, gid: keys::gid(key) };
    let replies = session
        .get(key)
        .payload(request.to_vec())
        .attachment(attachment.to_bytes())
        .target(QueryTarget::AllComplete)
        .consolidation(ConsolidationMode::None)
        .timeout(timeout)
        .wait()?;
    let replies = replies.iter().filter_map(|reply| reply.into_result().ok());
    Ok(replies.map(|reply| reply.payload().to_bytes().into_owned()).collect())
}
