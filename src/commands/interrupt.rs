//! SIGINT and SIGTERM as a flag that loops look at.

use std::{
    io,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
};

use signal_hook::consts::{SIGINT, SIGTERM, SIGXFSZ};

/// Whether the user, or the system, has asked this process to end.
#[derive(Clone, Debug, Default)]
pub struct Interrupt(Arc<AtomicBool>);

impl Interrupt {
    /// Takes over SIGINT and SIGTERM. The second of a kind ends the process at once; one of each does not, as
    /// a service manager sends one and who started this process the other.
    pub fn install() -> io::Result<Self> {
        let interrupt = Self::default();
        for signal in [SIGINT, SIGTERM] {
            // The order counts: the first signal finds its flag down and only raises it.
            let again = Arc::new(AtomicBool::new(false));
            signal_hook::flag::register_conditional_shutdown(signal, 130, again.clone())?;
            signal_hook::flag::register(signal, again)?;
            signal_hook::flag::register(signal, interrupt.0.clone())?;
        }
        // A file that reaches the limit on its size is an error of the write, not the end of the
        // process.
        signal_hook::flag::register(SIGXFSZ, Arc::default())?;
        Ok(interrupt)
    }

    /// Whether a signal has come.
    pub fn requested(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }

    /// The flag itself, for loops that know no signals.
    pub fn flag(&self) -> &AtomicBool {
        &self.0
    }
}
