//! File descriptors of this process. The libraries abort, or fail with the name of an internal error, when none is left, so that
//! they are counted before.

use std::fs;

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

use crate::{Link, TransportError};

/// Descriptors that connections, logs and files take beside those that are counted.
const SPARE: u64 = 24;
/// The folder that lists the open descriptors of a process.
const OPEN: &str = if cfg!(target_os = "linux") { "/proc/self/fd" } else { "/dev/fd" };

/// Descriptors that a transport opens, at most.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Cost {
    /// For itself, with its first link.
    pub(crate) middleware: u64,
    pub(crate) publisher: u64,
    pub(crate) subscriber: u64,
    /// For each of both on a topic of frames, beside those.
    pub(crate) of_frames: u64,
}

/// Ensures that this process may open `needed` more descriptors; raises its limit where the system permits that.
///
/// # Errors
/// [`TransportError::Descriptors`].
pub(crate) fn ensure(link: &Link, needed: u64) -> Result<(), TransportError> {
    let Some(open) = open() else { return Ok(()) };
    let limits = getrlimit(Resource::Nofile);
    let allowed = within(limits, open + needed + SPARE);
    if allowed != limits.current {
        // What was not permitted is seen below.
        let _ = setrlimit(Resource::Nofile, Rlimit { current: allowed, ..limits });
    }
    match getrlimit(Resource::Nofile).current {
        Some(limit) if limit < open + needed + SPARE => Err(TransportError::Descriptors {
            link: link.clone(),
            needed: needed + SPARE,
            open,
            limit,
        }),
        _ => Ok(()),
    }
}

/// Number of open descriptors; `None` if the system does not say.
pub(crate) fn open() -> Option<u64> {
    // The folder is one of them.
    Some((fs::read_dir(OPEN).ok()?.count() as u64).saturating_sub(1))
}

/// The limit for this number of descriptors: the current one if it suffices, otherwise the largest that is permitted.
fn within(limits: Rlimit, descriptors: u64) -> Option<u64> {
    let suffices = limits.current.is_none_or(|limit| limit >= descriptors);
    if suffices { limits.current } else { limits.maximum.or(Some(descriptors)) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_limit_is_raised_when_it_does_not_suffice() {
        let limits = |current, maximum| Rlimit { current, maximum };
        for (limits, expected) in [
            (limits(Some(1_024), Some(4_096)), Some(1_024)),
            (limits(Some(999), Some(4_096)), Some(4_096)),
            (limits(Some(999), Some(999)), Some(999)),
            (limits(Some(999), None), Some(1_000)),
            (limits(None, None), None),
        ] {
            assert_eq!(within(limits, 1_000), expected, "{limits:?}");
        }
    }

    #[test]
    fn open_files_are_counted() {
        let before = open().unwrap();
        let files: Vec<_> = (0..50).map(|_| fs::File::open("/dev/null").unwrap()).collect();
        // Other tests of this process open and close some meanwhile.
        assert!(open().unwrap() + 40 > before + files.len() as u64);
    }

    #[test]
    fn more_than_the_system_permits_is_refused_with_both_numbers() {
        let link: Link = "memory:/many".parse().unwrap();
        if getrlimit(Resource::Nofile).maximum.is_none() {
            return;
        }
        let message = ensure(&link, u64::MAX / 2).unwrap_err().to_string();
        assert!(message.starts_with("memory:/many: needs 9223372036854775831 more open files"));
        assert!(message.contains("ulimit -n"), "{message}");
    }
}
