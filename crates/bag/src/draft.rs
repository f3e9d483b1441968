//! A bag that appears under its name when it is complete, and leaves nothing behind otherwise.

use std::{io, path::Path};

use super::{
    error::BagError,
    layout,
    writer::{BagSummary, BagWriter, WriterOptions},
};
use eddy_settings::atomic::Staged;

/// A bag that is being written into a hidden directory beside its destination.
pub(super) struct Draft {
    /// Where messages go.
    pub(super) writer: BagWriter,
    staged: Staged,
}

impl Draft {
    /// Begins a bag that will be called `path`.
    ///
    /// # Errors
    /// As [`BagWriter::create`].
    pub(super) fn begin(path: &Path, options: WriterOptions) -> Result<Self, BagError> {
        layout::name_of(path)?;
        let staged = Staged::new(path).map_err(failed(path, "creating the bag"))?;
        Ok(Self { writer: BagWriter::create(&staged.path(), options)?, staged })
    }

    /// Finishes the bag and gives it its name.
    ///
    /// # Errors
    /// As [`BagWriter::finish`]; [`BagError::Exists`] when something has taken its name. A bag that did
    /// not fit on the disk is not delivered: its [`BagError::Io`].
    pub(super) fn deliver(self, path: &Path) -> Result<BagSummary, BagError> {
        let mut bag = self.writer.finish()?;
        if bag.lost > 0 {
            return Err(BagError::io(path, "writing")(io::ErrorKind::StorageFull.into()));
        }
        self.staged.commit().map_err(failed(path, "naming the finished bag"))?;
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
