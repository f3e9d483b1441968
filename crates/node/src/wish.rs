//! What a user may ask of a player, by the keys of rosbag2's player or from elsewhere.

use super::requests::{Pending, Requests};
use eddy_frames::Stamp;

/// What one key goes back or on by (recorded s).
const SKIP: f64 = 5.0;

/// A wish.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Wish {
    /// Nothing but to know how it plays.
    Look,
    /// Pause, or go on.
    TogglePause,
    /// Pause.
    Pause,
    /// Go on.
    Resume,
    /// The next message now, whether paused or not.
    Next,
    /// A tenth faster.
    Faster,
    /// A tenth slower.
    Slower,
    /// So much faster than recorded.
    Rate(f64),
    /// Go on at this recorded time.
    Seek(Stamp),
    /// Go on so many recorded seconds later, or earlier if negative.
    Skip(f64),
}

/// What became of a wish, and how the player plays now.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Outcome {
    /// Whether it was fulfilled.
    pub done: bool,
    /// How much faster than recorded.
    pub rate: f64,
    /// Whether it pauses.
    pub paused: bool,
}

/// The way to a player that plays on another thread.
pub type Remote = Requests<Wish, Outcome>;

/// A wish that waits for what becomes of it.
pub type Asked = Pending<Wish, Outcome>;

impl Wish {
    /// The wishes in what a terminal sent: space, right arrow or `n`, up, down, as rosbag2 has them;
    /// left arrow or `b` goes back, `f` goes on. Other keys mean nothing.
    pub fn parse(keys: &[u8]) -> Vec<Self> {
        let mut wishes = Vec::new();
        let mut rest = keys;
        while let [key, after @ ..] = rest {
            let (wish, after) = match rest {
                // An arrow is ESC [ A to D, or ESC O A to D from a terminal in application mode.
                [0x1b, b'[' | b'O', arrow, after @ ..] => {
                    let wish = match arrow {
                        b'A' => Some(Self::Faster),
                        b'B' => Some(Self::Slower),
                        b'C' => Some(Self::Next),
                        b'D' => Some(Self::Skip(-SKIP)),
                        _ => None,
                    };
                    (wish, after)
                }
                _ => match key {
                    b' ' => (Some(Self::TogglePause), after),
                    b'n' => (Some(Self::Next), after),
                    b'b' => (Some(Self::Skip(-SKIP)), after),
                    b'f' => (Some(Self::Skip(SKIP)), after),
                    _ => (None, after),
                },
            };
            wishes.extend(wish);
            rest = after;
        }
        wishes
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_are_read_as_rosbag2_reads_them_and_others_are_passed_over() {
        use Wish::{Faster, Next, Skip, Slower, TogglePause};
        assert_eq!(
            Wish::parse(b" n\x1b[Cq\x1b[A\x1bOB\x1b[Hfb\x1b[D"),
            [TogglePause, Next, Next, Faster, Slower, Skip(SKIP), Skip(-SKIP), Skip(-SKIP)]
        );
        assert_eq!(Wish::parse(b"\x1b["), []);
    }
}
