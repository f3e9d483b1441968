//! Keys of a terminal as commands.

use super::{PlayerCommand, SKIP};

/// The commands in the input of a terminal. Space, right arrow or `n`, up and down are the keys of rosbag2's player; left
/// arrow or `b` skips back, `f` skips forward. Other keys are ignored.
pub fn parse_keys(input: &[u8]) -> Vec<PlayerCommand> {
    let mut commands = Vec::new();
    let mut rest = input;
    while let [key, after @ ..] = rest {
        // An arrow is ESC [ A to D, or ESC O A to D in application mode.
        let (command, after) = match (key, rest) {
            (_, [0x1b, b'[' | b'O', arrow, after @ ..]) => (arrow_command(*arrow), after),
            (b' ', _) => (Some(PlayerCommand::TogglePause), after),
            (b'n', _) => (Some(PlayerCommand::Next), after),
            (b'b', _) => (Some(PlayerCommand::Skip(-SKIP)), after),
            (b'f', _) => (Some(PlayerCommand::Skip(SKIP)), after),
            _ => (None, after),
        };
        commands.extend(command);
        rest = after;
    }
    commands
}

fn arrow_command(arrow: u8) -> Option<PlayerCommand> {
    match arrow {
        b'A' => Some(PlayerCommand::Faster),
        b'B' => Some(PlayerCommand::Slower),
        b'C' => Some(PlayerCommand::Next),
        b'D' => Some(PlayerCommand::Skip(-SKIP)),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_are_those_of_rosbag2_and_others_are_ignored() {
        use PlayerCommand::{Faster, Next, Skip, Slower, TogglePause};
        assert_eq!(
            parse_keys(b" n\x1b[Cq\x1b[A\x1bOB\x1b[Hfb\x1b[D"),
            [TogglePause, Next, Next, Faster, Slower, Skip(SKIP), Skip(-SKIP), Skip(-SKIP)]
        );
        assert_eq!(parse_keys(b"\x1b["), []);
    }
}
