//! `train`: from bags to a checkpoint.

use std::{path::PathBuf, sync::Mutex};

use eddy_dataset::{Dataset, LoadOptions, available_memory};
use eddy_inference::checkpoint::Checkpoint;
use eddy_learning::{
    model::{Architecture, DeviceKind, GpuOptions, Precision},
    train::{self, Epoch, Machine, Recipe, Run, TrainConfig},
};
use eddy_settings::Overrides;
use pyo3::{
    prelude::*,
    types::{PyDict, PyString},
};

use crate::{
    errors::{TrainError, raise},
    interrupt, lock,
    values::{self, Paths},
};

/// Trains a network on the bags at `data` and writes the best checkpoint to `output`. `config` is a dictionary or a file with the
/// keys of `eddy train --config`; what it leaves out has the defaults of its `architecture`, or, with the `recipe` "paper", those of the
/// paper's training. `start` is the folder of a checkpoint whose weights the run starts from, as with `eddy train --from`.
/// `callback` is called after each epoch with a dictionary (`epoch`, `samples`, `training_loss`, `validation_loss`, `first_skill`, `last_skill`, ..); an exception of
/// it ends the run, as Ctrl-C does, after the last whole epoch was saved. `skip_streams` leaves out streams with a frame that cannot be
/// used, each with a warning, instead of raising. Returns a dictionary with `epochs` (a list
/// of these), `seconds`, `samples` and `digest` (of the best checkpoint).
#[pyfunction(name = "train")]
#[pyo3(signature = (data, output, config=None, *, start=None, recipe="default", device="auto", precision="tf32", resume=false, callback=None, skip_streams=false))]
#[expect(clippy::too_many_arguments, reason = "the options of a run")]
pub(crate) fn train_network<'py>(
    py: Python<'py>,
    data: Paths,
    output: PathBuf,
    config: Option<&Bound<'py, PyAny>>,
    start: Option<PathBuf>,
    recipe: &str,
    device: &str,
    precision: &str,
    resume: bool,
    callback: Option<Bound<'py, PyAny>>,
    skip_streams: bool,
) -> PyResult<Bound<'py, PyDict>> {
    let start =
        start.map(|folder| Checkpoint::load(&folder)).transpose().map_err(raise::<TrainError>)?;
    let config = settings(config, values::word("recipe", recipe)?, start.as_ref())?;
    let device: DeviceKind = values::word("device", device)?;
    let device = device.resolve(config.runs_on_gpus());
    let precision: Precision = values::word("precision", precision)?;
    let data: Vec<PathBuf> = data.into();
    let skipped = Mutex::new(Vec::new());
    let work = |watch: &interrupt::Watch<Epoch>| -> Result<train::Outcome, String> {
        let text = |error: &dyn std::fmt::Display| error.to_string();
        device.check().map_err(|error| text(&error))?;
        train::check_output(&output, resume).map_err(|error| text(&error))?;
        let options = LoadOptions { memory: available_memory() / 2, skip_streams };
        let dataset = Dataset::load(&data, options, &mut |_, _| ());
        let dataset = dataset.map_err(|error| values::refused(&error, skip_streams))?;
        lock(&skipped).clone_from(&dataset.skipped);
        let machine = Machine::with_free_disk(available_memory(), &output);
        let run = Run {
            device,
            gpu: GpuOptions { precision, ..GpuOptions::default() },
            output: &output,
            start: start.as_ref(),
            resume,
            machine: machine.map_err(|error| text(&error))?,
            command: "eddy.train".to_owned(),
            progress: watch,
            on_epoch: &|epoch| watch.report(*epoch),
        };
        train::train(&config, &dataset, &run).map_err(|error| text(&error))
    };
    let on_epoch = |py: Python<'_>, epoch: Epoch| match &callback {
        None => Ok(()),
        Some(callback) => callback.call1((values::render(py, &epoch)?,)).map(drop),
    };
    let outcome = interrupt::run(py, on_epoch, work)?;
    values::warn_of_skipped(py, &lock(&skipped))?;
    let outcome = outcome.map_err(raise::<TrainError>)?;
    let result = PyDict::new(py);
    result.set_item("epochs", values::render(py, &outcome.epochs)?)?;
    result.set_item("seconds", outcome.seconds)?;
    result.set_item("samples", outcome.samples)?;
    result.set_item("digest", outcome.best.map(|checkpoint| checkpoint.digest()))?;
    Ok(result)
}

/// The defaults of the recipe, or of the checkpoint to start from, overridden by a file or a dictionary.
fn settings(
    config: Option<&Bound<'_, PyAny>>,
    recipe: Recipe,
    start: Option<&Checkpoint>,
) -> PyResult<TrainConfig> {
    let overrides = match config {
        None => Overrides::default(),
        Some(config) if config.is_instance_of::<PyDict>() => {
            let table: toml::Table = values::parse("config", config)?;
            Overrides::parse("config".as_ref(), &table.to_string()).map_err(raise::<TrainError>)?
        }
        Some(path) if path.is_instance_of::<PyString>() || path.hasattr("__fspath__")? => {
            let path: PathBuf = path.extract()?;
            Overrides::read(&path).map_err(raise::<TrainError>)?
        }
        Some(other) => {
            let found = other.get_type().name()?;
            return Err(pyo3::exceptions::PyTypeError::new_err(format!(
                "config: found {found}, expected a dictionary or the path of a TOML file"
            )));
        }
    };
    let architecture: Option<Architecture> =
        overrides.get("architecture").map_err(raise::<TrainError>)?;
    let start = start.map(|checkpoint| &checkpoint.description);
    let defaults = recipe.defaults(architecture, start).map_err(raise::<TrainError>)?;
    let config = overrides.over(&defaults).map_err(raise::<TrainError>)?;
    config.check().map_err(raise::<TrainError>)?;
    start.map_or(Ok(()), |start| config.check_start(start)).map_err(raise::<TrainError>)?;
    Ok(config)
}
