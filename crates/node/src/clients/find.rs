//! Waits until a service is offered.

use std::{thread, time::Duration};

use super::ClientError;
use eddy_frames::clock::Clock;
use eddy_transport::{Link, SeenService, Transports};

/// Interval between searches.
const SEARCH_INTERVAL: Duration = Duration::from_millis(50);

/// Waits up to `timeout` for a service. `None` when `is_stopped` first.
///
/// # Errors
/// [`ClientError::NotFound`] with the available services, [`ClientError::Transport`].
pub fn find_service(
    transports: &Transports,
    link: &Link,
    timeout: Duration,
    is_stopped: impl Fn() -> bool,
) -> Result<Option<SeenService>, ClientError> {
    let clock = Clock::start();
    loop {
        let services = transports.services(link.transport)?;
        if let Some(found) = services.iter().find(|service| service.link == *link) {
            return Ok(Some(found.clone()));
        }
        if is_stopped() {
            return Ok(None);
        }
        if clock.now() > timeout {
            let names: Vec<_> = services.iter().map(|service| &*service.link.topic).collect();
            let available = if names.is_empty() { "none".to_owned() } else { names.join(", ") };
            return Err(ClientError::NotFound { link: link.clone(), timeout, available });
        }
        thread::sleep(SEARCH_INTERVAL);
    }
}
