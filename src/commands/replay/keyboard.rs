//! What the user wants, where standard input is a terminal.
#![expect(unsafe_code, reason = "a signal handler")]

use std::{
    io::{self, IsTerminal as _, stdin},
    os::fd::{AsFd as _, OwnedFd},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
};

use rustix::{
    process::getpgrp,
    termios::{
        LocalModes, OptionalActions, SpecialCodeIndex, Termios, tcgetattr, tcgetpgrp, tcsetattr,
    },
};
use signal_hook::{
    SigId,
    consts::{SIGINT, SIGTERM, SIGTSTP},
    low_level::{emulate_default_handler, register, unregister},
};

use eddy_node::Wish;

/// A terminal that hands over each key at once and shows none; as before when dropped, when a signal
/// asks for the end, and while the process is stopped (Ctrl-Z). Ctrl-C stays what it is.
pub(super) struct Keyboard {
    terminal: OwnedFd,
    before: Termios,
    direct: Termios,
    /// Whether a signal has asked for the end: it may come before this is dropped.
    given_back: Arc<AtomicBool>,
    handlers: Vec<SigId>,
}

impl Keyboard {
    /// Takes the terminal over, if there is one and this process is in its foreground.
    pub(super) fn open() -> Option<Self> {
        let terminal = stdin().as_fd().try_clone_to_owned().ok()?;
        if !terminal.is_terminal() || !in_foreground(&terminal) {
            return None;
        }
        let before = tcgetattr(&terminal).ok()?;
        let mut direct = before.clone();
        direct.local_modes.remove(LocalModes::ICANON | LocalModes::ECHO);
        // A read gives what there is, at once.
        direct.special_codes[SpecialCodeIndex::VMIN] = 0;
        direct.special_codes[SpecialCodeIndex::VTIME] = 0;
        let given_back = Arc::default();
        let mut keyboard = Self { terminal, before, direct, given_back, handlers: Vec::new() };
        keyboard.listen().ok()?;
        tcsetattr(&keyboard.terminal, OptionalActions::Now, &keyboard.direct).ok()?;
        Some(keyboard)
    }

    /// Gives the terminal back at signals that end this process or stop it.
    fn listen(&mut self) -> io::Result<()> {
        for signal in [SIGINT, SIGTERM, SIGTSTP] {
            let (terminal, before) = (self.terminal.try_clone()?, self.before.clone());
            let given_back = Arc::clone(&self.given_back);
            let give_back = move || {
                if signal != SIGTSTP {
                    given_back.store(true, Ordering::Relaxed);
                }
                if in_foreground(&terminal) {
                    // The terminal may be gone.
                    let _ = tcsetattr(&terminal, OptionalActions::Now, &before);
                }
                if signal == SIGTSTP {
                    // Back when it is continued. [`Keyboard::wishes`] takes the terminal again.
                    let _ = emulate_default_handler(signal);
                }
            };
            // SAFETY: the handler stores to an atomic and makes system calls that POSIX lists as safe in
            // signal handlers (tcgetpgrp, getpgrp, tcsetattr, raise); it neither allocates nor locks.
            self.handlers.push(unsafe { register(signal, give_back) }?);
        }
        Ok(())
    }

    /// What was asked for since the last look.
    pub(super) fn wishes(&mut self) -> Vec<Wish> {
        // A process in the background that reads is stopped.
        if self.given_back.load(Ordering::Relaxed) || !in_foreground(&self.terminal) {
            return Vec::new();
        }
        // Whoever had the terminal meanwhile has left it as it likes it.
        if tcgetattr(&self.terminal).is_ok_and(|now| now.local_modes != self.direct.local_modes) {
            let _ = tcsetattr(&self.terminal, OptionalActions::Now, &self.direct);
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
        for handler in self.handlers.drain(..) {
            unregister(handler);
        }
    }
}

fn in_foreground(terminal: &OwnedFd) -> bool {
    tcgetpgrp(terminal).is_ok_and(|group| group == getpgrp())
}
