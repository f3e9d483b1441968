//! The folder of unfinished bags, locked by the process that writes them.

use std::{
    fs::{self, File},
    path::{Path, PathBuf},
};

use super::SimulateError;
use eddy_settings::atomic;

/// Folder of unfinished scenes.
const INCOMPLETE: &str = ".incomplete";

/// The folder of unfinished bags, used by one process at a time.
#[derive(Debug)]
pub(super) struct Staging {
    output: PathBuf,
    /// Holds the lock while open.
    _lock: File,
}

impl Staging {
    /// Opens the folder in an output directory, creating both if needed.
    pub(super) fn open(output: &Path) -> Result<Self, SimulateError> {
        let directory = output.join(INCOMPLETE);
        fs::create_dir_all(&directory).map_err(SimulateError::io("create", &directory))?;
        let path = directory.join("lock");
        let lock = File::create(&path).map_err(SimulateError::io("create", &path))?;
        lock.try_lock().map_err(|reason| SimulateError::Locked { lock: path, reason })?;
        Ok(Self { output: output.into(), _lock: lock })
    }

    /// The output directory.
    pub(super) fn output(&self) -> &Path {
        &self.output
    }

    /// A path for a new bag. Removes what a killed process left there.
    pub(super) fn place(&self, name: &str) -> Result<PathBuf, SimulateError> {
        let place = self.output.join(INCOMPLETE).join(name);
        self.discard(name)?;
        Ok(place)
    }

    /// Removes an unfinished bag, if it exists.
    pub(super) fn discard(&self, name: &str) -> Result<(), SimulateError> {
        let place = self.output.join(INCOMPLETE).join(name);
        if place.exists() {
            fs::remove_dir_all(&place).map_err(SimulateError::io("remove", &place))?;
        }
        Ok(())
    }

    /// Moves a finished bag to its final path.
    pub(super) fn deliver(&self, name: &str) -> Result<(), SimulateError> {
        let directory = self.output.join(name);
        atomic::rename(&self.output.join(INCOMPLETE).join(name), &directory)
            .map_err(SimulateError::io("move", &directory))
    }

    /// Removes the folder with all unfinished bags.
    pub(super) fn close(&self) {
        if let Err(error) = fs::remove_dir_all(self.output.join(INCOMPLETE)) {
            tracing::warn!("cannot remove {INCOMPLETE} in {}: {error}", self.output.display());
        }
    }
}
