//! Work that is launched again and again, recorded.

use std::{cell::RefCell, collections::HashMap, hash::Hash};

use crate::{
    device::{Device, Recording},
    error::Result,
};

/// Recorded work by what its launches depend on.
pub(crate) struct Graphs<K> {
    /// None before the second time.
    recorded: RefCell<HashMap<K, Option<Box<dyn Recording + Send>>>>,
    /// Kept at most.
    most: usize,
}

impl<K: Eq + Hash> Graphs<K> {
    /// None yet; at most `most` are kept.
    pub(crate) fn new(most: usize) -> Self {
        Self { recorded: RefCell::default(), most }
    }

    /// Puts the work of a key, which `launch` puts there, into the queues: the first time launch by launch, since kernels are
    /// loaded and products choose their algorithms when they first run, which cannot be recorded.
    pub(crate) fn run(
        &self,
        device: &dyn Device,
        key: K,
        launch: impl Fn() -> Result<()>,
    ) -> Result<()> {
        let mut recorded = self.recorded.borrow_mut();
        match recorded.get(&key) {
            None => {
                launch()?;
                if recorded.len() >= self.most {
                    recorded.clear();
                }
                recorded.insert(key, None);
            }
            Some(Some(recording)) => recording.repeat()?,
            Some(None) => {
                let recording = device.record(&mut || launch())?;
                match &recording {
                    Some(recording) => recording.repeat()?,
                    None => launch()?,
                }
                recorded.insert(key, recording);
            }
        }
        Ok(())
    }

    /// Forgets all.
    pub(crate) fn clear(&self) {
        self.recorded.borrow_mut().clear();
    }
}
