//! Warnings about tools, limited in number.

use std::{collections::BTreeMap, time::Duration};

/// Minimum time between two warnings about the same.
const INTERVAL: Duration = Duration::from_secs(10);

/// What a warning is about. Those about a state are not repeated before it has ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum About {
    /// A message cannot be used.
    Refused,
    /// A state: there is no pose.
    Missing,
    /// A state: the last pose is held.
    Held,
    /// A state: the pose is not in the plane.
    OutOfPlane,
}

/// What was said about one tool.
#[derive(Clone, Copy, Debug)]
struct Said {
    at: Duration,
    /// The state has not ended since.
    goes_on: bool,
}

/// Warnings, limited in number.
#[derive(Debug, Default)]
pub(super) struct Warnings {
    /// By tool; `None` for messages that belong to none.
    said: BTreeMap<(Option<usize>, About), Said>,
    unread: Vec<String>,
}

impl Warnings {
    /// Says something about a tool, unless the same was said just now or goes on.
    pub(super) fn say(
        &mut self,
        tool: Option<usize>,
        about: About,
        now: Duration,
        text: impl FnOnce() -> String,
    ) {
        let is_said = |said: &Said| said.goes_on || now.saturating_sub(said.at) < INTERVAL;
        if !self.said.get(&(tool, about)).is_some_and(is_said) {
            let goes_on = about != About::Refused;
            self.said.insert((tool, about), Said { at: now, goes_on });
            self.unread.push(text());
        }
    }

    /// A state of a tool has ended, if it was in it.
    pub(super) fn ended(&mut self, tool: usize, about: About) {
        if let Some(said) = self.said.get_mut(&(Some(tool), about)) {
            said.goes_on = false;
        }
    }

    /// What was said since the last call.
    pub(super) fn take(&mut self) -> Vec<String> {
        std::mem::take(&mut self.unread)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_state_is_said_once_until_it_ends_and_the_rest_at_intervals() {
        let mut warnings = Warnings::default();
        let mut say = |about, seconds: f64, ends: bool| {
            if ends {
                warnings.ended(0, about);
            }
            let text = || "text".to_owned();
            warnings.say(Some(0), about, Duration::from_secs_f64(seconds), text);
            warnings.take().len()
        };
        for (about, seconds, ends, expected) in [
            (About::Held, 0.0, false, 1),
            (About::Held, 100.0, false, 0),
            (About::Held, 101.0, true, 1),
            (About::Held, 102.0, true, 0),
            (About::Held, 111.5, false, 1),
            (About::Refused, 0.0, false, 1),
            (About::Refused, 9.9, false, 0),
            (About::Refused, 10.0, false, 1),
        ] {
            assert_eq!(say(about, seconds, ends), expected, "{about:?} at {seconds} s");
        }
    }
}
