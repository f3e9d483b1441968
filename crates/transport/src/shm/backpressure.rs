//! Which subscribers a blocking publisher waits for.

use std::{
    collections::BTreeSet,
    sync::{Arc, Mutex},
};

use iceoryx2::port::{BackpressureAction, BackpressureInfo};

use crate::{lock, patience::Patience};

/// The subscribers that are not waited for, by the number of their port. Shared with iceoryx2's handler of full buffers.
#[derive(Clone, Debug, Default)]
pub(super) struct GivenUp(Arc<Mutex<State>>);

#[derive(Debug, Default)]
struct State {
    /// They missed the last message.
    before: BTreeSet<u128>,
    /// They miss the current message.
    now: BTreeSet<u128>,
    /// Its buffer was full last.
    waited_for: Option<u128>,
}

impl GivenUp {
    /// What happens to a message for the subscriber with the full buffer. The others get the message in any case.
    pub(super) fn on_full(
        &self,
        full: &BackpressureInfo,
        patience: &Patience,
    ) -> BackpressureAction {
        let mut state = lock(&self.0);
        let port = full.receiver_port_id;
        if !state.before.contains(&port) && !patience.left(full.elapsed_time).is_zero() {
            state.waited_for = Some(port);
            return BackpressureAction::Retry;
        }
        state.now.insert(port);
        BackpressureAction::DiscardData
    }

    /// A signal has interrupted the wait: the subscriber misses the current message.
    pub(super) fn interrupt(&self) {
        let mut state = lock(&self.0);
        let waited_for = state.waited_for;
        state.now.extend(waited_for);
    }

    /// Ends a message. Returns the subscribers that missed it; those that got it are waited for again.
    pub(super) fn end(&self) -> BTreeSet<u128> {
        let mut state = lock(&self.0);
        state.waited_for = None;
        state.before = std::mem::take(&mut state.now);
        state.before.clone()
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    fn full(port: u128, milliseconds: u64) -> BackpressureInfo {
        BackpressureInfo {
            service_id: 0,
            sender_port_id: 0,
            receiver_port_id: port,
            retries: 0,
            elapsed_time: Duration::from_millis(milliseconds),
        }
    }

    #[test]
    fn a_subscriber_is_given_up_until_it_gets_a_message() {
        let patience = Patience::new(Duration::from_millis(10), Arc::default());
        let given_up = GivenUp::default();
        let on_full = |port, waited| given_up.on_full(&full(port, waited), &patience);
        assert_eq!(on_full(1, 9), BackpressureAction::Retry);
        assert_eq!(on_full(1, 10), BackpressureAction::DiscardData);
        assert_eq!(given_up.end(), [1].into());
        assert_eq!(on_full(1, 0), BackpressureAction::DiscardData, "not waited for again");
        assert_eq!(on_full(2, 0), BackpressureAction::Retry, "others are");
        assert_eq!(given_up.end(), [1].into());
        assert_eq!(given_up.end(), [].into(), "it got a message");
        assert_eq!(on_full(1, 0), BackpressureAction::Retry);
        given_up.interrupt();
        assert_eq!(given_up.end(), [1].into(), "a signal ended the wait for it");
    }
}
