//! One rule for outputs that already exist: a command leaves them as they are and says so, before it does any work.
//! `--force` replaces an output of the same kind, and nothing else.
//!
//! The old output is moved aside and removed when the new one is complete; if the command fails, it is moved back.

use std::{
    fs, io,
    path::{Path, PathBuf},
};

use anyhow::{Context as _, bail, ensure};
use eddy_bag::is_being_written;
use tempfile::{Builder, TempDir};

/// What a command writes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OutputKind {
    /// A bag: a directory with MCAP files.
    Bag,
    /// A directory of bags.
    Bags,
    /// A checkpoint with the files of its training.
    Checkpoint,
    /// Bag and report of a demo.
    Demo,
    /// The files of a report, in a directory that may hold others.
    Report,
    /// A page.
    Page,
    /// Frames for other programs.
    Export,
    /// Pictures.
    Pictures,
}

impl OutputKind {
    fn name(self) -> &'static str {
        match self {
            Self::Bag => "a bag",
            Self::Bags => "a directory of bags",
            Self::Checkpoint => "a training output",
            Self::Demo => "an output of a demo",
            Self::Report => "a report",
            Self::Page => "an HTML page",
            Self::Export => "an export",
            Self::Pictures => "pictures",
        }
    }

    /// Whether commands with such outputs write files of this name.
    fn has(self, file: &Path) -> bool {
        let name = file.file_name().unwrap_or_default().to_string_lossy();
        let extension = file.extension().unwrap_or_default().to_string_lossy();
        let is_bag =
            name.ends_with(".mcap") || name.ends_with(".mcap.active") || name == "metadata.yaml";
        match self {
            Self::Bag => is_bag,
            Self::Bags => is_bag || name == "manifest.json" || file.ends_with(".incomplete/lock"),
            Self::Checkpoint => {
                let name = name.strip_suffix(".new").unwrap_or(&name);
                matches!(
                    name,
                    "model.toml"
                        | "model.safetensors"
                        | "error_model.toml"
                        | "resume.toml"
                        | "resume.safetensors"
                        | "metrics.csv"
                ) || name.starts_with("events.out.tfevents.")
            }
            Self::Demo => is_bag || REPORT_FILES.contains(&&*name),
            Self::Report => REPORT_FILES.contains(&&*name),
            Self::Page => extension == "html",
            Self::Export => {
                matches!(
                    &*extension,
                    "npz" | "npy" | "csv" | "ply" | "vtu" | "pvd" | "vtkhdf" | "h5"
                ) || name == "metadata.json"
            }
            Self::Pictures => matches!(&*extension, "png" | "gif" | "apng" | "mp4"),
        }
    }
}

/// The files of a report, of which the first is always there.
const REPORT_FILES: [&str; 4] = ["report.json", "report.html", "curves.csv", "cost_error.png"];

/// A place for an output, and the old output of the same name until the new one is complete.
#[must_use = "the old output is restored unless it is replaced"]
pub struct Output {
    path: PathBuf,
    old: Option<TempDir>,
}

impl Output {
    /// Makes room for an output at `path`; `inputs` are read by the command.
    ///
    /// # Errors
    /// If something is there and `force` is not set, or it is not an output of this kind, or it is an input.
    pub fn at(
        path: &Path,
        kind: OutputKind,
        force: bool,
        inputs: &[PathBuf],
    ) -> anyhow::Result<Self> {
        on_disk(path)?;
        let mut output = Self { path: path.to_owned(), old: None };
        if !exists(path, kind) {
            return Ok(output);
        }
        let shown = path.display();
        ensure!(
            force,
            "{shown}: already exists; choose another --output, or replace it with --force"
        );
        if let Some(other) = foreign(path, kind)? {
            let (kind, other) = (kind.name(), other.display());
            bail!("{shown}: --force replaces only {kind}, found {other}");
        }
        // A report is written over file by file, beside whatever else is in its directory.
        if kind == OutputKind::Report {
            return Ok(output);
        }
        if let Some(file) = being_written(path)? {
            let file = file.display();
            bail!("{shown}: another process is writing {file}, expected another --output");
        }
        let whole = fs::canonicalize(path)?;
        for input in inputs {
            let is_same = fs::canonicalize(input)
                .is_ok_and(|input| input.starts_with(&whole) || whole.starts_with(input));
            ensure!(!is_same, "{shown}: is also an input, expected another --output");
        }
        output.old =
            Some(moved_aside(path).with_context(|| format!("{shown}: cannot be replaced"))?);
        Ok(output)
    }

    /// The new output is complete: removes the old one.
    pub fn replaced(mut self) {
        if let Some(old) = self.old.take() {
            let path = old.path().to_owned();
            if let Err(error) = old.close() {
                tracing::warn!("{}: cannot be removed: {error}", path.display());
            }
        }
    }
}

impl Drop for Output {
    /// Moves the old output back, unless there is a new one, complete or not.
    fn drop(&mut self) {
        let Some(old) = self.old.take() else { return };
        let name = self.path.file_name().unwrap_or_default();
        let is_free = fs::symlink_metadata(&self.path).is_err();
        if is_free && fs::rename(old.path().join(name), &self.path).is_ok() {
            return;
        }
        let kept = old.keep();
        tracing::warn!("{}: the old output was kept in {}", self.path.display(), kept.display());
    }
}

/// Checks that a path is not a URL.
///
/// # Errors
/// With what was found and expected.
pub fn on_disk(path: &Path) -> anyhow::Result<()> {
    eddy_storage::on_disk(path).with_context(|| path.display().to_string())?;
    Ok(())
}

fn exists(path: &Path, kind: OutputKind) -> bool {
    match kind {
        OutputKind::Report => path.join(REPORT_FILES[0]).exists(),
        _ => fs::symlink_metadata(path).is_ok(),
    }
}

/// The first file that a command with outputs of this kind does not write. Links are not followed.
fn foreign(path: &Path, kind: OutputKind) -> io::Result<Option<PathBuf>> {
    if kind == OutputKind::Report {
        return Ok(None);
    }
    let found = fs::symlink_metadata(path)?;
    if !found.is_dir() {
        return Ok((!found.is_file() || !kind.has(path)).then(|| path.to_owned()));
    }
    for entry in fs::read_dir(path)? {
        if let Some(other) = foreign(&entry?.path(), kind)? {
            return Ok(Some(other));
        }
    }
    Ok(None)
}

/// The first file of a bag that another process is writing now. Links are not followed.
fn being_written(path: &Path) -> io::Result<Option<PathBuf>> {
    if !fs::symlink_metadata(path)?.is_dir() {
        let is_active = path.extension().is_some_and(|extension| extension == "active");
        return Ok((is_active && is_being_written(path)).then(|| path.to_owned()));
    }
    for entry in fs::read_dir(path)? {
        if let Some(file) = being_written(&entry?.path())? {
            return Ok(Some(file));
        }
    }
    Ok(None)
}

/// Moves an output into a hidden directory beside it.
fn moved_aside(path: &Path) -> io::Result<TempDir> {
    let name = path.file_name().ok_or(io::ErrorKind::InvalidInput)?;
    let parent = path.parent().filter(|parent| !parent.as_os_str().is_empty());
    let prefix = format!(".{}.", name.to_string_lossy());
    let aside = Builder::new()
        .prefix(&prefix)
        .suffix(".replaced")
        .tempdir_in(parent.unwrap_or(Path::new(".")))?;
    fs::rename(path, aside.path().join(name))?;
    Ok(aside)
}

/// `path`, or the first of `path-2`, `path-3`, ... that does not exist: for outputs whose name was not given.
pub fn unused(path: &Path) -> PathBuf {
    let numbered = |number: u32| {
        let mut name = path.file_name().unwrap_or_default().to_owned();
        name.push(format!("-{number}"));
        path.with_file_name(name)
    };
    std::iter::once(path.to_owned())
        .chain((2..).map(numbered))
        .find(|candidate| fs::symlink_metadata(candidate).is_err())
        .unwrap_or_else(|| path.to_owned())
}
