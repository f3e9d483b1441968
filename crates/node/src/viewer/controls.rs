//! Commands of a page. The program decides which are available; the page shows no others.

use std::sync::{Mutex, PoisonError};

use serde::{Deserialize, Serialize};

/// A command of a page.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(tag = "do", rename_all = "snake_case", deny_unknown_fields)]
#[expect(missing_docs, reason = "the variants explain their fields")]
pub enum PageCommand {
    /// Pause the source.
    Pause,
    /// Resume the source.
    Resume,
    /// Publish one frame of a paused source.
    Step,
    /// Set the rate (playing time per real time).
    Rate { rate: f64 },
    /// Skip forward, or back if negative (recorded s).
    Skip { seconds: f64 },
    /// Reset every stream: predictions warm up again.
    Reset,
    /// Set the horizon (frames).
    Horizon { frames: u32 },
    /// Publish all frames up to the horizon, or only the last.
    PublishAll { on: bool },
    /// Start a free run, or observe again after a warm-up.
    FreeRun { on: bool },
    /// Move the tool there (x and y, domain lengths), as fast as it can.
    Tool { position: [f32; 2] },
}

impl PageCommand {
    /// Its name in JSON.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Pause => "pause",
            Self::Resume => "resume",
            Self::Step => "step",
            Self::Rate { .. } => "rate",
            Self::Skip { .. } => "skip",
            Self::Reset => "reset",
            Self::Horizon { .. } => "horizon",
            Self::PublishAll { .. } => "publish_all",
            Self::FreeRun { .. } => "free_run",
            Self::Tool { .. } => "tool",
        }
    }
}

/// Where a page wants the tool of a simulation to be.
#[derive(Debug, Default)]
pub struct ToolTarget(Mutex<Option<[f32; 2]>>);

impl ToolTarget {
    /// The place (domain lengths), once a page has named one.
    pub fn position(&self) -> Option<[f32; 2]> {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Names a place.
    pub fn set(&self, position: [f32; 2]) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = Some(position);
    }
}

/// The state of the controls; `None` where there is no such control, or its program did not answer.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct ControlState {
    /// Whether the source is paused.
    pub paused: Option<bool>,
    /// Playing time per real time.
    pub rate: Option<f64>,
    /// Horizon (frames).
    pub horizon: Option<u32>,
    /// Whether all frames up to the horizon are published.
    pub publish_all: Option<bool>,
    /// Whether streams are in a free run.
    pub free_run: Option<bool>,
}

impl ControlState {
    /// This state, completed by what was known `before`.
    pub(super) fn or(self, before: Self) -> Self {
        Self {
            paused: self.paused.or(before.paused),
            rate: self.rate.or(before.rate),
            horizon: self.horizon.or(before.horizon),
            publish_all: self.publish_all.or(before.publish_all),
            free_run: self.free_run.or(before.free_run),
        }
    }
}

/// For a page without controls.
#[derive(Clone, Copy, Debug)]
pub struct NoControls;

impl Controls for NoControls {
    fn available(&self) -> &'static [&'static str] {
        &[]
    }

    fn execute(&self, _: PageCommand) -> Result<String, String> {
        Err("this page has no controls".to_owned())
    }

    fn state(&self) -> ControlState {
        ControlState::default()
    }
}

/// Executes the commands of a page. Calls may block; each comes on a thread of its own.
pub trait Controls: Send + Sync {
    /// The [names](PageCommand::name) of the available commands.
    fn available(&self) -> &'static [&'static str];

    /// Executes a command. Returns a message for the user, or nothing.
    ///
    /// # Errors
    /// A message for the user.
    fn execute(&self, command: PageCommand) -> Result<String, String>;

    /// The current state.
    fn state(&self) -> ControlState;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_missing_answer_leaves_the_state_as_before() {
        let before =
            ControlState { paused: Some(true), horizon: Some(5), ..ControlState::default() };
        let now =
            ControlState { paused: Some(false), free_run: Some(true), ..ControlState::default() };
        let known = ControlState { horizon: Some(5), ..now };
        assert_eq!(now.or(before), known);
        assert_eq!(ControlState::default().or(before), before);
    }
}
