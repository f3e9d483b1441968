//! Failures of outputs, which the node survives.

use std::{collections::BTreeMap, time::Duration};

use eddy_transport::TransportError;

/// Minimum interval between warnings about an output.
const FAILURE_INTERVAL: Duration = Duration::from_secs(10);

/// Failures of outputs; the same failure is logged once in [`FAILURE_INTERVAL`].
#[derive(Default)]
pub(super) struct Failures(BTreeMap<String, Duration>);

impl Failures {
    pub(super) fn log(&mut self, now: Duration, outcome: Result<(), TransportError>) {
        let Err(error) = outcome else { return };
        let message = error.to_string();
        if self.0.get(&message).is_none_or(|logged| now - *logged > FAILURE_INTERVAL) {
            tracing::warn!("{message}");
            // Messages hardly differ; if they do, their number stays bounded.
            self.0.retain(|_, logged| now - *logged <= FAILURE_INTERVAL);
            self.0.insert(message, now);
        }
    }
}
