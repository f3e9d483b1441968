//! Why scenes cannot be simulated into bags.

use std::{
    io::{self, ErrorKind},
    path::{Path, PathBuf},
};

use rayon::ThreadPoolBuildError;

use super::plan::bytes;
use eddy_bag::BagError;
use eddy_mpm::MpmError;

/// Why scenes cannot be simulated, or not all of them.
#[derive(Debug, thiserror::Error)]
pub enum SimulateError {
    /// The request cannot be met.
    #[error("{field}: found {found}, expected {expected}")]
    Request {
        /// The field of [`SimulationRequest`](super::SimulationRequest).
        field: &'static str,
        /// Its value.
        found: String,
        /// What it should be.
        expected: &'static str,
    },
    /// A scene of several cannot be simulated or written.
    #[error("{scene}: {reason}")]
    Scene {
        /// The scene: its number or its file.
        scene: String,
        /// Why.
        reason: Box<Self>,
    },
    /// The scene is out of range, or its simulation has diverged.
    #[error(transparent)]
    Mpm(#[from] MpmError),
    /// The scenes that are simulated at the same time do not fit into memory.
    #[error(
        "memory: found {} needed ({particles:.1e} particles, {} x {} cells, {at_once} at once), expected at \
         most the {} that are free; make the spacing larger, the domain smaller, or give fewer --particles or --threads",
        bytes(*needed), cells[0], cells[1], bytes(*free)
    )]
    Memory {
        /// For all scenes that are simulated at the same time (bytes).
        needed: u64,
        /// Particles of the scene, estimated.
        particles: f64,
        /// Cells of its grid along x and y.
        cells: [u32; 2],
        /// Scenes that are simulated at the same time.
        at_once: usize,
        /// What is free (bytes).
        free: u64,
    },
    /// A file or directory of the output cannot be read, made, moved or removed.
    #[error("cannot {action} {}: {reason}", path.display())]
    Io {
        /// What was tried.
        action: &'static str,
        /// The file or directory.
        path: PathBuf,
        /// What the system said.
        reason: io::Error,
    },
    /// The manifest is not one, or one of another version.
    #[error("{}: found no manifest of this eddy: {reason}", file.display())]
    NoManifest {
        /// The file.
        file: PathBuf,
        /// What is wrong in it.
        reason: serde_json::Error,
    },
    /// The directory holds the scenes of another request.
    #[error(
        "{}: found {found}, expected {expected}, which differ in {}; choose another --output",
        file.display(), fields.join(", ")
    )]
    OtherRequest {
        /// The manifest.
        file: PathBuf,
        /// Names of the fields that differ.
        fields: Vec<String>,
        /// The request there, as JSON.
        found: String,
        /// This request, as JSON.
        expected: String,
    },
    /// A bag of that name is there, of which the manifest knows nothing.
    #[error(
        "{}: found a directory that is not this scene by the manifest, expected none; \
         choose another --output",
        directory.display()
    )]
    OtherScene {
        /// The directory of the bag.
        directory: PathBuf,
    },
    /// Another process works in the output directory.
    #[error("{}: another eddy simulate works in this directory: {reason}", lock.display())]
    Locked {
        /// The locked file.
        lock: PathBuf,
        /// What the system said.
        reason: std::fs::TryLockError,
    },
    /// Another process has finished scenes between the plan and the lock.
    #[error(
        "{}: another eddy simulate has added scenes just now; run the command again",
        output.display()
    )]
    Changed {
        /// The output directory.
        output: PathBuf,
    },
    /// A bag cannot be written.
    #[error(transparent)]
    Bag(#[from] BagError),
    /// The threads cannot be started.
    #[error("threads: {0}")]
    Threads(#[from] ThreadPoolBuildError),
    /// It was cancelled before all scenes were finished.
    #[error(
        "interrupted: {finished} of {scenes} scenes are finished; the same command makes the others"
    )]
    Cancelled {
        /// Scenes that are finished, those from before included.
        finished: usize,
        /// Scenes asked for.
        scenes: u32,
    },
    /// Some scenes failed; the others are finished.
    #[error("{}", failed(failures, *finished, *scenes))]
    Failed {
        /// What failed, each a [`SimulateError::Scene`].
        failures: Vec<Self>,
        /// Scenes that are finished, those from before included.
        finished: usize,
        /// Scenes asked for.
        scenes: u32,
    },
}

impl SimulateError {
    /// Adds what was tried to an error of the system.
    pub(super) fn io(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Self {
        move |reason| Self::Io { action, path: path.to_owned(), reason }
    }

    /// Whether the scene itself is the reason: the others may be simulated even so.
    pub(super) fn is_of_the_scene(&self) -> bool {
        match self {
            Self::Scene { reason, .. } => reason.is_of_the_scene(),
            Self::Mpm(_) => true,
            _ => false,
        }
    }

    /// Whether the disk, or what this user may have of it, is full.
    fn is_full_disk(&self) -> bool {
        match self {
            Self::Scene { reason, .. } => reason.is_full_disk(),
            Self::Io { reason, .. } => matches!(
                reason.kind(),
                ErrorKind::StorageFull | ErrorKind::QuotaExceeded | ErrorKind::FileTooLarge
            ),
            Self::Bag(reason) => reason.is_disk_full(),
            _ => false,
        }
    }
}

/// A line for each failure, then what is left and what to do.
fn failed(failures: &[SimulateError], finished: usize, scenes: u32) -> String {
    let mut message: String = failures.iter().map(|failure| format!("{failure}\n")).collect();
    message += &format!("{finished} of {scenes} scenes are finished and kept");
    if failures.iter().any(SimulateError::is_full_disk) {
        message += "; no room is left: make some, and the same command makes the others";
    } else if !failures.iter().all(SimulateError::is_of_the_scene) {
        message += "; the same command makes the others";
    }
    message
}
