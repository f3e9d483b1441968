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
        "{link}: no publisher appeared within {} s; available topics on {transport}: {available}",
        timeout.as_secs_f64()
    )]
    Timeout { link: Link, timeout: Duration, transport: TransportKind, available: String },
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
                "{link}: not published yet, waiting up to {} s; available topics on {}: {}",
                timeout.as_secs_f64(),
                link.transport,
                names(&topics)
            );
        }
        if clock.now() > timeout {
            let available = names(&topics);
            let (link, transport) = (link.clone(), link.transport);
            return Err(FindError::Timeout { link, timeout, transport, available });
        }
        thread::sleep(SEARCH_INTERVAL);
    }
}

/// Looks up to `timeout` for publishers of all `links`, from the first list of topics on; `None` for those without. Topics in shared memory are listed at
/// once.
///
/// # Errors
/// [`TransportError`] when a transport cannot list its topics.
pub fn find_topics(
    transports: &Transports,
    links: &[Link],
    timeout: Duration,
    is_stopped: impl Fn() -> bool,
) -> Result<Vec<Option<SeenTopic>>, TransportError> {
    let (mut clock, mut found) = (None, vec![None; links.len()]);
    loop {
        let mut missing = false;
        for (link, found) in links.iter().zip(&mut found).filter(|(_, found)| found.is_none()) {
            let topics = transports.topics(link.transport)?;
            *found = topics.into_iter().find(|topic| topic.link == *link);
            missing |= found.is_none() && link.transport != TransportKind::Shm;
        }
        // The first lists open the transports, which takes a while.
        let clock = clock.get_or_insert_with(Clock::start);
        if !missing || is_stopped() || clock.now() > timeout {
            return Ok(found);
        }
        thread::sleep(SEARCH_INTERVAL);
    }
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
        // Memory links are not listed, so that no topic is ever found on them.
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
    fn several_topics_are_looked_for_at_once() {
        let transports = Transports::new(TransportOptions::new("find"));
        let links = [Link::memory("/a"), Link::memory("/b")];
        let found = find_topics(&transports, &links, Duration::ZERO, || false).unwrap();
        assert_eq!(found, [None, None]);
    }

    #[test]
    fn a_stopped_search_finds_nothing() {
        assert!(find(true).unwrap().is_none());
    }
}
