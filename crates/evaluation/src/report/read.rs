//! Reports that were written before.

use std::{fs, io, path::Path, path::PathBuf};

use serde::Deserialize;

use super::{Report, files::JSON};

/// The format of `report.json`: another number stands for other fields.
pub(super) const FORMAT: u32 = 2;

/// Why a report cannot be read, or reports not compared.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// The file cannot be read.
    #[error("{}: {reason}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the operating system says.
        reason: io::Error,
    },
    /// The file is no report.
    #[error("{}: {reason}, expected the report.json of `eddy eval`", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// What was found where.
        reason: serde_json::Error,
    },
    /// The file was written by another version.
    #[error("{}: format: found {found}, expected {FORMAT}; judge again with this version", path.display())]
    Format {
        /// The file.
        path: PathBuf,
        /// The number it has; 1 had no number.
        found: u32,
    },
    /// Reports judge different things.
    #[error(
        "{field}: found {second} in {second_name} and {first} in {first_name}, expected the same"
    )]
    Different {
        /// What differs.
        field: &'static str,
        /// What the first report has.
        first: String,
        /// Name of the first report.
        first_name: String,
        /// What the other one has.
        second: String,
        /// Name of the other.
        second_name: String,
    },
    /// There is nothing to compare with.
    #[error("reports: found {found}, expected two or more")]
    Few {
        /// How many there are.
        found: usize,
    },
}

/// What every format has.
#[derive(Deserialize)]
struct Header {
    #[serde(default = "first_format")]
    format: u32,
}

/// The first format did not say its number.
fn first_format() -> u32 {
    1
}

impl Report {
    /// Reads a report: its `report.json`, or the folder that has it. Snapshots are not kept there.
    ///
    /// # Errors
    /// [`ReportError::Io`], [`ReportError::Content`], [`ReportError::Format`].
    pub fn load(path: &Path) -> Result<Self, ReportError> {
        let path = if path.is_dir() { path.join(JSON) } else { path.to_owned() };
        let text = match fs::read_to_string(&path) {
            Ok(text) => text,
            Err(reason) => return Err(ReportError::Io { path, reason }),
        };
        let read = || -> Result<Result<Self, u32>, serde_json::Error> {
            let Header { format } = serde_json::from_str(&text)?;
            if format != FORMAT {
                return Ok(Err(format));
            }
            serde_json::from_str(&text).map(Ok)
        };
        match read() {
            Ok(Ok(report)) => Ok(report),
            Ok(Err(found)) => Err(ReportError::Format { path, found }),
            Err(reason) => Err(ReportError::Content { path, reason }),
        }
    }
}
