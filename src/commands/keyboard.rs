//! Keys, if standard input is a terminal.
//!
//! Only echo and line buffering are turned off: in crossterm's raw mode Ctrl-C and Ctrl-Z would not raise signals, and
//! logs would need carriage returns.

use std::{
    io::{self, IsTerminal as _, stdin},
    os::fd::{AsFd as _, OwnedFd},
    sync::{Arc, Mutex},
    thread::{self, JoinHandle},
};

use rustix::{
    process::getpgrp,
    termios::{
        LocalModes, OptionalActions, SpecialCodeIndex, Termios, tcgetattr, tcgetpgrp, tcsetattr,
    },
};
use signal_hook::{
    consts::{SIGINT, SIGTERM, SIGTSTP},
    iterator::{Handle, Signals},
    low_level::emulate_default_handler,
};

/// A terminal without echo and line buffering. Its modes are restored on drop, on SIGINT and SIGTERM, and while the
/// process is stopped (Ctrl-Z).
pub(crate) struct Keyboard {
    terminal: OwnedFd,
    original: Termios,
    unbuffered: Termios,
    /// Whether SIGINT or SIGTERM has arrived, which may be long before the drop. Locked while the modes are changed, and while the process
    /// is stopped.
    is_released: Arc<Mutex<bool>>,
    signals: Handle,
    thread: Option<JoinHandle<()>>,
}

impl Keyboard {
    /// Opens standard input if it is a terminal with this process in its foreground.
    pub(crate) fn open() -> Option<Self> {
        let terminal = stdin().as_fd().try_clone_to_owned().ok()?;
        if !terminal.is_terminal() || !in_foreground(&terminal) {
            return None;
        }
        let original = tcgetattr(&terminal).ok()?;
        let mut unbuffered = original.clone();
        unbuffered.local_modes.remove(LocalModes::ICANON | LocalModes::ECHO);
        // A read returns the waiting bytes at once.
        unbuffered.special_codes[SpecialCodeIndex::VMIN] = 0;
        unbuffered.special_codes[SpecialCodeIndex::VTIME] = 0;
        let is_released = Arc::<Mutex<bool>>::default();
        let changing = is_released.lock().ok()?;
        let (signals, thread) = watch_signals(&terminal, &original, &is_released).ok()?;
        tcsetattr(&terminal, OptionalActions::Now, &unbuffered).ok()?;
        drop(changing);
        Some(Self { terminal, original, unbuffered, is_released, signals, thread: Some(thread) })
    }

    /// The bytes of the keys that were pressed since the last call; at most 64.
    pub(crate) fn keys(&mut self) -> Vec<u8> {
        // Without waiting for a signal that ends or stops this process.
        let Ok(is_released) = self.is_released.try_lock() else { return Vec::new() };
        // A background process that reads from the terminal is stopped by the system.
        if *is_released || !in_foreground(&self.terminal) {
            return Vec::new();
        }
        // The shell restores its own modes while the process is stopped.
        if tcgetattr(&self.terminal).is_ok_and(|now| now.local_modes != self.unbuffered.local_modes)
        {
            let _ = tcsetattr(&self.terminal, OptionalActions::Now, &self.unbuffered);
        }
        let mut input = [0; 64];
        // Not through `Stdin`, which takes an empty read for the end of the input.
        let read = rustix::io::read(&self.terminal, &mut input).unwrap_or_default();
        input[..read].to_vec()
    }
}

/// Restores the terminal on signals that end or stop this process.
fn watch_signals(
    terminal: &OwnedFd,
    original: &Termios,
    is_released: &Arc<Mutex<bool>>,
) -> io::Result<(Handle, JoinHandle<()>)> {
    let mut signals = Signals::new([SIGINT, SIGTERM, SIGTSTP])?;
    let (terminal, original) = (terminal.try_clone()?, original.clone());
    let (handle, is_released) = (signals.handle(), Arc::clone(is_released));
    let thread = thread::Builder::new().name("terminal".to_owned()).spawn(move || {
        for signal in signals.forever() {
            let Ok(mut is_released) = is_released.lock() else { return };
            *is_released |= signal != SIGTSTP;
            if in_foreground(&terminal) {
                // Fails if the terminal is gone.
                let _ = tcsetattr(&terminal, OptionalActions::Now, &original);
            }
            if signal == SIGTSTP {
                // Returns when the process is continued; `Keyboard::keys` sets the modes again.
                let _ = emulate_default_handler(signal);
            }
        }
    })?;
    Ok((handle, thread))
}

impl Drop for Keyboard {
    fn drop(&mut self) {
        // Fails if the terminal is gone.
        let _ = tcsetattr(&self.terminal, OptionalActions::Now, &self.original);
        self.signals.close();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join(); // a panic has been reported
        }
    }
}

fn in_foreground(terminal: &OwnedFd) -> bool {
    tcgetpgrp(terminal).is_ok_and(|group| group == getpgrp())
}
