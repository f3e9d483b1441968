//! From which frames of a stream rollouts start.

use super::Settings;

/// Rollouts start in the first so much of a stream: later, little moves.
const STARTS_WITHIN: f64 = 0.8;

/// The last observed frame of each rollout: `settings.starts` of them, evenly over the first 80 % of
/// `frames`, each with `warm_up` frames up to it and `settings.horizon` frames after it.
pub fn starts(frames: usize, warm_up: usize, settings: Settings) -> Vec<usize> {
    let earliest = warm_up.max(1) - 1;
    let Some(latest) = frames.checked_sub(settings.horizon + 1).filter(|&l| l >= earliest) else {
        return Vec::new();
    };
    let last = ((STARTS_WITHIN * frames as f64) as usize).clamp(earliest, latest);
    let intervals = settings.starts.saturating_sub(1).max(1);
    let mut starts: Vec<_> =
        (0..settings.starts).map(|k| earliest + (last - earliest) * k / intervals).collect();
    starts.dedup();
    starts
}

#[cfg(test)]
mod tests {
    use super::*;

    const SETTINGS: Settings = Settings { horizon: 20, starts: 7 };

    #[test]
    fn seven_starts_are_spread_over_the_first_four_fifths() {
        assert_eq!(starts(625, 5, SETTINGS), [4, 86, 169, 252, 334, 417, 500]);
    }

    #[test]
    fn every_window_fits_its_stream() {
        for frames in 0..80 {
            for start in starts(frames, 5, SETTINGS) {
                assert!(start + 1 >= 5 && start + 20 < frames, "{start} of {frames}");
            }
        }
    }

    #[test]
    fn a_stream_that_is_too_short_has_none() {
        assert!(starts(24, 5, SETTINGS).is_empty());
        assert_eq!(starts(25, 5, SETTINGS), [4]);
    }
}
