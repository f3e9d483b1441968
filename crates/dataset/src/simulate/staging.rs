//! The folder of unfinished bags: in the output directory, locked by the process that writes them or shared by several, each with a
//! folder of its own; or among the system's temporary files if the output is in a store.

use std::{
    fs::{self, File},
    io::{self, ErrorKind},
    os::unix::fs::MetadataExt as _,
    path::{Path, PathBuf},
};

use tempfile::{Builder, TempDir};

use super::{SimulateError, UPLOADED_LAST};
use eddy_settings::atomic;
use eddy_storage::is_remote;

/// Folder of unfinished scenes.
pub(super) const INCOMPLETE: &str = ".incomplete";

/// The folder of unfinished bags.
#[derive(Debug)]
pub(super) struct Staging {
    output: PathBuf,
    folder: Folder,
}

#[derive(Debug)]
enum Folder {
    /// In the output directory, for this process alone, which holds the lock.
    Alone { _lock: File },
    /// In the output directory, with a folder of this process, as others share the lock: two of them may simulate the same
    /// scene when the system that has started them takes one for lost.
    Shared { _lock: File, own: TempDir },
    /// Among the system's temporary files.
    Temporary(TempDir),
}

impl Staging {
    /// Opens the folder in an output directory for this process alone, creating both if needed.
    pub(super) fn open(output: &Path) -> Result<Self, SimulateError> {
        let folder = if is_remote(output) {
            Folder::Temporary(own_folder("eddy-simulate-", &std::env::temp_dir())?)
        } else {
            Folder::Alone { _lock: lock(output, File::try_lock)? }
        };
        Ok(Self { output: output.into(), folder })
    }

    /// As [`Staging::open`], with others that share the folder, which must be on a disk.
    pub(super) fn share(output: &Path) -> Result<Self, SimulateError> {
        let output = eddy_storage::on_disk(output).map_err(SimulateError::io("share", output))?;
        let lock = lock(&output, File::try_lock_shared)?;
        let own = own_folder("task-", &output.join(INCOMPLETE))?;
        Ok(Self { output: output.into(), folder: Folder::Shared { _lock: lock, own } })
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
        if let Folder::Temporary(_) = self.folder {
            upload(&bag, &directory)?;
            return self.discard(name);
        }
        match atomic::rename(&bag, &directory) {
            // Another process has just finished the same scene, with the same bits.
            Err(error) if matches!(self.folder, Folder::Shared { .. }) && is_taken(&error) => {
                self.discard(name)
            }
            outcome => outcome.map_err(SimulateError::io("move", &directory)),
        }
    }

    /// Where a bag is until it is finished.
    fn unfinished(&self, name: &str) -> PathBuf {
        match &self.folder {
            Folder::Alone { .. } => self.output.join(INCOMPLETE).join(name),
            Folder::Shared { own, .. } | Folder::Temporary(own) => own.path().join(name),
        }
    }

    /// Removes the folder with all unfinished bags; only that of this process if others share it.
    pub(super) fn close(self) {
        let folder = self.output.join(INCOMPLETE);
        let removed = match self.folder {
            Folder::Alone { .. } => fs::remove_dir_all(&folder),
            Folder::Shared { own, .. } | Folder::Temporary(own) => own.close(),
        };
        if let Err(error) = removed {
            tracing::warn!("{}: cannot remove unfinished scenes: {error}", folder.display());
        }
    }
}

fn own_folder(prefix: &str, place: &Path) -> Result<TempDir, SimulateError> {
    let folder = Builder::new().prefix(prefix).tempdir_in(place);
    folder.map_err(SimulateError::io("create a folder in", place))
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
fn is_taken(error: &io::Error) -> bool {
    matches!(error.kind(), ErrorKind::DirectoryNotEmpty | ErrorKind::AlreadyExists)
}
