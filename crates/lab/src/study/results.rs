//! What a part of a study came to, as a file that says which part it is.

use std::{
    fs, io,
    path::{Path, PathBuf},
};

use serde::{Deserialize, Serialize, de::DeserializeOwned};

use crate::bench::training::Timing;
use eddy_evaluation::page::Machine;
use eddy_inference::checkpoint::Activation;
use eddy_learning::{
    model::DeviceKind,
    train::{
        Epoch, TrainConfig,
        dense::{DenseConfig, DenseCurve},
    },
};
use eddy_settings::atomic;

/// A network that was trained to its end.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Trained {
    /// Digest of the checkpoint.
    pub checkpoint: String,
    /// Numbers that were learned.
    pub parameters: usize,
    /// Time of the training, validation included (s).
    pub seconds: f64,
    /// Networks that were trained at the same time.
    pub at_once: usize,
    /// Windows seen.
    pub samples: u64,
    /// What computed.
    #[serde(default)]
    pub device: DeviceKind,
    /// How it was trained.
    pub config: TrainConfig,
    /// Every epoch.
    pub epochs: Vec<Epoch>,
}

/// The learning curve of a dense network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Curve {
    /// What is behind its layers.
    pub activation: Activation,
    /// Seed of its weights and of the order of the data.
    pub seed: u64,
    /// How it was trained.
    pub config: DenseConfig,
    /// What came out.
    pub curve: DenseCurve,
}

/// Why a result is of no use.
#[derive(Debug, thiserror::Error)]
pub enum ResultError {
    /// The file cannot be read or written.
    #[error("{}: {reason}", file.display())]
    File {
        /// The file.
        file: PathBuf,
        /// What the system said.
        reason: io::Error,
    },
    /// It is no result.
    #[error("{}: found {reason}, expected the result of a training", file.display())]
    Damaged {
        /// The file.
        file: PathBuf,
        /// Line and column, and what is wrong there.
        reason: String,
    },
    /// It is that of another study.
    #[error(
        "{}: found a training with other settings or on another device, expected those of this study: they go to another --output",
        file.display()
    )]
    Other {
        /// The file.
        file: PathBuf,
    },
}

/// The name of its file in the folder of a run.
const TRAINED_FILE: &str = "trained.toml";

impl Trained {
    /// The result in the folder of a run, if it came to its end.
    ///
    /// # Errors
    /// [`ResultError`], also where it is that of a training with other settings or on another device.
    pub fn find(
        folder: &Path,
        config: &TrainConfig,
        device: DeviceKind,
    ) -> Result<Option<Self>, ResultError> {
        find(folder.join(TRAINED_FILE), |trained: &Self| {
            trained.config == *config && trained.device == device
        })
    }

    /// The epoch that the checkpoint is from.
    pub fn best(&self) -> Option<&Epoch> {
        self.epochs.iter().rfind(|epoch| epoch.best)
    }

    /// Writes it to the folder of its run.
    ///
    /// # Errors
    /// [`ResultError::File`].
    pub fn save(&self, folder: &Path) -> Result<(), ResultError> {
        save(folder.join(TRAINED_FILE), self)
    }
}

impl Curve {
    /// The curve in a file, if it came to its end.
    ///
    /// # Errors
    /// [`ResultError`], also where it is that of a training with other settings.
    pub fn find(file: &Path, config: &DenseConfig) -> Result<Option<Self>, ResultError> {
        find(file.to_owned(), |curve: &Self| curve.config == *config)
    }

    /// Writes it to a file.
    ///
    /// # Errors
    /// [`ResultError::File`].
    pub fn save(&self, file: &Path) -> Result<(), ResultError> {
        save(file.to_owned(), self)
    }
}

/// How long training steps take.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Speed {
    /// On which machine.
    pub machine: Machine,
    /// What computed.
    #[serde(default)]
    pub device: DeviceKind,
    /// Every kind of step.
    pub steps: Vec<Timing>,
}

/// The name of its file in the folder of a comparison.
const SPEED_FILE: &str = "training_speed.toml";

impl Speed {
    /// The times in the folder of a comparison, if they were taken.
    ///
    /// # Errors
    /// [`ResultError`], also where they are those of another device.
    pub fn find(folder: &Path, device: DeviceKind) -> Result<Option<Self>, ResultError> {
        find(folder.join(SPEED_FILE), |speed: &Self| speed.device == device)
    }

    /// Writes them there.
    ///
    /// # Errors
    /// [`ResultError::File`].
    pub fn save(&self, folder: &Path) -> Result<(), ResultError> {
        save(folder.join(SPEED_FILE), self)
    }
}

fn find<T: DeserializeOwned>(
    file: PathBuf,
    is_ours: impl Fn(&T) -> bool,
) -> Result<Option<T>, ResultError> {
    let text = match fs::read_to_string(&file) {
        Ok(text) => text,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(reason) => return Err(ResultError::File { file, reason }),
    };
    match toml::from_str(&text) {
        Ok(result) if is_ours(&result) => Ok(Some(result)),
        Ok(_) => Err(ResultError::Other { file }),
        Err(error) => {
            let reason = error.to_string().trim_end().replace('\n', " ");
            Err(ResultError::Damaged { file, reason })
        }
    }
}

/// Whole or not at all.
fn save(file: PathBuf, result: &impl Serialize) -> Result<(), ResultError> {
    let text = toml::to_string(result).expect("numbers, words and tables of them are all TOML");
    atomic::replace(&file, text.as_bytes()).map_err(|reason| ResultError::File { file, reason })
}
