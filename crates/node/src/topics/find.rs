//! Waits until a topic is published.

use std::{thread, time::Duration};

use eddy_frames::clock::Clock;
use eddy_transport::{Link, SeenTopic, TransportError, TransportKind, Transports};

/// How long to wait for a publisher.
pub const MAX_FIND_TIME: Duration = Duration::from_secs(30);
/// Delay before a warning that the topic is not published yet: time for the transports to find their topics.
const WARNING_DELAY: Duration = Duration::from_secs(1);
/// Interval between searches.
const SEARCH_INTERVAL: Duration = Duration::from_millis(50);

/// Why a topic was not found.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the message says what the fields are")]
pub enum FindError {
    /// The transport cannot list its topics.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// Nobody publishes the topic.
    #[error(
        "{link}: no publisher appeared within {} s; available topics {available}",
        timeout.as_secs_f64()
    )]
    Timeout { link: Link, timeout: Duration, available: String },
}

/// Waits up to `timeout` for a publisher of `link`, from the first list of topics on. `None` when `is_stopped` first.
///
/// # Errors
/// [`FindError`].
pub fn find_topic(
    transports: &Transports,
    link: &Link,
    timeout: Duration,
    is_stopped: impl Fn() -> bool,
) -> Result<Option<SeenTopic>, FindError> {
    let (mut clock, mut warned) = (None, false);
    loop {
        let mut topics = transports.topics(link.transport)?;
        // The first list opens the transport, which takes a while.
        let clock = clock.get_or_insert_with(Clock::start);
        if let Some(topic) = topics.iter().position(|topic| topic.link == *link) {
            return Ok(Some(topics.swap_remove(topic)));
        }
        if is_stopped() {
            return Ok(None);
        }
        // Before the timeout, so that the warning is not left out when a list takes long.
        if !warned && clock.now() > WARNING_DELAY {
            warned = true;
            tracing::warn!(
                "{link}: not published yet, waiting up to {} s; available topics {}",
                timeout.as_secs_f64(),
                available(transports, link.transport, &topics)
            );
        }
        if clock.now() > timeout {
            let available = available(transports, link.transport, &topics);
            return Err(FindError::Timeout { link: link.clone(), timeout, available });
        }
        thread::sleep(SEARCH_INTERVAL);
    }
}

/// The topics on the transport `first`, and on the others that have some, in a line: the one that is looked for may be on
/// another transport. Those of a process are on one only.
fn available(transports: &Transports, first: TransportKind, topics: &[SeenTopic]) -> String {
    let mut line = format!("on {first}: {}", names(topics));
    if first == TransportKind::Memory {
        return line;
    }
    for other in [TransportKind::Zenoh, TransportKind::Shm, TransportKind::Dds] {
        // One that does not work has no topics to offer.
        let topics =
            if other == first { Vec::new() } else { transports.topics(other).unwrap_or_default() };
        if !topics.is_empty() {
            line.push_str(&format!("; on {other}: {}", names(&topics)));
        }
    }
    line
}

/// The names of topics in a line.
fn names(topics: &[SeenTopic]) -> String {
    let names: Vec<_> = topics.iter().map(|topic| topic.link.topic.as_str()).collect();
    if names.is_empty() { "none".to_owned() } else { names.join(", ") }
}

#[cfg(test)]
mod tests {
    use super::*;
    use eddy_transport::TransportOptions;

    fn find(is_stopped: bool) -> Result<Option<SeenTopic>, FindError> {
        let transports = Transports::new(TransportOptions::new("find"));
        find_topic(&transports, &Link::memory("/a"), Duration::ZERO, || is_stopped)
    }

    #[test]
    fn a_topic_without_publishers_is_an_error_that_lists_the_others() {
        let message = find(false).unwrap_err().to_string();
        let expected =
            "memory:/a: no publisher appeared within 0 s; available topics on memory: none";
        assert_eq!(message, expected);
    }

    #[test]
    fn a_stopped_search_finds_nothing() {
        assert!(find(true).unwrap().is_none());
    }
}
