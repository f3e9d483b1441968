//! Result files of the parts of a study.

use std::{
    fs, io,
    path::{Path, PathBuf},
};

use serde::{Deserialize, Serialize, de::DeserializeOwned};

use crate::{
    bench::training::Timing,
    dense::{DenseConfig, DenseCurve},
};
use eddy_inference::checkpoint::Activation;
use eddy_learning::{
    model::DeviceKind,
    train::{Epoch, TrainConfig},
};
use eddy_pages::Machine;
use eddy_settings::atomic;

/// A trained network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Trained {
    /// Digest of the checkpoint.
    pub checkpoint: String,
    /// Number of parameters.
    pub parameters: usize,
    /// Training time, including validation (s).
    pub seconds: f64,
    /// Number of networks trained in parallel.
    pub at_once: usize,
    /// Windows seen.
    pub samples: u64,
    /// Device.
    #[serde(default)]
    pub device: DeviceKind,
    /// Precision of products on an NVIDIA GPU, otherwise empty.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub precision: String,
    /// Training settings.
    pub config: TrainConfig,
    /// All epochs.
    pub epochs: Vec<Epoch>,
    /// Time from the start of the training to the end of each epoch (s); empty if the training was resumed.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub epoch_ends: Vec<f64>,
    /// Losses of the best checkpoint in free rollouts.
    pub losses: Losses,
}

/// Losses in free rollouts, as that of the validation: 1 - skill, averaged over frames ahead and kinds of scenes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Losses {
    /// On as many training scenes as there are for validation.
    pub seen: f64,
    /// Of the linear fit to the training scenes, on the validation scenes; absent if the data determine none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub linear_fit: Option<f64>,
}

/// The learning curve of a dense network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Curve {
    /// Activation of its layers.
    pub activation: Activation,
    /// Seed of its weights and of the order of the data.
    pub seed: u64,
    /// Device.
    #[serde(default)]
    pub device: DeviceKind,
    /// Precision of products on an NVIDIA GPU, otherwise empty.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub precision: String,
    /// Training settings.
    pub config: DenseConfig,
    /// Losses by epoch.
    pub curve: DenseCurve,
}

/// Why a result file cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ResultError {
    /// The file cannot be read or written.
    #[error("{}: {reason}", file.display())]
    File {
        /// The file.
        file: PathBuf,
        /// The cause.
        reason: io::Error,
    },
    /// The file is not a result.
    #[error("{}: found {reason}, expected the result of a training", file.display())]
    Damaged {
        /// The file.
        file: PathBuf,
        /// The syntax error with its position.
        reason: String,
    },
    /// The file belongs to another study.
    #[error(
        "{}: result of a training with other settings, on another device or of another precision; choose another --output",
        file.display()
    )]
    Other {
        /// The file.
        file: PathBuf,
    },
}

const TRAINED_FILE: &str = "trained.toml";

impl Trained {
    /// The file in the folder of a run that is written last.
    pub fn file(folder: &Path) -> PathBuf {
        folder.join(TRAINED_FILE)
    }

    /// The result in the folder of a run, if it has finished.
    ///
    /// # Errors
    /// [`ResultError`], also for a training with other settings, on another device or of another precision.
    pub fn find(
        folder: &Path,
        config: &TrainConfig,
        device: DeviceKind,
        precision: &str,
    ) -> Result<Option<Self>, ResultError> {
        find(Self::file(folder), |trained: &Self| {
            (&trained.config, trained.device, trained.precision.as_str())
                == (config, device, precision)
        })
    }

    /// Time until the validation loss was at most `loss` (s), if it was and the times are known.
    pub fn time_to(&self, loss: f64) -> Option<f64> {
        let mut ends = self.epochs.iter().zip(&self.epoch_ends);
        ends.find(|(epoch, _)| epoch.validation_loss <= loss).map(|(_, &end)| end)
    }

    /// The epoch of the checkpoint.
    pub fn best(&self) -> Option<&Epoch> {
        self.epochs.iter().rfind(|epoch| epoch.best)
    }

    /// Writes it to the folder of its run.
    ///
    /// # Errors
    /// [`ResultError::File`].
    pub fn save(&self, folder: &Path) -> Result<(), ResultError> {
        save(Self::file(folder), self)
    }
}

impl Curve {
    /// The curve in a file, if it has finished.
    ///
    /// # Errors
    /// [`ResultError`], also for a training with other settings, on another device or of another precision.
    pub fn find(
        file: &Path,
        config: &DenseConfig,
        device: DeviceKind,
        precision: &str,
    ) -> Result<Option<Self>, ResultError> {
        find(file.to_owned(), |curve: &Self| {
            (&curve.config, curve.device, curve.precision.as_str()) == (config, device, precision)
        })
    }

    /// Writes it to a file.
    ///
    /// # Errors
    /// [`ResultError::File`].
    pub fn save(&self, file: &Path) -> Result<(), ResultError> {
        save(file.to_owned(), self)
    }
}

/// Times of training steps.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Speed {
    /// The machine.
    pub machine: Machine,
    /// Device.
    #[serde(default)]
    pub device: DeviceKind,
    /// Precision of products on an NVIDIA GPU, otherwise empty.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub precision: String,
    /// Times by kind of step.
    pub steps: Vec<Timing>,
}

const SPEED_FILE: &str = "training_speed.toml";

impl Speed {
    /// The file in the folder of a comparison.
    pub fn file(folder: &Path) -> PathBuf {
        folder.join(SPEED_FILE)
    }

    /// The times in the folder of a comparison, if measured.
    ///
    /// # Errors
    /// [`ResultError`], also for times of another device, another precision or other windows.
    pub fn find(
        folder: &Path,
        device: DeviceKind,
        precision: &str,
        frames: &[usize],
    ) -> Result<Option<Self>, ResultError> {
        let is_ours = |speed: &Self| {
            let timed = |&frames: &usize| speed.steps.iter().any(|step| step.frames == frames);
            speed.device == device && speed.precision == precision && frames.iter().all(timed)
        };
        find(Self::file(folder), is_ours)
    }

    /// Writes them to the folder of a comparison.
    ///
    /// # Errors
    /// [`ResultError::File`].
    pub fn save(&self, folder: &Path) -> Result<(), ResultError> {
        save(Self::file(folder), self)
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

/// Writes a result atomically.
fn save(file: PathBuf, result: &impl Serialize) -> Result<(), ResultError> {
    let text = toml::to_string(result).expect("numbers, words and tables of them are all TOML");
    atomic::replace(&file, text.as_bytes()).map_err(|reason| ResultError::File { file, reason })
}
