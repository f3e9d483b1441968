//! Searches several transports: one that fails does not keep the others from being searched.

use std::{
    collections::{BTreeMap, BTreeSet},
    thread,
    time::Duration,
};

use anyhow::bail;

use eddy_cli::Interrupt;
use eddy_frames::clock::Clock;
use eddy_transport::{TransportError, TransportKind};

/// Interval between searches.
const INTERVAL: Duration = Duration::from_millis(50);

/// What a search has found.
pub(crate) struct Found<T> {
    /// On all transports that work.
    pub(crate) all: BTreeSet<T>,
    failed: BTreeMap<TransportKind, TransportError>,
}

impl<T> Found<T> {
    /// Whether no transport failed.
    pub(crate) fn is_complete(&self) -> bool {
        self.failed.is_empty()
    }

    /// Names the transports that failed; to be called after the others were shown.
    ///
    /// # Errors
    /// The reasons.
    pub(crate) fn check(&self) -> anyhow::Result<()> {
        let reasons = self.failed.iter().map(|(transport, error)| format!("{transport}: {error}"));
        match reasons.collect::<Vec<_>>().join("; ") {
            reasons if reasons.is_empty() => Ok(()),
            reasons => bail!("cannot search {reasons}"),
        }
    }
}

/// Asks the transports `from` again and again for `wait` seconds, beginning when they are open.
pub(crate) fn search<T: Ord>(
    from: &[TransportKind],
    wait: f64,
    interrupt: &Interrupt,
    on: impl Fn(TransportKind) -> Result<Vec<T>, TransportError>,
) -> Found<T> {
    let mut found = Found { all: BTreeSet::new(), failed: BTreeMap::new() };
    let look = |found: &mut Found<T>| {
        for &transport in from {
            if found.failed.contains_key(&transport) {
                continue;
            }
            match on(transport) {
                Ok(here) => found.all.extend(here),
                Err(error) => drop(found.failed.insert(transport, error)),
            }
        }
    };
    // Before the clock starts: opening a transport takes time.
    look(&mut found);
    let clock = Clock::start();
    while clock.now() < Duration::from_secs_f64(wait)
        && !interrupt.requested()
        && !from.iter().all(|transport| found.failed.contains_key(transport))
    {
        thread::sleep(INTERVAL);
        look(&mut found);
    }
    found
}
