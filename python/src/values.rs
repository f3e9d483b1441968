//! Python values as settings of the library, and results of the library as Python values: through JSON.

use std::{ffi::CString, path::PathBuf};

use eddy_dataset::DatasetError;
use eddy_messages::UnusableFrame;
use eddy_settings::types;
use pyo3::{
    exceptions::{PyUserWarning, PyValueError},
    prelude::*,
};
use serde::{Serialize, de::DeserializeOwned};
use toml::Value;

/// A settings value, from dictionaries, lists, strings and numbers.
///
/// # Errors
/// `TypeError` for what is none of these, `ValueError` with the key that is unknown or of the wrong type.
pub(crate) fn parse<T: DeserializeOwned>(name: &str, value: &Bound<'_, PyAny>) -> PyResult<T> {
    let text: String = value.py().import("json")?.call_method1("dumps", (value,))?.extract()?;
    serde_json::from_str(&text).map_err(|error| {
        PyValueError::new_err(format!("{name}: {}", types::in_words(&error.to_string())))
    })
}

/// One of the words of a setting, such as a preset.
///
/// # Errors
/// `ValueError` with the words that are known.
pub(crate) fn word<T: DeserializeOwned>(name: &str, word: &str) -> PyResult<T> {
    Value::String(word.to_owned()).try_into().map_err(|error: toml::de::Error| {
        PyValueError::new_err(format!("{name}: {}", error.to_string().trim_end()))
    })
}

/// Why streams cannot be used, and how to leave them out.
pub(crate) fn refused(error: &DatasetError, skip_streams: bool) -> String {
    match error {
        DatasetError::Unusable(_) if !skip_streams => {
            format!("{error}; skip_streams=True leaves out such streams")
        }
        _ => error.to_string(),
    }
}

/// Warns of each stream that was skipped.
pub(crate) fn warn_of_skipped(py: Python<'_>, skipped: &[UnusableFrame]) -> PyResult<()> {
    skipped.iter().try_for_each(|first| {
        let text = CString::new(format!("skipped: {first}"))?;
        PyErr::warn(py, &py.get_type::<PyUserWarning>(), &text, 1)
    })
}

/// Dictionaries, lists, strings and numbers.
pub(crate) fn render<'py>(py: Python<'py>, value: &impl Serialize) -> PyResult<Bound<'py, PyAny>> {
    let text =
        serde_json::to_string(value).map_err(|error| PyValueError::new_err(error.to_string()))?;
    py.import("json")?.call_method1("loads", (text,))
}

/// One path, or a sequence of paths.
#[derive(FromPyObject)]
pub(crate) enum Paths {
    One(PathBuf),
    Several(Vec<PathBuf>),
}

impl From<Paths> for Vec<PathBuf> {
    fn from(paths: Paths) -> Self {
        match paths {
            Paths::One(path) => vec![path],
            Paths::Several(paths) => paths,
        }
    }
}
