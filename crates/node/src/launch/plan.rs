//! The launch file: what runs, and what happens when a process ends.

use std::{collections::BTreeMap, time::Duration};

use serde::Deserialize;

/// A launch file.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Plan {
    /// The processes; all start at once.
    pub process: Vec<ProcessPlan>,
    /// How failed processes are restarted.
    #[serde(default)]
    pub restart: RestartPlan,
    /// Time for a process to shut down after SIGINT before it is killed (s), 0 to 3,600 [default: 10].
    #[serde(default = "ten")]
    pub grace: f64,
    /// Environment variables of all processes.
    #[serde(default)]
    pub environment: BTreeMap<String, String>,
}

/// A process of a launch file.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ProcessPlan {
    /// Unique name, the prefix of its output lines.
    pub name: String,
    /// An eddy command and its arguments.
    pub run: Vec<String>,
    /// Whether to restart it when it fails [default: true]; otherwise its failure shuts down all others. A process that
    /// exits successfully is not restarted.
    #[serde(default = "yes")]
    pub restart: bool,
    /// What to do when it exits successfully [default: nothing].
    #[serde(default)]
    pub on_exit: OnExit,
    /// Additional environment variables of this process.
    #[serde(default)]
    pub environment: BTreeMap<String, String>,
}

/// What to do with the other processes when one exits successfully.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum OnExit {
    /// Keep them running.
    #[default]
    Nothing,
    /// Shut them down.
    Shutdown,
}

/// How failed processes are restarted.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RestartPlan {
    /// Delay before the first restart (s); each consecutive restart waits twice as long. 0 to 3,600 [default: 0.5].
    pub delay: f64,
    /// Longest delay before a restart (s), 0 to 3,600 [default: 8].
    pub longest: f64,
    /// Maximum number of consecutive restarts, up to 1,000 [default: 5].
    pub limit: u32,
    /// Time after which a running process counts as recovered (s), 0 to 86,400 [default: 30].
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

/// A launch file that cannot be carried out.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{field}: found {found}, expected {expected}")]
pub struct InvalidPlan {
    /// The key.
    pub field: String,
    /// Its value.
    pub found: String,
    /// The values allowed.
    pub expected: &'static str,
}

impl Plan {
    /// Checks what the types leave open.
    ///
    /// # Errors
    /// [`InvalidPlan`] with the first invalid key.
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
                return wrong("process.name", format!("`{name}` twice"), "unique names");
            }
            if process.run.is_empty() {
                return wrong(&format!("{name}.run"), "[]".to_owned(), "an eddy command");
            }
            // It would start itself recursively.
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
            // Also rejects NaN.
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
    fn invalid_keys_are_named() {
        let one = "[[process]]\nname = 'node'\nrun = ['node']\n";
        for (text, expected) in [
            ("process = []".to_owned(), "process: found none"),
            (one.repeat(2), "process.name: found `node` twice, expected unique names"),
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
