//! What the user wants, where standard input is a terminal.

use std::io::{IsTerminal as _, Stdin, stdin};

use rustix::{
    process::getpgrp,
    termios::{
        LocalModes, OptionalActions, SpecialCodeIndex, Termios, tcgetattr, tcgetpgrp, tcsetattr,
    },
};

use eddy::node::Wish;

/// A terminal that hands over each key at once and shows none; as before when dropped. Ctrl-C stays
/// what it is.
pub(super) struct Keyboard {
    terminal: Stdin,
    before: Termios,
}

impl Keyboard {
    /// Takes the terminal over, if there is one and this process is in its foreground.
    pub(super) fn open() -> Option<Self> {
        let terminal = stdin();
        if !terminal.is_terminal() || !in_foreground(&terminal) {
            return None;
        }
        let before = tcgetattr(&terminal).ok()?;
        let mut direct = before.clone();
        direct.local_modes.remove(LocalModes::ICANON | LocalModes::ECHO);
        // A read gives what there is, at once.
        direct.special_codes[SpecialCodeIndex::VMIN] = 0;
        direct.special_codes[SpecialCodeIndex::VTIME] = 0;
        tcsetattr(&terminal, OptionalActions::Now, &direct).ok()?;
        Some(Self { terminal, before })
    }

    /// What was asked for since the last look.
    pub(super) fn controls(&mut self) -> Vec<Wish> {
        // A process in the background that reads is stopped.
        if !in_foreground(&self.terminal) {
            return Vec::new();
        }
        let mut keys = [0; 64];
        // Not through the buffer of `Stdin`, which takes an empty read for the end.
        let read = rustix::io::read(&self.terminal, &mut keys).unwrap_or_default();
        Wish::parse(&keys[..read])
    }
}

impl Drop for Keyboard {
    fn drop(&mut self) {
        // The terminal may be gone.
        let _ = tcsetattr(&self.terminal, OptionalActions::Now, &self.before);
    }
}

fn in_foreground(terminal: &Stdin) -> bool {
    tcgetpgrp(terminal).is_ok_and(|group| group == getpgrp())
}
