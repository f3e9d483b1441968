//! The last poses of one source, by stamp.

use std::collections::VecDeque;

use eddy_frames::Stamp;

use super::rigid::{Moving, Rigid};

/// How long poses are kept after a newer one (ns), as in tf2: frames may be that much older than the newest pose. A pose that is further in the past
/// starts a new history, as when a bag is replayed.
pub(super) const HISTORY: i64 = 10_000_000_000;
/// Maximum number of poses that are kept.
const MAX_POSES: usize = 2048;

/// The last poses of one source.
#[derive(Clone, Debug, Default)]
pub(super) struct Track {
    /// In the order of their stamps.
    poses: VecDeque<(Stamp, Rigid)>,
    /// It does not move: its pose counts at all times.
    is_static: bool,
}

/// What a track knows of a time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Sample {
    /// Where it is.
    Known(Moving),
    /// Where it was last, and since when; its next pose is yet to come.
    NotYet(Rigid, Stamp),
    /// Its first pose is later than the time.
    TooEarly(Stamp),
    /// Nothing.
    Nothing,
}

/// A pose that is not later than the one before, whose stamp this is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct NotLater(pub(super) Stamp);

impl Track {
    /// Of something that does not move.
    pub(super) fn fixed(at: Rigid) -> Self {
        Self { poses: VecDeque::from([(Stamp(0), at)]), is_static: true }
    }

    /// Adds a pose. One with the stamp of the last is its repetition.
    ///
    /// # Errors
    /// [`NotLater`]; the pose is not added.
    pub(super) fn push(&mut self, stamp: Stamp, at: Rigid) -> Result<(), NotLater> {
        if let Some(&(last, _)) = self.poses.back() {
            if last.0.saturating_sub(stamp.0) > HISTORY || self.is_static {
                *self = Self::default();
            } else if stamp == last {
                return Ok(());
            } else if stamp < last {
                return Err(NotLater(last));
            }
        }
        self.poses.push_back((stamp, at));
        let is_old = |&(old, _): &(Stamp, Rigid)| stamp.0.saturating_sub(old.0) > HISTORY;
        while self.poses.len() > MAX_POSES || self.poses.get(1).is_some_and(is_old) {
            self.poses.pop_front();
        }
        Ok(())
    }

    /// Where it is at a time: between the poses before and after it.
    pub(super) fn at(&self, stamp: Stamp) -> Sample {
        let Some(&(last, newest)) = self.poses.back() else { return Sample::Nothing };
        if self.is_static {
            return Sample::Known(newest.at_rest());
        }
        if last < stamp {
            return Sample::NotYet(newest, last);
        }
        let after = self.poses.partition_point(|(at, _)| *at < stamp);
        let (end, to) = self.poses[after];
        match after.checked_sub(1).map(|before| self.poses[before]) {
            Some((start, from)) => {
                let since = |time: Stamp| (i128::from(time.0) - i128::from(start.0)) as f64;
                let [passed, whole] = [stamp, end].map(since);
                Sample::Known(from.towards(to, passed / whole, 1e-9 * whole))
            }
            None if end == stamp => Sample::Known(to.at_rest()),
            None => Sample::TooEarly(end),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(x: f64) -> Rigid {
        Rigid { position: [x, 0.0, 0.0], rotation: [0.0, 0.0, 0.0, 1.0] }
    }

    fn track(poses: &[(i64, f64)]) -> Track {
        let mut track = Track::default();
        for &(stamp, x) in poses {
            track.push(Stamp(stamp), at(x)).unwrap();
        }
        track
    }

    #[test]
    fn a_time_is_between_poses_or_at_one_or_outside() {
        let second = 1_000_000_000;
        let track = track(&[(second, 1.0), (3 * second, 2.0), (4 * second, 5.0)]);
        let moving =
            |x, u| Sample::Known(Moving { at: at(x), velocity: [u, 0.0, 0.0], spin: [0.0; 3] });
        for (stamp, expected) in [
            (second - 1, Sample::TooEarly(Stamp(second))),
            (second, moving(1.0, 0.0)),
            (2 * second, moving(1.5, 0.5)),
            (3 * second, moving(2.0, 0.5)),
            (4 * second, moving(5.0, 3.0)),
            (4 * second + 1, Sample::NotYet(at(5.0), Stamp(4 * second))),
        ] {
            assert_eq!(track.at(Stamp(stamp)), expected, "{stamp}");
        }
        assert_eq!(Track::default().at(Stamp(0)), Sample::Nothing);
        assert_eq!(Track::fixed(at(2.0)).at(Stamp(-7)), Sample::Known(at(2.0).at_rest()));
    }

    #[test]
    fn poses_that_are_not_later_are_refused_unless_they_begin_anew() {
        let mut track = track(&[(0, 1.0), (HISTORY, 2.0)]);
        assert_eq!(track.push(Stamp(HISTORY), at(9.0)), Ok(()), "a repetition");
        assert_eq!(
            track.at(Stamp(HISTORY)),
            self::track(&[(0, 1.0), (HISTORY, 2.0)]).at(Stamp(HISTORY))
        );
        assert_eq!(track.push(Stamp(5), at(9.0)), Err(NotLater(Stamp(HISTORY))));
        assert_eq!(track.push(Stamp(-1), at(3.0)), Ok(()));
        assert_eq!(track.at(Stamp(0)), Sample::NotYet(at(3.0), Stamp(-1)));
    }

    #[test]
    fn memory_is_bounded_in_time_and_number() {
        let mut track = Track::default();
        for stamp in 0..3 * MAX_POSES as i64 {
            track.push(Stamp(stamp), at(0.0)).unwrap();
        }
        assert_eq!(track.poses.len(), MAX_POSES);
        track.push(Stamp(10 * HISTORY), at(1.0)).unwrap();
        assert_eq!(track.poses.len(), 2, "the last before a pause stays");
        // Extreme stamps are no panic.
        track.push(Stamp(i64::MAX), at(1.0)).unwrap();
        track.push(Stamp(i64::MIN), at(1.0)).unwrap();
        assert_eq!(track.at(Stamp(i64::MIN)), Sample::Known(at(1.0).at_rest()));
    }
}
