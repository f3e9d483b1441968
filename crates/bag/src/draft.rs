//! A bag that appears under its name when it is whole, and leaves nothing behind when it never is.

use std::{
    fs,
    path::{Path, PathBuf},
};

use super::{
    error::BagError,
    layout,
    writer::{BagSummary, BagWriter, WriterOptions},
};

/// A bag in the making, in a hidden directory beside the place where it will be.
pub(super) struct Draft {
    /// `None` once it is finished.
    writer: Option<BagWriter>,
    place: Place,
}

/// The hidden directory; it goes when this goes.
struct Place(PathBuf);

impl Drop for Place {
    fn drop(&mut self) {
        // Renamed away when the bag is whole: then there is nothing to remove.
        let _ = fs::remove_dir_all(&self.0);
    }
}

impl Draft {
    /// Begins a bag that will be called `path`.
    ///
    /// # Errors
    /// As [`BagWriter::create`].
    pub(super) fn begin(path: &Path, options: WriterOptions) -> Result<Self, BagError> {
        let name = layout::name_of(path)?;
        refuse_existing(path)?;
        let hidden = path.with_file_name(format!(".{name}.{}.unfinished", std::process::id()));
        let writer = BagWriter::create_in(&hidden, &name, options)?;
        Ok(Self { writer: Some(writer), place: Place(hidden) })
    }

    /// Where messages go.
    pub(super) fn writer(&mut self) -> &mut BagWriter {
        self.writer.as_mut().expect("a draft has its writer until deliver takes the draft")
    }

    /// Finishes the bag and gives it its name.
    ///
    /// # Errors
    /// As [`BagWriter::finish`]; [`BagError::Exists`] when something of that name has come to be. A
    /// bag that the disk had no room for is not delivered: its [`BagError::Io`].
    pub(super) fn deliver(mut self, path: &Path) -> Result<BagSummary, BagError> {
        let writer = self.writer.take().expect("a draft has its writer until this takes it");
        let mut bag = writer.finish()?;
        if bag.lost > 0 {
            let reason = std::io::ErrorKind::StorageFull.into();
            return Err(BagError::Io { path: path.into(), action: "writing", reason });
        }
        refuse_existing(path)?;
        fs::rename(&self.place.0, path).map_err(BagError::io(path, "naming the finished bag"))?;
        bag.directory = path.into();
        for file in &mut bag.files {
            if let Some(name) = file.path.file_name() {
                file.path = path.join(name);
            }
        }
        Ok(bag)
    }
}

fn refuse_existing(path: &Path) -> Result<(), BagError> {
    match fs::symlink_metadata(path) {
        Ok(_) => Err(BagError::Exists { path: path.into() }),
        Err(_) => Ok(()),
    }
}
