//! `error_model.toml` in a checkpoint's directory.

use std::{fs, io, path::Path};

use super::{CalibratedHorizon, ErrorModel, Linear, Regression};
use crate::checkpoint::{CheckpointError, field};
use eddy_settings::{atomic, near};

/// Name of the file within the directory.
pub const ERROR_MODEL_FILE: &str = "error_model.toml";

/// Reads the file in a checkpoint's directory; `None` if there is none.
pub(crate) fn load(directory: &Path) -> Result<Option<ErrorModel>, CheckpointError> {
    let file = directory.join(ERROR_MODEL_FILE);
    match fs::read_to_string(&file) {
        Ok(text) => parse(&file, &text).map(Some),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(reason) => Err(CheckpointError::Read { file, reason }),
    }
}

impl ErrorModel {
    /// Writes the file into a checkpoint's directory, or replaces it.
    ///
    /// # Errors
    /// [`CheckpointError::Write`], and [`CheckpointError::Field`] for numbers that could not be read again.
    pub fn save(&self, directory: &Path) -> Result<(), CheckpointError> {
        let file = directory.join(ERROR_MODEL_FILE);
        check(&file, self)?;
        atomic::replace(&file, render(self).as_bytes())
            .map_err(|reason| CheckpointError::Write { file, reason })
    }
}

/// The text of the file.
fn render(model: &ErrorModel) -> String {
    toml::to_string(model).expect("numbers, words and tables of them are all TOML")
}

/// Reads the text; errors name `file`.
pub(crate) fn parse(file: &Path, text: &str) -> Result<ErrorModel, CheckpointError> {
    let syntax = |error: toml::de::Error| CheckpointError::Description {
        file: file.to_owned(),
        reason: near::in_toml(error.to_string().trim_end()),
    };
    let table: toml::Table = text.parse().map_err(syntax)?;
    let version = table.get("format_version");
    if version.and_then(toml::Value::as_integer) != Some(1) {
        let found = version.map_or("nothing".to_owned(), ToString::to_string);
        return Err(field(file, "format_version", found, "1"));
    }
    let model: ErrorModel = toml::from_str(text).map_err(syntax)?;
    check(file, &model)?;
    Ok(model)
}

fn check(file: &Path, model: &ErrorModel) -> Result<(), CheckpointError> {
    let mut before = 0;
    for (number, at) in model.horizons.iter().enumerate() {
        let CalibratedHorizon { frames, error, worse_than_ballistic } = at;
        let name = |part: &str| format!("horizons[{number}].{part}");
        if *frames <= before {
            let expected = format!("more than {before}");
            return Err(field(file, name("frames"), frames.to_string(), expected));
        }
        before = *frames;
        let Regression { linear, residuals } = error;
        for (part, Linear { intercept, weights }) in
            [("error.linear", linear), ("worse_than_ballistic", worse_than_ballistic)]
        {
            if let Some(found) = not_finite(weights).or(not_finite(&[*intercept])) {
                return Err(field(file, name(part), found, "finite numbers"));
            }
        }
        if let Some(found) = not_finite(residuals) {
            return Err(field(file, name("error.residuals"), found, "finite numbers"));
        }
        if !residuals.is_sorted() {
            let (found, expected) = (format!("{residuals:?}"), "numbers in increasing order");
            return Err(field(file, name("error.residuals"), found, expected));
        }
    }
    Ok(())
}

fn not_finite(numbers: &[f32]) -> Option<String> {
    numbers.iter().find(|x| !x.is_finite()).map(f32::to_string)
}
