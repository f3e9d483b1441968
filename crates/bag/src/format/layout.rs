//! The files of a bag, and where bags are found.

use std::{
    ffi::OsStr,
    path::{Path, PathBuf},
};

use eddy_storage::{Entry, Kind};

use super::{
    description::Description,
    metadata::{self, exists},
};
use crate::error::BagError;

/// Suffix of a file that is being written.
pub(crate) const ACTIVE: &str = ".active";

/// The name of the bag in `directory`: the last component of the path.
///
/// # Errors
/// [`BagError::NotABag`] when the path does not end in a name (`/`, `..`), or not in UTF-8.
pub(crate) fn name_of(directory: &Path) -> Result<String, BagError> {
    let name = directory.file_name().and_then(|name| name.to_str());
    name.map(str::to_owned).ok_or_else(|| BagError::NotABag {
        path: directory.into(),
        found: "a path that does not end in a name in UTF-8".into(),
    })
}

/// Split file `number`, from 0, of the bag `name`: `run7_0.mcap` for the bag `run7`.
pub(crate) fn numbered(directory: &Path, name: &str, number: usize) -> PathBuf {
    directory.join(format!("{name}_{number}.mcap"))
}

/// Whether the path names an MCAP file, finished or not.
pub(crate) fn is_mcap(path: &Path) -> bool {
    let name = path.file_name().map(|name| name.to_string_lossy()).unwrap_or_default();
    name.strip_suffix(ACTIVE).unwrap_or(&name).ends_with(".mcap")
}

/// Whether the file is still being written, or its writer was killed.
pub(crate) fn is_active(path: &Path) -> bool {
    path.to_string_lossy().ends_with(ACTIVE)
}

/// The MCAP files of the bag at `path`, and what `metadata.yaml` says of them: those that it lists, or without one all files in the
/// directory of an unfinished bag, or the file itself.
pub(crate) fn files_of(path: &Path) -> Result<(Vec<PathBuf>, Option<Description>), BagError> {
    let not_a_bag = |found: &str| BagError::NotABag { path: path.into(), found: found.into() };
    if kind(path, "opening the bag")? == Kind::File {
        return if is_mcap(path) {
            Ok((vec![path.into()], None))
        } else {
            Err(not_a_bag(match path.extension().and_then(OsStr::to_str) {
                Some("zstd" | "zst") => "a compressed file, which `zstd -d` decompresses",
                _ => "a file of another kind",
            }))
        };
    }
    let description = path.join(metadata::FILE_NAME);
    if exists(&description)? {
        let (files, description) = metadata::files(&description, path)?;
        return Ok((files, Some(description)));
    }
    let Children { files, directories, .. } = children(path)?;
    if files.is_empty() {
        let found = "a directory without metadata.yaml and without .mcap files";
        for bag in &directories {
            if exists(&bag.join(metadata::FILE_NAME))? {
                let bag = bag.display();
                return Err(not_a_bag(&format!("{found} (but with bags, such as {bag})")));
            }
        }
        return Err(not_a_bag(found));
    }
    Ok((files, None))
}

/// The MCAP files at `path` regardless of `metadata.yaml`: all in a directory, or the file itself.
pub(crate) fn mcap_files(path: &Path) -> Result<Vec<PathBuf>, BagError> {
    if kind(path, "opening the bag")? == Kind::File {
        return Ok(vec![path.into()]);
    }
    let files = children(path)?.files;
    if files.is_empty() {
        let found = "a directory without .mcap files".into();
        return Err(BagError::NotABag { path: path.into(), found });
    }
    Ok(files)
}

/// The bags at and below `paths`, each once, in the order of `paths` and then by name.
///
/// A path may be a bag directory, an MCAP file, or a directory that contains bags at any depth
/// (links to directories are not followed). A directory is a bag when it contains `metadata.yaml` or a
/// file named after the directory, as a killed [`BagWriter`](crate::BagWriter) leaves it.
///
/// # Errors
/// [`BagError::Io`] when a path cannot be read, [`BagError::NotABag`] when one is a file of another
/// kind, [`BagError::NoBags`] when no bag is found.
pub fn find_bags(paths: &[PathBuf]) -> Result<Vec<PathBuf>, BagError> {
    let mut bags = Vec::new();
    for path in paths {
        match kind(path, "looking for bags")? {
            Kind::Directory => collect(path, &mut bags)?,
            Kind::File => bags.extend(files_of(path)?.0),
        }
    }
    let mut seen = std::collections::HashSet::new();
    bags.retain(|bag| seen.insert(bag.clone()));
    if bags.is_empty() {
        return Err(BagError::NoBags { paths: paths.to_vec() });
    }
    Ok(bags)
}

fn collect(directory: &Path, bags: &mut Vec<PathBuf>) -> Result<(), BagError> {
    let Children { files, directories, has_metadata } = children(directory)?;
    let active = |file: &Path| PathBuf::from(format!("{}{ACTIVE}", file.display()));
    let named_after_it = name_of(directory).is_ok_and(|name| {
        let file = numbered(directory, &name, 0);
        files.contains(&active(&file)) || files.contains(&file)
    });
    if named_after_it || has_metadata {
        bags.push(directory.into());
        return Ok(());
    }
    bags.extend(files);
    directories.iter().try_for_each(|child| collect(child, bags))
}

/// What a directory holds, each sorted by name.
struct Children {
    /// MCAP files.
    files: Vec<PathBuf>,
    directories: Vec<PathBuf>,
    has_metadata: bool,
}

/// One request where the directory is in a store.
fn children(directory: &Path) -> Result<Children, BagError> {
    let entries = eddy_storage::list(directory);
    let entries = entries.map_err(BagError::io(directory, "listing the directory"))?;
    let mut children = Children { files: Vec::new(), directories: Vec::new(), has_metadata: false };
    for Entry { path, is_directory } in entries {
        let name = path.file_name().unwrap_or_default();
        if name.as_encoded_bytes().starts_with(b".") {
            // Hidden: for example the scenes that `eddy simulate` is still writing.
            continue;
        }
        if is_directory {
            children.directories.push(path);
        } else if is_mcap(&path) {
            children.files.push(path);
        } else if name == metadata::FILE_NAME {
            children.has_metadata = true;
        }
    }
    Ok(children)
}

fn kind(path: &Path, action: &'static str) -> Result<Kind, BagError> {
    eddy_storage::kind(path).map_err(BagError::io(path, action))
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    fn touch(path: &Path) {
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, "").unwrap();
    }

    #[test]
    fn bags_are_found_as_directories_as_files_and_below_directories() {
        let root = tempfile::tempdir().unwrap();
        let at = |name: &str| root.path().join(name);
        for file in [
            "set/b/metadata.yaml",
            "set/b/b_0.mcap",
            "set/a/a_0.mcap.active",
            "set/deep/c/c_0.mcap",
            "set/lone.mcap",
            "set/notes.txt",
        ] {
            touch(&at(file));
        }
        let expected = ["set/lone.mcap", "set/a", "set/b", "set/deep/c"].map(at);
        assert_eq!(find_bags(&[at("set")]).unwrap(), expected);
        assert_eq!(
            find_bags(&[at("set/b"), at("set/lone.mcap"), at("set/b")]).unwrap(),
            [at("set/b"), at("set/lone.mcap")]
        );
    }

    #[test]
    fn a_directory_without_bags_is_an_error_that_names_it() {
        let root = tempfile::tempdir().unwrap();
        let message = find_bags(&[root.path().into()]).unwrap_err().to_string();
        let expected = format!(
            "{}: found no bag, expected bag directories or .mcap files there",
            root.path().display()
        );
        assert_eq!(message, expected);
    }

    #[test]
    fn a_file_of_another_kind_is_rejected() {
        let root = tempfile::tempdir().unwrap();
        let file = root.path().join("notes.txt");
        touch(&file);
        let message = find_bags(&[file]).unwrap_err().to_string();
        assert!(
            message.contains("found a file of another kind, expected a bag directory"),
            "{message}"
        );
    }
}
