//! The frames of a stream from which rollouts start.

use super::Settings;

/// Share of a stream within which rollouts start: later, little moves.
const STARTS_WITHIN: f64 = 0.8;

/// The last observed frame of each rollout: `settings.starts` frames spread evenly over the first 80 % of `frames`,
/// each preceded by its warm-up. The first start has `settings.horizon` frames after it, and a stream too short for that
/// has no rollouts; the truth of the last rollouts may end before the horizon.
pub fn starts(frames: usize, warm_up: usize, settings: Settings) -> Vec<usize> {
    let earliest = warm_up.max(1) - 1;
    if frames < settings.horizon.saturating_add(earliest + 1) {
        return Vec::new();
    }
    let latest = frames.saturating_sub(2).max(earliest);
    let last = ((STARTS_WITHIN * frames as f64) as usize).clamp(earliest, latest);
    // With more starts than frames, each frame is one.
    let number = settings.starts.min(last - earliest + 1);
    let intervals = number.saturating_sub(1).max(1);
    let mut starts: Vec<_> =
        (0..number).map(|k| earliest + (last - earliest) * k / intervals).collect();
    starts.dedup();
    starts
}

#[cfg(test)]
mod tests {
    use super::*;

    const SETTINGS: Settings = Settings::errors_only(20, 7);

    #[test]
    fn seven_starts_are_spread_over_the_first_four_fifths() {
        assert_eq!(starts(625, 5, SETTINGS), [4, 86, 169, 252, 334, 417, 500]);
        assert_eq!(starts(300, 2, Settings::errors_only(100, 7)), [1, 40, 80, 120, 160, 200, 240]);
    }

    #[test]
    fn the_first_window_of_a_stream_reaches_the_horizon_and_every_window_has_truth() {
        for frames in 0..80 {
            let starts = starts(frames, 5, SETTINGS);
            assert!(starts.first().is_none_or(|first| first + 20 < frames), "{frames}");
            assert!(starts.iter().all(|start| start + 1 >= 5 && start + 1 < frames), "{frames}");
        }
    }

    #[test]
    fn more_starts_than_frames_are_all_frames() {
        let all: Vec<usize> = (4..=40).collect();
        for number in [37, 38, 100, usize::MAX] {
            assert_eq!(starts(50, 5, Settings::errors_only(3, number)), all, "{number}");
        }
        assert!(starts(50, 5, Settings::errors_only(usize::MAX, 1)).is_empty());
    }

    #[test]
    fn a_stream_that_is_too_short_has_none() {
        assert!(starts(24, 5, SETTINGS).is_empty());
        assert_eq!(starts(25, 5, SETTINGS)[0], 4);
    }
}
