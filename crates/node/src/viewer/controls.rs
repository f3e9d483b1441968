//! What a page may ask for. Who can do it decides what is offered; the page shows nothing else.

use serde::{Deserialize, Serialize};

/// Something that a page asks for.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(tag = "do", rename_all = "snake_case", deny_unknown_fields)]
pub enum Command {
    /// Pause the source.
    Pause,
    /// Let the source go on.
    Resume,
    /// One frame of a source that pauses.
    Step,
    /// So much faster than recorded.
    Rate {
        /// The factor.
        rate: f64,
    },
    /// Go on so much later, or earlier if negative.
    Skip {
        /// Recorded seconds.
        seconds: f64,
    },
    /// Forget every stream: predictions warm up again.
    Reset,
    /// Predict so far ahead.
    Horizon {
        /// Frames.
        frames: u32,
    },
    /// Publish every frame up to the horizon, or the last only.
    PublishAll {
        /// Whether every one.
        on: bool,
    },
    /// Simulate alone from now on; or observe again, after a warm-up.
    FreeRun {
        /// Whether alone.
        on: bool,
    },
}

impl Command {
    /// Its word, as in JSON.
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
        }
    }
}

/// How what is controlled is set now; `None` where it has no such thing, or did not say.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct State {
    /// Whether the source pauses.
    pub paused: Option<bool>,
    /// How much faster than recorded.
    pub rate: Option<f64>,
    /// Frames predicted ahead.
    pub horizon: Option<u32>,
    /// Whether every frame up to the horizon is published.
    pub publish_all: Option<bool>,
    /// Whether streams are simulated alone.
    pub free_run: Option<bool>,
}

impl State {
    /// This, and where it says nothing what was known `before`.
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

/// For what is shown and cannot be controlled.
#[derive(Clone, Copy, Debug)]
pub struct NoControls;

impl Controls for NoControls {
    fn offered(&self) -> &'static [&'static str] {
        &[]
    }

    fn act(&self, _: Command) -> Result<String, String> {
        Err("found nothing that can be controlled".to_owned())
    }

    fn state(&self) -> State {
        State::default()
    }
}

/// Who does what a page asks for. Both calls may take a while; they come on threads of their own.
pub trait Controls: Send + Sync {
    /// The [names](Command::name) of what can be asked for.
    fn offered(&self) -> &'static [&'static str];

    /// Does it, and says so if it is worth saying.
    ///
    /// # Errors
    /// Why it was not done, for the user.
    fn act(&self, command: Command) -> Result<String, String>;

    /// How it is set now.
    fn state(&self) -> State;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_does_not_answer_is_set_as_before() {
        let before = State { paused: Some(true), horizon: Some(5), ..State::default() };
        let now = State { paused: Some(false), free_run: Some(true), ..State::default() };
        let known = State { horizon: Some(5), ..now };
        assert_eq!(now.or(before), known);
        assert_eq!(State::default().or(before), before);
    }
}
