//! The messages of a bag, read by a thread of their own before they are wanted.

use std::{io, sync::Arc, thread, time::Duration};

use super::{Taken, cache::Cache};
use eddy_bag::{BagError, BagMessage, Messages};

/// How far it reads ahead (bytes of messages).
const AHEAD: usize = 32 << 20;
/// How long one wait for a message lasts; then the next one begins.
const WAIT: Duration = Duration::from_secs(1);

/// What a player takes its messages from: decompressing a chunk would make a message late.
pub(super) struct ReadAhead {
    cache: Arc<Cache<Result<BagMessage, BagError>>>,
}

impl ReadAhead {
    /// Starts to read.
    pub(super) fn start(messages: Messages) -> io::Result<Self> {
        let cache = Cache::new(AHEAD);
        let producer = cache.producer();
        thread::Builder::new().name("bag reader".to_owned()).spawn(move || {
            for message in messages {
                let size = message.as_ref().map_or(0, |message| message.data.len());
                producer.bring(message, size, Duration::MAX);
                if producer.is_unwanted() {
                    break;
                }
            }
        })?;
        Ok(Self { cache })
    }
}

impl Iterator for ReadAhead {
    type Item = Result<BagMessage, BagError>;

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            match self.cache.take(WAIT) {
                Taken::Item(message) => return Some(message),
                Taken::Nothing => {}
                Taken::Ended => return None,
            }
        }
    }
}

impl Drop for ReadAhead {
    fn drop(&mut self) {
        self.cache.close();
    }
}
