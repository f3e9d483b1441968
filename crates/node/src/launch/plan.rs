//! What runs, and what happens when it ends.

use std::{collections::BTreeMap, time::Duration};

use serde::Deserialize;

/// A launch file.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Plan {
    /// What runs; all of it starts at once.
    pub process: Vec<ProcessPlan>,
    /// How what fails is started again.
    #[serde(default)]
    pub restart: RestartPlan,
    /// Seconds that processes have to end after they were asked to (SIGINT), before they are killed; 0 to
    /// 3,600 [default: 10].
    #[serde(default = "ten")]
    pub grace: f64,
    /// Environment variables of all processes.
    #[serde(default)]
    pub environment: BTreeMap<String, String>,
}

/// A process.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ProcessPlan {
    /// What its lines begin with; no other process has it.
    pub name: String,
    /// An eddy command and its arguments.
    pub run: Vec<String>,
    /// Whether it is started again when it fails [default: true]; otherwise its failure ends all others. What
    /// ends well is never started again.
    #[serde(default = "yes")]
    pub restart: bool,
    /// What happens once it has ended well [default: nothing].
    #[serde(default)]
    pub on_exit: OnExit,
    /// Its own environment variables.
    #[serde(default)]
    pub environment: BTreeMap<String, String>,
}

/// What happens to the others when a process has ended well.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum OnExit {
    /// They go on.
    #[default]
    Nothing,
    /// They are asked to end.
    Shutdown,
}

/// How what fails is started again.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RestartPlan {
    /// Seconds before the first restart; each one in a row waits twice as long as the one before. 0 to 3,600
    /// [default: 0.5].
    pub delay: f64,
    /// Seconds that no restart waits longer than; 0 to 3,600 [default: 8].
    pub longest: f64,
    /// Restarts in a row after which a process counts as failed; up to 1,000 [default: 5].
    pub limit: u32,
    /// Seconds of running after which a process's failures are forgotten; 0 to 86,400 [default: 30].
    pub calm: f64,
}

impl Default for RestartPlan {
    fn default() -> Self {
        Self { delay: 0.5, longest: 8.0, limit: 5, calm: 30.0 }
    }
}

fn ten() -> f64 {
    10.0
}

fn yes() -> bool {
    true
}

/// A plan that cannot be carried out.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{field}: found {found}, expected {expected}")]
pub struct InvalidPlan {
    /// The field.
    pub field: String,
    /// Its value.
    pub found: String,
    /// What it should be.
    pub expected: &'static str,
}

impl Plan {
    /// Checks what the types leave open.
    ///
    /// # Errors
    /// [`InvalidPlan`] with the first field that makes no sense.
    pub fn check(&self) -> Result<(), InvalidPlan> {
        let wrong = |field: &str, found: String, expected| {
            Err(InvalidPlan { field: field.to_owned(), found, expected })
        };
        if self.process.is_empty() {
            return wrong("process", "none".to_owned(), "at least one [[process]]");
        }
        for (number, process) in self.process.iter().enumerate() {
            let name = &process.name;
            if name.trim().is_empty() || name.contains(char::is_control) {
                return wrong("process.name", format!("{name:?}"), "a word");
            }
            if self.process[..number].iter().any(|other| other.name == *name) {
                return wrong("process.name", format!("`{name}` twice"), "names that differ");
            }
            if process.run.is_empty() {
                return wrong(&format!("{name}.run"), "[]".to_owned(), "an eddy command");
            }
            // It would start itself again and again.
            if process.run.iter().any(|argument| argument == "launch") {
                return wrong(&format!("{name}.run"), "launch".to_owned(), "another eddy command");
            }
        }
        let RestartPlan { delay, longest, limit, calm } = self.restart;
        for (field, found, most, expected) in [
            ("grace", self.grace, 3600.0, "0 to 3600 (s)"),
            ("restart.delay", delay, 3600.0, "0 to 3600 (s)"),
            ("restart.longest", longest, 3600.0, "0 to 3600 (s)"),
            ("restart.limit", f64::from(limit), 1000.0, "0 to 1000"),
            ("restart.calm", calm, 86400.0, "0 to 86400 (s)"),
        ] {
            // What is not a number is in no range.
            if !(0.0..=most).contains(&found) {
                return wrong(field, found.to_string(), expected);
            }
        }
        Ok(())
    }

    pub(super) fn grace(&self) -> Duration {
        Duration::from_secs_f64(self.grace)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn checked(text: &str) -> Result<(), String> {
        toml::from_str::<Plan>(text).unwrap().check().map_err(|error| error.to_string())
    }

    #[test]
    fn a_plan_needs_no_more_than_names_and_commands() {
        assert_eq!(checked("[[process]]\nname = 'node'\nrun = ['node']"), Ok(()));
    }

    #[test]
    fn what_makes_no_sense_is_named() {
        let one = "[[process]]\nname = 'node'\nrun = ['node']\n";
        for (text, expected) in [
            ("process = []".to_owned(), "process: found none"),
            (one.repeat(2), "process.name: found `node` twice, expected names that differ"),
            (one.replace("['node']", "[]"), "node.run: found [], expected an eddy command"),
            (one.replace("['node']", "['launch']"), "node.run: found launch"),
            (one.replace("'node'\n", "' '\n"), "process.name: found \" \", expected a word"),
            (format!("grace = nan\n{one}"), "grace: found NaN, expected 0 to 3600 (s)"),
            (format!("{one}[restart]\nlimit = 5000"), "restart.limit: found 5000"),
            (format!("{one}[restart]\ndelay = -1.0"), "restart.delay: found -1"),
        ] {
            let message = checked(&text).unwrap_err();
            assert!(message.starts_with(expected), "{text}: {message}");
        }
    }
}
