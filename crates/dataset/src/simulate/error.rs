//! Why scenes cannot be simulated into bags.

use std::{
    io::{self, ErrorKind},
    path::{Path, PathBuf},
};

use rayon::ThreadPoolBuildError;

use super::plan::bytes;
use eddy_bag::BagError;
use eddy_frames::InvalidFrame;
use eddy_mpm::MpmError;

/// Why some or all scenes cannot be simulated.
#[derive(Debug, thiserror::Error)]
pub enum SimulateError {
    /// A number of the request is out of range.
    #[error("{field}: found {found}, expected {expected}")]
    Request {
        /// Field of [`SimulationRequest`](super::SimulationRequest).
        field: &'static str,
        /// Its value.
        found: String,
        /// What it should be.
        expected: &'static str,
    },
    /// One scene cannot be simulated or written.
    #[error("{scene}: {reason}")]
    Scene {
        /// Number or file of the scene.
        scene: String,
        /// Why.
        reason: Box<Self>,
    },
    /// The scene is out of range, or its simulation has diverged.
    #[error(transparent)]
    Mpm(#[from] MpmError),
    /// The scenes simulated in parallel do not fit into memory.
    #[error(
        "memory: {} needed ({particles:.1e} particles, {} x {} cells, {at_once} at once), {} available; \
         increase the spacing, reduce the domain, --particles, --fill or --threads",
        bytes(*needed), cells[0], cells[1], bytes(*free)
    )]
    Memory {
        /// For all scenes simulated in parallel (bytes).
        needed: u64,
        /// Particles of the scene, estimated.
        particles: f64,
        /// Cells of its grid along x and y.
        cells: [u32; 2],
        /// Scenes simulated in parallel.
        at_once: usize,
        /// Available memory (bytes).
        free: u64,
    },
    /// A file or directory of the output cannot be read, created, moved or removed.
    #[error("cannot {action} {}: {reason}", path.display())]
    Io {
        /// The failed operation.
        action: &'static str,
        /// The file or directory.
        path: PathBuf,
        /// The reason from the operating system.
        reason: io::Error,
    },
    /// The manifest is invalid or of another version.
    #[error("{}: not a manifest of this version of eddy: {reason}", file.display())]
    NoManifest {
        /// The file.
        file: PathBuf,
        /// What is wrong in it.
        reason: serde_json::Error,
    },
    /// The directory belongs to another request.
    #[error(
        "{}: the scenes there have {}; choose another --output, or replace them with --force",
        file.display(), fields.join(", ")
    )]
    OtherRequest {
        /// The manifest.
        file: PathBuf,
        /// The fields that differ, with their values there and in this request.
        fields: Vec<String>,
    },
    /// A bag of that name exists but is not in the manifest.
    #[error(
        "{}: already exists and is not this scene according to the manifest; \
         choose another --output, or replace all scenes there with --force",
        directory.display()
    )]
    OtherScene {
        /// The directory of the bag.
        directory: PathBuf,
    },
    /// The bag of a finished scene does not have the frames that were written.
    #[error(
        "{}: found {found}, expected {expected} as in manifest.json: the bag is damaged; delete it and run the same command again, or \
         replace all scenes there with --force",
        directory.display()
    )]
    Damaged {
        /// The directory of the bag.
        directory: PathBuf,
        /// What it has.
        found: String,
        /// What it should have.
        expected: String,
    },
    /// Another process uses the output directory.
    #[error("{}: another process simulates scenes in this directory: {reason}", lock.display())]
    Locked {
        /// The locked file.
        lock: PathBuf,
        /// The reason from the operating system.
        reason: std::fs::TryLockError,
    },
    /// Another process has finished scenes between the plan and the lock.
    #[error(
        "{}: another `eddy simulate` has just added scenes; run the command again",
        output.display()
    )]
    Changed {
        /// The output directory.
        output: PathBuf,
    },
    /// Scenes that other processes should have simulated are not there.
    #[error("{}: found no bag, expected that of a simulated scene{}", directory.display(), others(*more))]
    Missing {
        /// The directory of the first that is missing.
        directory: PathBuf,
        /// How many others are missing.
        more: usize,
    },
    /// A simulated frame is not plausible: no model would be trained on it.
    #[error("at {time:.3} s: frame {sequence}: {reason}; try more substeps")]
    Implausible {
        /// Simulation time (s).
        time: f64,
        /// The frame.
        sequence: u64,
        /// Why.
        reason: InvalidFrame,
    },
    /// A bag cannot be written.
    #[error(transparent)]
    Bag(#[from] BagError),
    /// The threads cannot be started.
    #[error("threads: {0}")]
    Threads(#[from] ThreadPoolBuildError),
    /// The simulation was cancelled before all scenes were finished.
    #[error(
        "interrupted: {finished} of {scenes} scenes are finished; run the same command again to resume"
    )]
    Cancelled {
        /// Finished scenes, including those of earlier runs.
        finished: usize,
        /// Requested scenes.
        scenes: u32,
    },
    /// Some scenes failed; the others are finished.
    #[error("{}", failed(failures, *finished, *scenes))]
    Failed {
        /// One [`SimulateError::Scene`] each.
        failures: Vec<Self>,
        /// Finished scenes, including those of earlier runs.
        finished: usize,
        /// Requested scenes.
        scenes: u32,
    },
}

impl SimulateError {
    /// Adds the failed operation to an I/O error.
    pub(super) fn io(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Self {
        move |reason| Self::Io { action, path: path.to_owned(), reason }
    }

    /// Whether the scene itself is the cause, so that other scenes can still be simulated.
    pub(super) fn is_of_the_scene(&self) -> bool {
        match self {
            Self::Scene { reason, .. } => reason.is_of_the_scene(),
            Self::Mpm(reason) => !matches!(reason, MpmError::Device(_)),
            _ => false,
        }
    }

    /// Whether the disk or the user's quota is full.
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

/// How many others are missing, too.
fn others(more: usize) -> String {
    if more == 0 { String::new() } else { format!("; {more} more are missing") }
}

/// One line per failure, then the remaining work and the remedy.
fn failed(failures: &[SimulateError], finished: usize, scenes: u32) -> String {
    let mut message: String = failures.iter().map(|failure| format!("{failure}\n")).collect();
    message += &format!("{finished} of {scenes} scenes are finished and kept");
    if failures.iter().any(SimulateError::is_full_disk) {
        message += "; the disk is full: free some space, then run the same command again to resume";
    } else if !failures.iter().all(SimulateError::is_of_the_scene) {
        message += "; run the same command again to resume";
    }
    message
}
