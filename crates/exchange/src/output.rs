//! Outputs that exist whole or not at all.

use std::{
    fs,
    path::{Path, PathBuf},
    process,
};

use super::error::ExchangeError;

/// A file or directory that gets its name when it is finished. Dropped before that, what was
/// written is taken away.
#[derive(Debug)]
pub struct Output {
    path: PathBuf,
    unfinished: PathBuf,
    named: bool,
}

impl Output {
    /// A place for `path`, whose parent directory is made if need be.
    ///
    /// # Errors
    /// [`ExchangeError::Exists`] when there is something already, [`ExchangeError::File`] when the
    /// path has no last part, [`ExchangeError::Io`] when the system refuses.
    pub fn new(path: &Path) -> Result<Self, ExchangeError> {
        let name = path.file_name().ok_or_else(|| ExchangeError::File {
            path: path.into(),
            found: "a path without a last part".into(),
            expected: "a name",
        })?;
        let output = Self {
            path: path.into(),
            // Hidden, so that a search for bags passes it by.
            unfinished: path.with_file_name(format!(
                ".{}.{}.unfinished",
                name.to_string_lossy(),
                process::id()
            )),
            named: false,
        };
        output.refuse_existing()?;
        if let Some(parent) = path.parent().filter(|parent| !parent.as_os_str().is_empty()) {
            fs::create_dir_all(parent)
                .map_err(ExchangeError::io(parent, "creating the directory"))?;
        }
        Ok(output)
    }

    /// As [`Output::new`], for a directory, which exists from now on under its unfinished name.
    ///
    /// # Errors
    /// As [`Output::new`].
    pub fn directory(path: &Path) -> Result<Self, ExchangeError> {
        let output = Self::new(path)?;
        fs::create_dir(&output.unfinished)
            .map_err(ExchangeError::io(&output.unfinished, "creating the directory"))?;
        Ok(output)
    }

    /// Where to write until it is finished.
    pub fn place(&self) -> &Path {
        &self.unfinished
    }

    /// Gives it its name.
    ///
    /// # Errors
    /// [`ExchangeError::Exists`] when something has taken the name meanwhile, [`ExchangeError::Io`]
    /// when the system refuses.
    pub fn finish(mut self) -> Result<(), ExchangeError> {
        self.refuse_existing()?;
        fs::rename(&self.unfinished, &self.path)
            .map_err(ExchangeError::io(&self.path, "naming the finished output"))?;
        self.named = true;
        Ok(())
    }

    fn refuse_existing(&self) -> Result<(), ExchangeError> {
        if fs::symlink_metadata(&self.path).is_ok() {
            return Err(ExchangeError::Exists { path: self.path.clone() });
        }
        Ok(())
    }
}

impl Drop for Output {
    fn drop(&mut self) {
        if self.named {
            return;
        }
        let is_directory = self.unfinished.is_dir();
        let outcome = match is_directory {
            true => fs::remove_dir_all(&self.unfinished),
            false if self.unfinished.exists() => fs::remove_file(&self.unfinished),
            false => Ok(()),
        };
        if let Err(error) = outcome {
            tracing::warn!("cannot remove {}: {error}", self.unfinished.display());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_not_finished_is_gone_and_what_is_there_stays() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("new/table.csv");
        let output = Output::new(&path).unwrap();
        fs::write(output.place(), "half").unwrap();
        drop(output);
        assert_eq!(fs::read_dir(folder.path().join("new")).unwrap().count(), 0);

        let output = Output::new(&path).unwrap();
        fs::write(output.place(), "whole").unwrap();
        output.finish().unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "whole");
        assert!(matches!(Output::new(&path), Err(ExchangeError::Exists { .. })));
    }

    #[test]
    fn a_name_taken_meanwhile_is_not_written_over() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("pictures");
        let output = Output::directory(&path).unwrap();
        fs::write(&path, "of somebody else").unwrap();
        assert!(matches!(output.finish(), Err(ExchangeError::Exists { .. })));
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }
}
