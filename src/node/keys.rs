//! What a user may ask of a player, by the keys of rosbag2's player.

/// A wish.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wish {
    /// Pause, or go on.
    Pause,
    /// The next message now, whether paused or not.
    Next,
    /// A tenth faster.
    Faster,
    /// A tenth slower.
    Slower,
}

impl Wish {
    /// The wishes in what a terminal sent: space, right arrow or `n`, up, down. Other keys mean nothing.
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
                        _ => None,
                    };
                    (wish, after)
                }
                _ => match key {
                    b' ' => (Some(Self::Pause), after),
                    b'n' => (Some(Self::Next), after),
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
        use Wish::{Faster, Next, Pause, Slower};
        assert_eq!(
            Wish::parse(b" n\x1b[Cq\x1b[A\x1bOB\x1b[D"),
            [Pause, Next, Next, Faster, Slower]
        );
        assert_eq!(Wish::parse(b"\x1b["), []);
    }
}
