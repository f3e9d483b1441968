//! Warnings that no frames arrive, or that frames are dropped.

use std::{num::NonZeroUsize, thread, time::Duration};

use eddy_transport::Link;

use super::load::Load;

/// Without a frame for this long after the start, a warning is logged.
const SILENCE_TIMEOUT: Duration = Duration::from_secs(5);
/// Minimum interval between warnings about dropped frames.
const DROP_WARNING_INTERVAL: Duration = Duration::from_secs(10);

/// Warnings to the user, limited in number.
#[derive(Default)]
pub(super) struct Warnings {
    silence: bool,
    /// When the node began to wait for frames.
    pub(super) waiting_since: Duration,
    /// Time of the last warning about dropped frames, and their number then.
    dropped: Option<(Duration, u64)>,
}

impl Warnings {
    pub(super) fn check(&mut self, now: Duration, input: &Link, load: &Load) {
        let Load { received, dropped, .. } = *load;
        let waiting = now.saturating_sub(self.waiting_since);
        if received == 0 && waiting > SILENCE_TIMEOUT && !self.silence {
            self.silence = true;
            tracing::warn!(
                "no frames received for {} s on {input}; check topic and transport with `eddy topic list --from zenoh,shm,dds --wait 5`",
                SILENCE_TIMEOUT.as_secs()
            );
        }
        let (warned, before) = self.dropped.unwrap_or_default();
        let is_due = self.dropped.is_none() || now - warned > DROP_WARNING_INTERVAL;
        if dropped > before && is_due {
            let processors = thread::available_parallelism().map_or(1, NonZeroUsize::get);
            tracing::warn!("dropped {} frames: {}", dropped - before, load.advice(processors));
            self.dropped = Some((now, dropped));
        }
    }
}
