//! SIGINT and SIGTERM as a flag.

use std::{
    io,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
};

use signal_hook::consts::{SIGINT, SIGTERM, SIGXFSZ};

/// Whether this process was asked to shut down.
#[derive(Clone, Debug, Default)]
pub struct Interrupt(Arc<AtomicBool>);

impl Interrupt {
    /// Handles SIGINT and SIGTERM. The second signal of one kind ends the process at once; one of each does not, as a
    /// service manager and a supervisor may send different ones.
    pub fn install() -> io::Result<Self> {
        let interrupt = Self::default();
        for signal in [SIGINT, SIGTERM] {
            // The order matters: the first signal finds its flag unset and only sets it.
            let again = Arc::new(AtomicBool::new(false));
            signal_hook::flag::register_conditional_shutdown(signal, 130, again.clone())?;
            signal_hook::flag::register(signal, again)?;
            signal_hook::flag::register(signal, interrupt.0.clone())?;
        }
        // Exceeding the file size limit makes the write fail instead of ending the process.
        signal_hook::flag::register(SIGXFSZ, Arc::default())?;
        Ok(interrupt)
    }

    /// Whether a signal has arrived.
    pub fn requested(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }

    /// The flag itself.
    pub fn flag(&self) -> &AtomicBool {
        &self.0
    }

    /// The flag, for parts that outlive the command.
    pub fn shared(&self) -> Arc<AtomicBool> {
        Arc::clone(&self.0)
    }
}
