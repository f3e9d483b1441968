//! Files and directories that appear under their name complete or not at all, also after a crash or a
//! power failure: written beside their destination, synced, renamed, and the rename synced.

use std::{
    fs::{self, File},
    io::{self, Write as _},
    path::{Path, PathBuf},
};

use tempfile::{Builder, TempDir};

/// A file or directory on its way to its name. Dropped before [`Staged::commit`], it is removed.
#[derive(Debug)]
pub struct Staged {
    /// Holds nothing but the new file or directory, under its final name.
    directory: TempDir,
    destination: PathBuf,
    replace: bool,
}

impl Staged {
    /// Stages a file or directory that does not exist yet. Missing parent directories are created.
    ///
    /// # Errors
    /// [`io::ErrorKind::AlreadyExists`] when there is something at `destination`,
    /// [`io::ErrorKind::InvalidInput`] when its last component is no name, and those of the system.
    pub fn new(destination: &Path) -> io::Result<Self> {
        check_absent(destination)?;
        Self::create(destination, false)
    }

    /// Stages a file that replaces the one at `destination`, if there is one.
    ///
    /// # Errors
    /// As [`Staged::new`], without `AlreadyExists`.
    pub fn replacing(destination: &Path) -> io::Result<Self> {
        Self::create(destination, true)
    }

    fn create(destination: &Path, replace: bool) -> io::Result<Self> {
        let name = destination.file_name().ok_or_else(|| {
            io::Error::new(io::ErrorKind::InvalidInput, "the path does not end in a name")
        })?;
        let parent = parent(destination);
        fs::create_dir_all(parent)?;
        // Hidden, so that nothing takes it for an output.
        let prefix = format!(".{}.", name.to_string_lossy());
        let directory = Builder::new().prefix(&prefix).suffix(".unfinished").tempdir_in(parent)?;
        Ok(Self { directory, destination: destination.into(), replace })
    }

    /// Where to create the file or directory. It has its final name there, in a hidden directory beside
    /// the destination.
    pub fn path(&self) -> PathBuf {
        self.directory.path().join(self.destination.file_name().unwrap_or_default())
    }

    /// Syncs the file, or all files of the directory, and moves it to its destination.
    ///
    /// # Errors
    /// [`io::ErrorKind::AlreadyExists`] when something has taken the name since [`Staged::new`], and
    /// those of the system.
    pub fn commit(self) -> io::Result<()> {
        sync(&self.path())?;
        if !self.replace {
            check_absent(&self.destination)?;
        }
        rename(&self.path(), &self.destination)
    }
}

fn check_absent(path: &Path) -> io::Result<()> {
    match fs::symlink_metadata(path) {
        Ok(_) => Err(io::ErrorKind::AlreadyExists.into()),
        Err(_) => Ok(()),
    }
}

fn parent(path: &Path) -> &Path {
    match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    }
}

fn sync(path: &Path) -> io::Result<()> {
    if fs::symlink_metadata(path)?.is_dir() {
        for entry in fs::read_dir(path)? {
            sync(&entry?.path())?;
        }
    }
    File::open(path)?.sync_all()
}

/// Replaces the content of the file at `path`, or creates it: readers see the old bytes or the new ones.
///
/// # Errors
/// Those of the system; the old file is then still there.
pub fn replace(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let staged = Staged::replacing(path)?;
    fs::write(staged.path(), bytes)?;
    staged.commit()
}

/// Writes a file in place and syncs it: for a file that is not read before it is renamed.
///
/// # Errors
/// Those of the system.
pub fn write_synced(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut file = File::create(path)?;
    file.write_all(bytes)?;
    file.sync_all()
}

/// Renames a synced file or directory, so that the new name survives a power failure.
///
/// # Errors
/// Those of the system.
pub fn rename(from: &Path, to: &Path) -> io::Result<()> {
    fs::rename(from, to)?;
    // Some network file systems cannot sync a directory; the rename has taken place all the same.
    let _ = File::open(parent(to)).and_then(|directory| directory.sync_all());
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(directory: &Path) -> Vec<String> {
        let entries = fs::read_dir(directory).unwrap();
        entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect()
    }

    #[test]
    fn a_file_appears_when_it_is_committed() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("new/table.csv");
        let staged = Staged::new(&path).unwrap();
        fs::write(staged.path(), "complete").unwrap();
        assert_eq!(staged.path().extension().unwrap(), "csv");
        assert!(!path.exists());
        staged.commit().unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "complete");
        assert_eq!(names(path.parent().unwrap()), ["table.csv"]);
    }

    #[test]
    fn what_was_not_committed_is_removed() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("pictures");
        let staged = Staged::new(&path).unwrap();
        fs::create_dir(staged.path()).unwrap();
        fs::write(staged.path().join("strip.png"), "half").unwrap();
        drop(staged);
        assert!(names(folder.path()).is_empty());
    }

    #[test]
    fn a_directory_appears_with_all_its_files() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("pictures");
        let staged = Staged::new(&path).unwrap();
        fs::create_dir_all(staged.path().join("deep")).unwrap();
        fs::write(staged.path().join("deep/strip.png"), "complete").unwrap();
        staged.commit().unwrap();
        assert_eq!(fs::read_to_string(path.join("deep/strip.png")).unwrap(), "complete");
    }

    #[test]
    fn an_existing_file_or_directory_is_not_overwritten() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("pictures");
        let staged = Staged::new(&path).unwrap();
        fs::create_dir(staged.path()).unwrap();
        // An empty directory, which a plain rename would replace.
        fs::create_dir(&path).unwrap();
        let exists = io::ErrorKind::AlreadyExists;
        assert_eq!(Staged::new(&path).unwrap_err().kind(), exists);
        assert_eq!(staged.commit().unwrap_err().kind(), exists);
        assert_eq!(names(folder.path()), ["pictures"]);
    }

    #[test]
    fn a_file_is_replaced_as_a_whole_or_stays() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("manifest.json");
        replace(&path, b"old").unwrap();
        replace(&path, b"new").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"new");
        let staged = Staged::replacing(&path).unwrap();
        fs::write(staged.path(), "half").unwrap();
        drop(staged);
        assert_eq!(fs::read(&path).unwrap(), b"new");
        assert_eq!(names(folder.path()), ["manifest.json"]);
    }

    #[test]
    fn a_path_without_a_name_is_rejected() {
        let error = Staged::replacing(Path::new("/")).unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::InvalidInput);
    }

    #[test]
    #[cfg(unix)]
    fn permissions_are_those_of_any_new_file() {
        use std::os::unix::fs::PermissionsExt as _;
        let folder = tempfile::tempdir().unwrap();
        let mode =
            |name: &str| fs::metadata(folder.path().join(name)).unwrap().permissions().mode();
        fs::write(folder.path().join("plain"), "").unwrap();
        replace(&folder.path().join("replaced"), b"").unwrap();
        assert_eq!(mode("plain"), mode("replaced"));
    }
}
