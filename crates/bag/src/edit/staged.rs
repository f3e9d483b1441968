//! A new bag that appears when it is complete, and is removed otherwise.

use std::{io, path::Path};

use crate::{
    error::BagError,
    format::{layout, summary::BagSummary},
    write::{bag::BagWriter, options::WriterOptions},
};
use eddy_settings::atomic::Staged;

/// A bag that is written in a hidden directory beside its destination.
pub(super) struct StagedBag {
    pub(super) writer: BagWriter,
    staged: Staged,
}

impl StagedBag {
    /// Creates a bag that will be moved to `path`.
    ///
    /// # Errors
    /// As [`BagWriter::create`].
    pub(super) fn create(path: &Path, options: WriterOptions) -> Result<Self, BagError> {
        layout::name_of(path)?;
        let staged = Staged::new(path).map_err(failed(path, "creating the bag"))?;
        Ok(Self { writer: BagWriter::create(&staged.path(), options)?, staged })
    }

    /// Finishes the bag and moves it to `path`.
    ///
    /// # Errors
    /// As [`BagWriter::finish`]; [`BagError::Exists`] when `path` exists by now; [`BagError::Io`] when the bag did
    /// not fit on the disk.
    pub(super) fn commit(self, path: &Path) -> Result<BagSummary, BagError> {
        let mut bag = self.writer.finish()?;
        if bag.lost > 0 {
            return Err(BagError::io(path, "writing")(io::ErrorKind::StorageFull.into()));
        }
        self.staged.commit().map_err(failed(path, "renaming the finished bag"))?;
        bag.directory = path.into();
        for file in &mut bag.files {
            if let Some(name) = file.path.file_name() {
                file.path = path.join(name);
            }
        }
        Ok(bag)
    }
}

fn failed(path: &Path, action: &'static str) -> impl FnOnce(io::Error) -> BagError {
    move |reason| match reason.kind() {
        io::ErrorKind::AlreadyExists => BagError::Exists { path: path.into() },
        _ => BagError::io(path, action)(reason),
    }
}
