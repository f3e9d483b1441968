//! What long-running library functions report, and how they are asked to stop.

/// Shows the progress of a task and says whether to cancel it. A terminal draws a bar; tests and programs
/// that show nothing use [`Silent`]. Tasks follow one another, they are not nested.
pub trait Progress: Sync {
    /// A task of `total` steps begins; `unit` is the plural of a step, such as "frames".
    fn begin(&self, total: u64, unit: &str) {
        let _ = (total, unit);
    }

    /// So many steps of the task are done. Called from several threads.
    fn advance(&self, steps: u64) {
        let _ = steps;
    }

    /// The state of the running task, in a few words that a terminal shows beside the bar.
    fn status(&self, text: &str) {
        let _ = text;
    }

    /// The task has ended, whole or not.
    fn finish(&self) {}

    /// A line about what was done.
    fn message(&self, line: &str) {
        let _ = line;
    }

    /// Whether to stop at the next occasion.
    fn cancelled(&self) -> bool {
        false
    }
}

/// Shows nothing and never cancels.
#[derive(Clone, Copy, Debug, Default)]
pub struct Silent;

impl Progress for Silent {}
