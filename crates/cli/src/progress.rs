//! Progress of library functions on a terminal.

use std::sync::{Mutex, MutexGuard, PoisonError};

use eddy_frames::progress::Progress;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use crate::{Interrupt, terminal};

/// Draws a bar for each task, prints lines above it, and cancels on SIGINT and SIGTERM.
pub struct TerminalProgress<'a> {
    interrupt: &'a Interrupt,
    quiet: bool,
    bar: Mutex<Option<ProgressBar>>,
}

impl<'a> TerminalProgress<'a> {
    /// No bars and no lines when `quiet`; no bars without a terminal.
    pub fn new(quiet: bool, interrupt: &'a Interrupt) -> Self {
        Self { interrupt, quiet, bar: Mutex::new(None) }
    }

    /// A panic in another thread leaves it consistent: it is only replaced as a whole.
    fn bar(&self) -> MutexGuard<'_, Option<ProgressBar>> {
        self.bar.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Progress for TerminalProgress<'_> {
    fn begin(&self, total: u64, unit: &str) {
        let bar = progress_bar(total, unit, self.quiet);
        bar.tick();
        *self.bar() = Some(bar);
    }

    fn advance(&self, steps: u64) {
        if let Some(bar) = &*self.bar() {
            bar.inc(steps);
        }
    }

    fn status(&self, text: &str) {
        if let Some(bar) = &*self.bar() {
            bar.set_message(text.to_owned());
        }
    }

    fn finish(&self) {
        if let Some(bar) = self.bar().take() {
            bar.finish_and_clear();
        }
    }

    fn message(&self, line: &str) {
        if self.quiet {
            return;
        }
        match &*self.bar() {
            Some(bar) => bar.suspend(|| println!("{line}")),
            None => println!("{line}"),
        }
    }

    fn cancelled(&self) -> bool {
        self.interrupt.requested()
    }
}

/// A progress bar with the time left; hidden without a terminal or when `quiet`.
pub fn progress_bar(length: u64, unit: &str, quiet: bool) -> ProgressBar {
    let bar = if quiet {
        ProgressBar::with_draw_target(Some(length), ProgressDrawTarget::hidden())
    } else {
        ProgressBar::new(length)
    };
    // What a narrow terminal leaves beside the numbers and a message.
    let width = terminal::columns().saturating_sub(64).clamp(10, 30);
    let template = format!("{{bar:{width}}} {{pos}}/{{len}} {unit}, {{eta}} left  {{wide_msg}}");
    bar.with_style(ProgressStyle::with_template(&template).unwrap_or(ProgressStyle::default_bar()))
}
