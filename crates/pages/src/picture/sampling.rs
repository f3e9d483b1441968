//! Which frames of a stream a strip or an animation shows.

/// Maximum frame rate of an animation (Hz).
const MAX_RATE: f64 = 25.0;
/// Minimum delay between pictures (1/100 s): GIF viewers slow down shorter ones.
const MIN_DELAY: f64 = 2.0;

/// `count` of the indices below `frames`, evenly spaced from the first to the last; all if there are fewer.
pub fn evenly_spaced(frames: usize, count: usize) -> Vec<usize> {
    let count = count.min(frames);
    (0..count).map(|i| i * (frames - 1) / (count - 1).max(1)).collect()
}

/// Number of pictures of an animation of `seconds` made from `frames` frames, and the delay after each (1/100 s).
pub fn animation_timing(seconds: f64, frames: usize) -> (usize, u16) {
    let last = (seconds * MAX_RATE).ceil().clamp(0.0, frames.saturating_sub(1) as f64);
    let pictures = last as usize + 1;
    let delay = 100.0 * seconds / pictures.saturating_sub(1).max(1) as f64;
    (pictures, delay.round().max(MIN_DELAY) as u16)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_evenly_spaced_from_the_first_to_the_last() {
        assert_eq!(evenly_spaced(101, 5), [0, 25, 50, 75, 100]);
        assert_eq!(evenly_spaced(3, 8), [0, 1, 2]);
        assert_eq!(evenly_spaced(7, 1), [0]);
        assert_eq!(evenly_spaced(7, 0), [0; 0]);
        assert_eq!(evenly_spaced(0, 4), [0; 0]);
    }

    #[test]
    fn animations_have_at_most_25_pictures_a_second_and_keep_their_duration() {
        assert_eq!(animation_timing(4.0, 251), (101, 4));
        // Fewer frames than pictures: each is shown longer.
        assert_eq!(animation_timing(4.0, 11), (11, 40));
        assert_eq!(animation_timing(0.0, 1), (1, 2));
    }
}
