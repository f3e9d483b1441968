//! The place for what is not finished.

use std::{
    fs::{self, File},
    path::{Path, PathBuf},
};

use anyhow::Context;

/// Where scenes are written until they are finished.
const INCOMPLETE: &str = ".incomplete";

/// The place for what is not finished, held by one process at a time.
pub(super) struct Workshop {
    output: PathBuf,
    /// Locked as long as it is open.
    _lock: File,
}

impl Workshop {
    /// Opens the place in an output directory, which is made if need be.
    pub(super) fn open(output: &Path) -> anyhow::Result<Self> {
        let directory = output.join(INCOMPLETE);
        fs::create_dir_all(&directory)
            .with_context(|| format!("cannot make {}", directory.display()))?;
        let path = directory.join("lock");
        let lock =
            File::create(&path).with_context(|| format!("cannot make {}", path.display()))?;
        lock.try_lock().with_context(|| {
            format!("{}: another eddy simulate works in this directory", path.display())
        })?;
        Ok(Self { output: output.into(), _lock: lock })
    }

    /// The output directory.
    pub(super) fn output(&self) -> &Path {
        &self.output
    }

    /// A free place for a bag. What an ended process left there is taken away.
    pub(super) fn place(&self, name: &str) -> anyhow::Result<PathBuf> {
        let place = self.output.join(INCOMPLETE).join(name);
        self.discard(name)?;
        Ok(place)
    }

    /// Takes an unfinished bag away, if there is one.
    pub(super) fn discard(&self, name: &str) -> anyhow::Result<()> {
        let place = self.output.join(INCOMPLETE).join(name);
        if place.exists() {
            fs::remove_dir_all(&place)
                .with_context(|| format!("cannot remove {}", place.display()))?;
        }
        Ok(())
    }

    /// Moves a finished bag to where it belongs.
    pub(super) fn deliver(&self, name: &str) -> anyhow::Result<()> {
        let directory = self.output.join(name);
        fs::rename(self.output.join(INCOMPLETE).join(name), &directory)
            .with_context(|| format!("cannot move {}", directory.display()))
    }

    /// Takes the place away with whatever is unfinished in it.
    pub(super) fn close(&self) {
        if let Err(error) = fs::remove_dir_all(self.output.join(INCOMPLETE)) {
            tracing::warn!("cannot remove {INCOMPLETE} in {}: {error}", self.output.display());
        }
    }
}
