//! The folder of unfinished bags, locked by the process that writes them, or shared by several, each with a folder of its own.

use std::{
    fs::{self, File},
    io::ErrorKind,
    os::unix::fs::MetadataExt as _,
    path::{Path, PathBuf},
};

use tempfile::{Builder, TempDir};

use super::SimulateError;
use eddy_settings::atomic;

/// Folder of unfinished scenes.
pub(super) const INCOMPLETE: &str = ".incomplete";

/// The folder of unfinished bags.
#[derive(Debug)]
pub(super) struct Staging {
    output: PathBuf,
    /// Holds the lock while open.
    _lock: File,
    /// The folder of this process if others share the lock: two of them may simulate the same scene when the system that
    /// has started them takes one for lost.
    own: Option<TempDir>,
}

impl Staging {
    /// Opens the folder in an output directory for this process alone, creating both if needed.
    pub(super) fn open(output: &Path) -> Result<Self, SimulateError> {
        let lock = lock(output, File::try_lock)?;
        Ok(Self { output: output.into(), _lock: lock, own: None })
    }

    /// As [`Staging::open`], with others that share the folder.
    pub(super) fn share(output: &Path) -> Result<Self, SimulateError> {
        let lock = lock(output, File::try_lock_shared)?;
        let directory = output.join(INCOMPLETE);
        let own = Builder::new().prefix("task-").tempdir_in(&directory);
        let own = own.map_err(SimulateError::io("create a folder in", &directory))?;
        Ok(Self { output: output.into(), _lock: lock, own: Some(own) })
    }

    /// The output directory.
    pub(super) fn output(&self) -> &Path {
        &self.output
    }

    /// A path for a new bag. Removes what a killed process left there.
    pub(super) fn place(&self, name: &str) -> Result<PathBuf, SimulateError> {
        self.discard(name)?;
        Ok(self.unfinished(name))
    }

    /// Removes an unfinished bag, if it exists.
    pub(super) fn discard(&self, name: &str) -> Result<(), SimulateError> {
        let place = self.unfinished(name);
        if place.exists() {
            fs::remove_dir_all(&place).map_err(SimulateError::io("remove", &place))?;
        }
        Ok(())
    }

    /// Moves a finished bag to its final path.
    pub(super) fn deliver(&self, name: &str) -> Result<(), SimulateError> {
        let directory = self.output.join(name);
        match atomic::rename(&self.unfinished(name), &directory) {
            // Another process has just finished the same scene, with the same bits.
            Err(error) if self.own.is_some() && is_taken(&error) => self.discard(name),
            outcome => outcome.map_err(SimulateError::io("move", &directory)),
        }
    }

    /// Where a bag is until it is finished.
    fn unfinished(&self, name: &str) -> PathBuf {
        match &self.own {
            Some(own) => own.path().join(name),
            None => self.output.join(INCOMPLETE).join(name),
        }
    }

    /// Removes the folder with all unfinished bags; only that of this process if others share it.
    pub(super) fn close(self) {
        if self.own.is_some() {
            return;
        }
        if let Err(error) = fs::remove_dir_all(self.output.join(INCOMPLETE)) {
            tracing::warn!("cannot remove {INCOMPLETE} in {}: {error}", self.output.display());
        }
    }
}

/// Locks the folder of unfinished scenes, which is created if needed.
fn lock(
    output: &Path,
    lock: impl Fn(&File) -> Result<(), fs::TryLockError>,
) -> Result<File, SimulateError> {
    let directory = output.join(INCOMPLETE);
    let path = directory.join("lock");
    loop {
        fs::create_dir_all(&directory).map_err(SimulateError::io("create", &directory))?;
        let file = File::create(&path).map_err(SimulateError::io("create", &path))?;
        lock(&file).map_err(|reason| SimulateError::Locked { lock: path.clone(), reason })?;
        // A process that has ended in between has removed the folder with this file.
        let held = file.metadata().map_err(SimulateError::io("read", &path))?;
        if fs::metadata(&path).is_ok_and(|found| found.ino() == held.ino()) {
            return Ok(file);
        }
    }
}

/// Whether a directory cannot be moved because there is one of that name.
fn is_taken(error: &std::io::Error) -> bool {
    matches!(error.kind(), ErrorKind::DirectoryNotEmpty | ErrorKind::AlreadyExists)
}
