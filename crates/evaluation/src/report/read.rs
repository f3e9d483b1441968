//! Reading of reports.

use std::{fs, io, path::Path, path::PathBuf};

use serde::Deserialize;

use super::{Report, files::JSON};

/// Version of `report.json`.
pub(super) const FORMAT: u32 = 2;

/// Why reports cannot be read or compared.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "each variant's message shows its fields")]
pub enum ReportError {
    /// The file cannot be read.
    #[error("{}: {reason}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        reason: io::Error,
    },
    /// The file is not a report.
    #[error("{}: {reason}, expected the report.json of `eddy eval`", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        reason: serde_json::Error,
    },
    /// The file has another format version.
    #[error("{}: format: found {found}, expected {FORMAT}; evaluate again with this version", path.display())]
    Format {
        /// The file.
        path: PathBuf,
        /// Its version; version 1 had no number.
        found: u32,
    },
    /// The reports are of different data.
    #[error(
        "{field}: found {} in {second_name} and {} in {first_name}, expected the same: reports of different data cannot be compared",
        short(second),
        short(first)
    )]
    Different {
        /// The field that differs.
        field: &'static str,
        /// Value in the first report.
        first: String,
        /// Name of the first report.
        first_name: String,
        /// Value in the other report.
        second: String,
        /// Name of the other report.
        second_name: String,
    },
    /// Fewer than two reports.
    #[error("reports: found {found}, expected two or more")]
    Few {
        /// Number of reports.
        found: usize,
    },
}

/// A value in an error message; of a digest the beginning.
fn short(value: &str) -> &str {
    value.get(..12).unwrap_or(value)
}

/// The part that all versions share.
#[derive(Deserialize)]
struct Header {
    #[serde(default = "first_format")]
    format: u32,
}

/// Version 1 had no number.
fn first_format() -> u32 {
    1
}

impl Report {
    /// Reads a report from `report.json` or its folder, without snapshots.
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
