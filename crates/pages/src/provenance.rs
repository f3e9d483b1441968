//! Provenance of a result: command, program version, machine and date.

use std::env;

use serde::{Deserialize, Serialize};

use eddy_frames::{clock, date::Utc};

/// Provenance of a result.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Provenance {
    /// The command, quoted for a shell.
    pub command: String,
    /// Version of eddy.
    pub version: String,
    /// Date and time (UTC, ISO 8601).
    pub date: String,
    /// The machine.
    pub machine: Machine,
}

/// A machine.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Machine {
    /// Processor name.
    pub processor: String,
    /// Cores available to the process.
    pub cores: usize,
    /// Memory (bytes).
    pub memory: u64,
    /// Operating system.
    pub system: String,
    /// Processor architecture of the build.
    pub architecture: String,
}

impl Provenance {
    /// Provenance of results of this process.
    pub fn here() -> Self {
        let words: Vec<String> =
            env::args_os().map(|word| word.to_string_lossy().into_owned()).collect();
        Self {
            command: command_line(&words),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            date: Utc::of(clock::wall()).to_string(),
            machine: Machine::here(),
        }
    }

    /// Everything but the command, as a description list.
    pub(super) fn facts(&self) -> Vec<(String, String)> {
        let Machine { processor, cores, memory, system, architecture } = &self.machine;
        let memory = *memory as f64 / f64::from(1 << 30);
        let machine =
            format!("{processor}, {cores} cores, {memory:.1} GiB, {system}, {architecture}");
        let facts = [
            ("Version", format!("eddy {}", self.version)),
            ("Machine", machine),
            ("Date", self.date.clone()),
        ];
        facts.map(|(name, value)| (name.to_owned(), value)).into()
    }
}

impl Machine {
    /// This machine.
    pub fn here() -> Self {
        let mut system = sysinfo::System::new();
        system.refresh_memory();
        system.refresh_cpu_list(sysinfo::CpuRefreshKind::nothing());
        let processor = system.cpus().first().map_or("", |cpu| cpu.brand()).trim();
        let unknown = || "unknown".to_owned();
        Self {
            processor: if processor.is_empty() { unknown() } else { processor.to_owned() },
            cores: std::thread::available_parallelism().map_or(1, usize::from),
            memory: system.total_memory(),
            system: sysinfo::System::long_os_version().unwrap_or_else(unknown),
            architecture: env::consts::ARCH.to_owned(),
        }
    }
}

/// Arguments quoted for a POSIX shell.
pub fn command_line(words: &[String]) -> String {
    words.iter().map(|word| quoted(word)).collect::<Vec<_>>().join(" ")
}

/// An argument quoted for a POSIX shell.
fn quoted(word: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_./:=,+@%".contains(c);
    if !word.is_empty() && word.chars().all(plain) {
        return word.to_owned();
    }
    format!("'{}'", word.replace('\'', r"'\''"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arguments_are_quoted_for_a_shell() {
        for (word, expected) in [
            ("--data", "--data"),
            ("two words", "'two words'"),
            ("", "''"),
            ("it's $HOME", r"'it'\''s $HOME'"),
        ] {
            assert_eq!(quoted(word), expected);
        }
    }

    #[test]
    fn this_machine_has_cores_and_memory() {
        let Provenance { command, machine, .. } = Provenance::here();
        assert!(!command.is_empty());
        assert!(machine.cores > 0 && machine.memory > 1 << 20, "{machine:?}");
        assert!(!machine.processor.is_empty() && !machine.system.is_empty(), "{machine:?}");
    }
}
