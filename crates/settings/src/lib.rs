//! Typed settings from TOML files. A file holds only what differs from the defaults; unknown keys are rejected. Also
//! here, for all crates: [`atomic`] writes, suggestions for misspelt names ([`near`]), values of the wrong type ([`types`]), and wrong [`usage`].

use std::{
    fs, io,
    path::{Path, PathBuf},
};

pub mod atomic;
pub mod near;
pub mod types;
pub mod usage;

use serde::{Serialize, de::DeserializeOwned};
use toml::{Table, Value};

/// Why a settings file cannot be used.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the message says what the fields are")]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("{}: {reason}", file.display())]
    Read { file: PathBuf, reason: io::Error },
    /// The file is not valid TOML.
    #[error("{}: {reason}", file.display())]
    Syntax { file: PathBuf, reason: String },
    /// A key is unknown, or its value has the wrong type.
    #[error("{}: {reason}", file.display())]
    Key { file: PathBuf, reason: String },
}

/// The settings in a file; missing keys have their defaults.
///
/// # Errors
/// [`ConfigError`] when the file cannot be read, is not TOML, or has a key that is unknown or of the wrong type.
pub fn load<T: DeserializeOwned>(file: &Path) -> Result<T, ConfigError> {
    parse(file, &read(file)?)
}

/// As [`load`]; for an unknown key that a table of `defaults` has, the error suggests the key in that table.
///
/// # Errors
/// As [`load`].
pub fn load_like<T: Serialize + DeserializeOwned>(
    file: &Path,
    defaults: &T,
) -> Result<T, ConfigError> {
    load(file).map_err(|error| match error {
        ConfigError::Key { file, reason } => {
            let tables = Table::try_from(defaults).unwrap_or_default();
            ConfigError::Key { file, reason: near::in_tables(reason, &tables) }
        }
        other => other,
    })
}

/// The settings in the text of a file.
///
/// # Errors
/// As [`load`].
pub fn parse<T: DeserializeOwned>(file: &Path, text: &str) -> Result<T, ConfigError> {
    // Parsed twice to distinguish syntax errors from wrong keys.
    table(file, text)?;
    toml::from_str(text).map_err(|error| ConfigError::Key {
        file: file.to_owned(),
        reason: near::in_toml(&types::in_words(error.to_string().trim_end())),
    })
}

fn read(file: &Path) -> Result<String, ConfigError> {
    fs::read_to_string(file).map_err(|reason| ConfigError::Read {
        file: file.to_owned(),
        reason: near::in_folder(file, reason),
    })
}

fn table(file: &Path, text: &str) -> Result<Table, ConfigError> {
    text.parse().map_err(|error: toml::de::Error| ConfigError::Syntax {
        file: file.to_owned(),
        reason: error.to_string().trim_end().to_owned(),
    })
}

/// The values of a settings file, not yet typed.
#[derive(Clone, Debug, Default)]
pub struct Overrides {
    file: PathBuf,
    table: Table,
}

impl Overrides {
    /// Reads a settings file.
    ///
    /// # Errors
    /// [`ConfigError::Read`], [`ConfigError::Syntax`].
    pub fn read(file: &Path) -> Result<Self, ConfigError> {
        Self::parse(file, &read(file)?)
    }

    /// The settings in the text of a file.
    ///
    /// # Errors
    /// [`ConfigError::Syntax`].
    pub fn parse(file: &Path, text: &str) -> Result<Self, ConfigError> {
        Ok(Self { file: file.to_owned(), table: table(file, text)? })
    }

    /// Calls the top-level key `old` by its present name, unless the file has that too.
    #[must_use]
    pub fn renamed(mut self, old: &str, present: &str) -> Self {
        if !self.table.contains_key(present)
            && let Some(value) = self.table.remove(old)
        {
            self.table.insert(present.to_owned(), value);
        }
        self
    }

    /// The value of a top-level key, for keys that decide on the defaults.
    ///
    /// # Errors
    /// [`ConfigError::Key`] when its value is of the wrong type.
    pub fn get<T: DeserializeOwned>(&self, key: &str) -> Result<Option<T>, ConfigError> {
        let typed = |value: &Value| {
            value.clone().try_into().map_err(|error: toml::de::Error| self.key_error(&error, key))
        };
        self.table.get(key).map(typed).transpose()
    }

    /// `defaults`, overridden by the values of the file.
    ///
    /// # Errors
    /// [`ConfigError::Key`] when a key is unknown or its value of the wrong type.
    pub fn over<T: Serialize + DeserializeOwned>(&self, defaults: &T) -> Result<T, ConfigError> {
        let mut merged = Table::try_from(defaults).expect("settings are tables of TOML types");
        merge(&mut merged, &self.table);
        T::deserialize(Value::Table(merged)).map_err(|error| self.key_error(&error, ""))
    }

    fn key_error(&self, error: &toml::de::Error, key: &str) -> ConfigError {
        let separator = if key.is_empty() { "" } else { ": " };
        let reason = format!("{key}{separator}{}", error.to_string().trim_end().replace('\n', " "));
        let reason = near::in_toml(&types::in_words(&reason));
        ConfigError::Key { file: self.file.clone(), reason }
    }
}

/// Overrides the values of `base` by those of `over`, table by table; arrays are replaced as a whole.
fn merge(base: &mut Table, over: &Table) {
    for (key, value) in over {
        match (base.get_mut(key), value) {
            (Some(Value::Table(base)), Value::Table(over)) => merge(base, over),
            _ => {
                base.insert(key.clone(), value.clone());
            }
        }
    }
}

/// The example of the README, which a test runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

#[cfg(test)]
mod tests {
    use serde::Deserialize;

    use super::*;

    #[derive(Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Settings {
        epochs: u32,
        loss: Loss,
    }

    #[derive(Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Loss {
        velocity: f32,
        density: f32,
    }

    const DEFAULTS: Settings = Settings { epochs: 10, loss: Loss { velocity: 0.5, density: 0.25 } };

    fn over(text: &str) -> Result<Settings, String> {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("settings.toml");
        fs::write(&file, text).unwrap();
        let named = folder.path().display().to_string();
        Overrides::read(&file)
            .and_then(|overrides| overrides.over(&DEFAULTS))
            .map_err(|error| error.to_string().replace(&named, "."))
    }

    #[test]
    fn a_file_holds_only_what_differs_from_the_defaults() {
        let expected = Settings { epochs: 10, loss: Loss { velocity: 0.5, density: 1.0 } };
        assert_eq!(over("[loss]\ndensity = 1.0"), Ok(expected));
    }

    #[test]
    fn an_old_key_is_read_by_its_present_name() {
        let read = |text: &str| {
            let overrides = Overrides::parse("settings.toml".as_ref(), text).unwrap();
            overrides.renamed("cost", "loss").over(&DEFAULTS)
        };
        let expected = Settings { epochs: 10, loss: Loss { velocity: 0.5, density: 1.0 } };
        assert_eq!(read("[cost]\ndensity = 1.0").unwrap(), expected);
        assert!(read("[cost]\ndensity = 1.0\n[loss]\nvelocity = 1.0").is_err(), "both");
    }

    #[test]
    fn an_unknown_key_is_rejected_by_name() {
        let message = over("[loss]\nvelocty = 1.0").unwrap_err();
        assert!(message.starts_with("./settings.toml: unknown field `velocty`"), "{message}");
        assert!(message.contains("expected `velocity` or `density`"), "{message}");
        assert!(message.ends_with("did you mean velocity?"), "{message}");
    }

    #[test]
    fn a_value_of_the_wrong_type_is_rejected() {
        let message = over("epochs = \"many\"").unwrap_err();
        assert!(message.contains("found \"many\", expected a whole number from 0"), "{message}");
    }
}
