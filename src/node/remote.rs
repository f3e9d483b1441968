//! What is asked of a player by others than its terminal: wishes that wait for what becomes of them.

use std::{
    sync::mpsc::{SyncSender, sync_channel},
    time::Duration,
};

use super::wish::{Outcome, Wish};
use crate::transport::Queue;

/// Wishes that may wait.
const DEPTH: usize = 16;

/// A wish, and who waits to hear what became of it.
#[derive(Debug)]
pub struct Asked {
    /// What is wanted.
    pub wish: Wish,
    asker: Option<SyncSender<Outcome>>,
}

impl Asked {
    /// Tells who asked.
    pub(super) fn answer(self, outcome: Outcome) {
        // Nobody may be there to tell it to: the asker's patience has ended.
        let _ = self.asker.map(|asker| asker.send(outcome));
    }
}

impl From<Wish> for Asked {
    /// A wish of somebody who sees what becomes of it.
    fn from(wish: Wish) -> Self {
        Self { wish, asker: None }
    }
}

/// The way to a player that plays on another thread.
#[derive(Debug)]
pub struct Remote {
    asked: Queue<Asked>,
}

impl Default for Remote {
    fn default() -> Self {
        Self { asked: Queue::new(DEPTH) }
    }
}

impl Remote {
    /// Asks the player, and waits `patience` at most; `None` when it is busy or has ended.
    pub fn ask(&self, wish: Wish, patience: Duration) -> Option<Outcome> {
        let (sender, receiver) = sync_channel(1);
        let asked = Asked { wish, asker: Some(sender) };
        self.asked.push_or_wait(asked, Duration::ZERO).ok()?;
        receiver.recv_timeout(patience).ok()
    }

    /// What was asked since the last look.
    pub fn take(&self) -> Vec<Asked> {
        std::iter::from_fn(|| self.asked.pop(Duration::ZERO)).collect()
    }

    /// No more wishes: who waits for an answer is told that there will be none.
    pub fn close(&self) {
        self.asked.close();
    }
}

#[cfg(test)]
mod tests {
    use std::thread;

    use super::*;

    const LONG: Duration = Duration::from_secs(60);

    #[test]
    fn who_asks_hears_what_became_of_the_wish() {
        let remote = Remote::default();
        let outcome = Outcome { done: true, rate: 2.0, paused: false };
        thread::scope(|scope| {
            let asker = scope.spawn(|| remote.ask(Wish::Rate(2.0), LONG));
            let asked = loop {
                if let Some(asked) = remote.take().pop() {
                    break asked;
                }
                thread::yield_now();
            };
            assert_eq!(asked.wish, Wish::Rate(2.0));
            asked.answer(outcome);
            assert_eq!(asker.join().unwrap(), Some(outcome));
        });
    }

    #[test]
    fn a_player_that_has_ended_lets_nobody_wait() {
        let remote = Remote::default();
        thread::scope(|scope| {
            let asker = scope.spawn(|| remote.ask(Wish::Look, LONG));
            remote.close();
            assert_eq!(asker.join().unwrap(), None);
        });
        assert_eq!(remote.ask(Wish::Look, LONG), None);
    }
}
