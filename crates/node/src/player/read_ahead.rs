//! The messages of a bag, read by a thread of its own before they are due: decompressing a chunk would delay them.

use std::{io, sync::Arc, thread, time::Duration};

use crate::cache::{Cache, Pop};
use eddy_bag::{BagError, BagMessage, Messages};

/// How far to read ahead (bytes of messages).
const CAPACITY: usize = 32 << 20;
/// Duration of one wait for a message, after which the next begins.
const WAIT: Duration = Duration::from_secs(1);

pub(super) struct ReadAhead {
    cache: Arc<Cache<Result<BagMessage, BagError>>>,
}

impl ReadAhead {
    /// Starts the thread.
    pub(super) fn start(messages: Messages) -> io::Result<Self> {
        let cache = Cache::new(CAPACITY);
        let producer = cache.producer();
        thread::Builder::new().name("bag reader".to_owned()).spawn(move || {
            for message in messages {
                let size = message.as_ref().map_or(0, |message| message.data.len());
                producer.push(message, size, Duration::MAX);
                if producer.is_closed() {
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
            match self.cache.pop(WAIT) {
                Pop::Item(message) => return Some(message),
                Pop::Timeout => {}
                Pop::Ended => return None,
            }
        }
    }
}

impl Drop for ReadAhead {
    fn drop(&mut self) {
        self.cache.close();
    }
}
