//! Progress and cancellation of long-running functions.

/// Receives the progress of tasks and can cancel them: a progress bar on a terminal, or [`Silent`]. Tasks are not nested.
pub trait Progress: Sync {
    /// A task of `total` steps starts; `unit` is what is counted, in the plural, such as "frames".
    fn begin(&self, total: u64, unit: &str) {
        let _ = (total, unit);
    }

    /// `steps` more steps are done. Called from several threads.
    fn advance(&self, steps: u64) {
        let _ = steps;
    }

    /// The state of the running task, in a few words that a terminal shows beside the bar.
    fn status(&self, text: &str) {
        let _ = text;
    }

    /// The task has ended, complete or not.
    fn finish(&self) {}

    /// A message for the user.
    fn message(&self, line: &str) {
        let _ = line;
    }

    /// Whether to stop as soon as possible.
    fn cancelled(&self) -> bool {
        false
    }
}

/// Ignores progress and never cancels.
#[derive(Clone, Copy, Debug, Default)]
pub struct Silent;

impl Progress for Silent {}
