//! The folder for what is not finished, locked by the process that works in it.

use std::{
    fs::{self, File},
    path::{Path, PathBuf},
};

use super::SimulateError;
use eddy_settings::atomic;

/// Where scenes are written until they are finished.
const INCOMPLETE: &str = ".incomplete";

/// The folder for what is not finished, held by one process at a time.
#[derive(Debug)]
pub(super) struct Staging {
    output: PathBuf,
    /// Locked as long as it is open.
    _lock: File,
}

impl Staging {
    /// Opens the folder in an output directory, which is made if need be.
    pub(super) fn open(output: &Path) -> Result<Self, SimulateError> {
        let directory = output.join(INCOMPLETE);
        fs::create_dir_all(&directory).map_err(SimulateError::io("make", &directory))?;
        let path = directory.join("lock");
        let lock = File::create(&path).map_err(SimulateError::io("make", &path))?;
        lock.try_lock().map_err(|reason| SimulateError::Locked { lock: path, reason })?;
        Ok(Self { output: output.into(), _lock: lock })
    }

    /// The output directory.
    pub(super) fn output(&self) -> &Path {
        &self.output
    }

    /// An unused path for a bag. What an ended process left there is removed.
    pub(super) fn place(&self, name: &str) -> Result<PathBuf, SimulateError> {
        let place = self.output.join(INCOMPLETE).join(name);
        self.discard(name)?;
        Ok(place)
    }

    /// Removes an unfinished bag, if there is one.
    pub(super) fn discard(&self, name: &str) -> Result<(), SimulateError> {
        let place = self.output.join(INCOMPLETE).join(name);
        if place.exists() {
            fs::remove_dir_all(&place).map_err(SimulateError::io("remove", &place))?;
        }
        Ok(())
    }

    /// Moves a finished bag to where it belongs.
    pub(super) fn deliver(&self, name: &str) -> Result<(), SimulateError> {
        let directory = self.output.join(name);
        atomic::rename(&self.output.join(INCOMPLETE).join(name), &directory)
            .map_err(SimulateError::io("move", &directory))
    }

    /// Removes the folder with whatever is unfinished in it.
    pub(super) fn close(&self) {
        if let Err(error) = fs::remove_dir_all(self.output.join(INCOMPLETE)) {
            tracing::warn!("cannot remove {INCOMPLETE} in {}: {error}", self.output.display());
        }
    }
}
