//! The folder of unfinished bags: in the output directory, locked by the process that writes them, or in the system's folder of
//! temporary files if the output is in a store.

use std::{
    fs::{self, File},
    path::{Path, PathBuf},
};

use tempfile::TempDir;

use super::{SimulateError, UPLOADED_LAST};
use eddy_settings::atomic;
use eddy_storage::is_remote;

/// Folder of unfinished scenes.
const INCOMPLETE: &str = ".incomplete";

/// The folder of unfinished bags, used by one process at a time.
#[derive(Debug)]
pub(super) struct Staging {
    output: PathBuf,
    folder: Folder,
}

#[derive(Debug)]
enum Folder {
    /// Holds the lock while open.
    InOutput {
        _lock: File,
    },
    Temporary(TempDir),
}

impl Staging {
    /// Opens the folder of an output directory, creating both if needed.
    pub(super) fn open(output: &Path) -> Result<Self, SimulateError> {
        if is_remote(output) {
            let place = std::env::temp_dir();
            let folder = tempfile::Builder::new().prefix("eddy-simulate-").tempdir_in(&place);
            let folder = folder.map_err(SimulateError::io("create a folder in", &place))?;
            return Ok(Self { output: output.into(), folder: Folder::Temporary(folder) });
        }
        let directory = output.join(INCOMPLETE);
        fs::create_dir_all(&directory).map_err(SimulateError::io("create", &directory))?;
        let path = directory.join("lock");
        let lock = File::create(&path).map_err(SimulateError::io("create", &path))?;
        lock.try_lock().map_err(|reason| SimulateError::Locked { lock: path, reason })?;
        Ok(Self { output: output.into(), folder: Folder::InOutput { _lock: lock } })
    }

    /// The unfinished bag of this name.
    fn unfinished(&self, name: &str) -> PathBuf {
        match &self.folder {
            Folder::InOutput { .. } => self.output.join(INCOMPLETE).join(name),
            Folder::Temporary(folder) => folder.path().join(name),
        }
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
        let (bag, directory) = (self.unfinished(name), self.output.join(name));
        match &self.folder {
            Folder::InOutput { .. } => {
                atomic::rename(&bag, &directory).map_err(SimulateError::io("move", &directory))
            }
            Folder::Temporary(_) => {
                upload(&bag, &directory)?;
                self.discard(name)
            }
        }
    }

    /// Removes the folder with all unfinished bags.
    pub(super) fn close(self) {
        if let Folder::Temporary(folder) = self.folder {
            if let Err(error) = folder.close() {
                tracing::warn!("a folder of temporary files cannot be removed: {error}");
            }
            return;
        }
        if let Err(error) = fs::remove_dir_all(self.output.join(INCOMPLETE)) {
            tracing::warn!("cannot remove {INCOMPLETE} in {}: {error}", self.output.display());
        }
    }
}

/// Stores the files of a bag in a directory of a store; the one that tells that the bag is complete comes last.
fn upload(bag: &Path, directory: &Path) -> Result<(), SimulateError> {
    let entries = eddy_storage::list(bag).map_err(SimulateError::io("read", bag))?;
    let is_last = |file: &Path| file.ends_with(UPLOADED_LAST);
    let (last, first): (Vec<_>, Vec<_>) = entries.into_iter().partition(|file| is_last(&file.path));
    for file in first.into_iter().chain(last) {
        let to = directory.join(file.path.file_name().unwrap_or_default());
        eddy_storage::upload(&file.path, &to).map_err(SimulateError::io("upload", &to))?;
    }
    Ok(())
}
