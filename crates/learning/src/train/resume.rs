//! A run on disk, so that it can go on where it stopped, bit for bit.
//!
//! After every epoch the folder `last` in the output is replaced whole. It holds
//!
//! | file | content |
//! |---|---|
//! | `model.toml`, `model.safetensors` | the checkpoint of the last epoch |
//! | `resume.toml` | the settings, the random generators, every epoch so far, counters, checksums |
//! | `resume.safetensors` | Adam's moments, `first.NAME` and `second.NAME` for each tensor, its numbers in the order `[in, out]`; where the checkpoint holds averaged weights, the weights themselves, `weight.NAME`, as checkpoints have them |
//!
//! The new folder is written whole as `last.new`; then `last` becomes `last.old`, `last.new` becomes
//! `last`, and `last.old` goes. Whoever finds `last.old` without `last` finishes that.
//!
//! Everything that decides what comes next must be as it was: data, settings, device. Only `epochs` and
//! `patience` may be others. With other `epochs` the schedules of learning rate and unroll are from
//! then on those of the new number, as if it had been asked for from the start.

use std::{
    collections::BTreeMap,
    fs, io,
    path::{Path, PathBuf},
};

use super::{
    METRICS_FILE, Run, TrainConfig, TrainError,
    adam::Adam,
    moments::{checksum, moments_by_name, moments_by_number},
    record::{self, Generator, RECORD_VERSION, Record, damaged, same_run},
    state::State,
};
use crate::model::{
    layers::Layers,
    network::{Dropout, Network},
};
use eddy_inference::checkpoint::{self, Checkpoint, DESCRIPTION_FILE, Description, WEIGHTS_FILE};
use eddy_settings::atomic;

/// Name of the folder with the last epoch, within the output.
pub const LAST_FOLDER: &str = "last";
/// Name of the record of the run, within [`LAST_FOLDER`].
const RECORD_FILE: &str = "resume.toml";
/// What the name of a weight begins with there.
const WEIGHT: &str = "weight.";
/// Name of the file with Adam's moments, within [`LAST_FOLDER`].
const MOMENTS_FILE: &str = "resume.safetensors";

/// Refuses an output folder that nothing can be written to, or that holds a run when none is to go
/// on. Leaves it as it was.
///
/// # Errors
/// [`TrainError::Exists`], [`TrainError::File`].
pub fn check_output(output: &Path, resume: bool) -> Result<(), TrainError> {
    if !resume && let Some(found) = run_in(output) {
        return Err(TrainError::Exists { output: output.to_owned(), found });
    }
    let failed = |reason| TrainError::File { file: output.to_owned(), reason };
    let missing: Vec<_> = output
        .ancestors()
        .take_while(|folder| !folder.as_os_str().is_empty() && !folder.exists())
        .collect();
    fs::create_dir_all(output).map_err(failed)?;
    let probe = output.join(".eddy-was-here");
    let outcome = atomic::write_synced(&probe, b"whether anything can be written\n");
    // What cannot be taken away again does no harm.
    let _ = fs::remove_file(&probe);
    for folder in missing {
        let _ = fs::remove_dir(folder);
    }
    outcome.map_err(failed)
}

/// What of a run is in a folder.
fn run_in(output: &Path) -> Option<&'static str> {
    let rows = |text: String| text.lines().count() > 1;
    if output.join(LAST_FOLDER).exists() || folders(output)[2].exists() {
        Some("a run, its last epoch in last/")
    } else if output.join(DESCRIPTION_FILE).exists() || output.join(WEIGHTS_FILE).exists() {
        Some("a checkpoint")
    } else {
        let metrics = fs::read_to_string(output.join(METRICS_FILE)).ok();
        metrics.is_some_and(rows).then_some("metrics.csv with epochs")
    }
}

/// The run to go on with, or a new one. In a run that goes on unchanged, the description keeps the
/// command that began it.
pub(super) fn begin(
    config: &TrainConfig,
    description: &mut Description,
    run: &Run,
) -> Result<State, TrainError> {
    check_output(run.output, run.resume)?;
    if run.resume {
        settle(run.output)?;
        if run.output.join(LAST_FOLDER).exists() {
            return load(config, description, run);
        }
        if let Some(found) = run_in(run.output) {
            return Err(TrainError::OtherRun {
                file: run.output.join(LAST_FOLDER),
                field: "last epoch".to_owned(),
                found: format!("{found} but no such folder"),
                expected: "the folder".to_owned(),
            });
        }
    }
    Ok(State::new(config, description, run.device))
}

/// Replaces the last epoch on disk. `seconds` is the time spent so far, `last` the checkpoint.
pub(super) fn save(
    run: &Run,
    config: &TrainConfig,
    state: &State,
    last: &Checkpoint,
    seconds: f64,
) -> Result<(), TrainError> {
    let mut moments = moments_by_name(&state.adam, &last.description);
    if config.optimizer.average > 0.0 {
        let weights = state.network.layers().tensors(&last.description).into_iter();
        moments.extend(weights.map(|(name, weights)| (format!("{WEIGHT}{name}"), weights)));
    }
    let record = Record {
        format_version: RECORD_VERSION,
        data: last.description.data.clone(),
        device: run.device.name().to_owned(),
        weights: checksum(&last.tensors),
        moments: checksum(&moments),
        steps: state.adam.steps,
        samples: state.samples,
        since_best: state.since_best,
        unroll: state.unroll,
        seconds,
        common: state.common.clone(),
        order: Generator::of(&state.order),
        dropout: state.dropout.random().map(Generator::of),
        config: config.clone(),
        epochs: state.epochs.clone(),
    };
    let [folder, new, old] = folders(run.output);
    remove(&new)?;
    last.save(&new)?;
    let write = |name: &str, bytes: &[u8]| {
        let file = new.join(name);
        atomic::write_synced(&file, bytes).map_err(|reason| TrainError::File { file, reason })
    };
    write(MOMENTS_FILE, &checkpoint::render_weights(&moments))?;
    write(RECORD_FILE, record.render().as_bytes())?;
    if folder.exists() {
        remove(&old)?;
        rename(&folder, &old)?;
    }
    rename(&new, &folder)?;
    remove(&old)
}

/// `last`, `last.new`, `last.old`.
fn folders(output: &Path) -> [PathBuf; 3] {
    ["", ".new", ".old"].map(|end| output.join(format!("{LAST_FOLDER}{end}")))
}

/// Finishes a replacement that was cut short between its two renames.
fn settle(output: &Path) -> Result<(), TrainError> {
    let [folder, new, old] = folders(output);
    if !folder.exists() && old.exists() {
        rename(if new.exists() { &new } else { &old }, &folder)?;
    }
    Ok(())
}

fn rename(from: &Path, to: &Path) -> Result<(), TrainError> {
    atomic::rename(from, to).map_err(|reason| TrainError::File { file: from.to_owned(), reason })
}

fn remove(folder: &Path) -> Result<(), TrainError> {
    match fs::remove_dir_all(folder) {
        Err(reason) if reason.kind() != io::ErrorKind::NotFound => {
            Err(TrainError::File { file: folder.to_owned(), reason })
        }
        _ => Ok(()),
    }
}

/// The checkpoint with the smallest validation loss. A process that ended between its two writes has left
/// it in [`LAST_FOLDER`] only; then it is put where it belongs.
fn best(output: &Path, record: &Record, last: &Checkpoint) -> Result<Checkpoint, TrainError> {
    let newest = record.epochs.last().filter(|epoch| epoch.best);
    let none = ![DESCRIPTION_FILE, WEIGHTS_FILE].iter().any(|file| output.join(file).exists());
    if newest.is_some() && none {
        last.save(output)?;
    }
    let best = Checkpoint::load(output)?;
    match newest {
        Some(epoch) if best.description.training.best_epoch != epoch.epoch => {
            last.save(output)?;
            Ok(last.clone())
        }
        _ => Ok(best),
    }
}

fn load(
    config: &TrainConfig,
    description: &mut Description,
    run: &Run,
) -> Result<State, TrainError> {
    let folder = run.output.join(LAST_FOLDER);
    let file = folder.join(RECORD_FILE);
    let record = record::read(&file)?;
    same_run(&file, config, description, run, &record)?;
    let last = Checkpoint::load(&folder)?;
    let moments_file = folder.join(MOMENTS_FILE);
    let bytes = fs::read(&moments_file)
        .map_err(|reason| TrainError::File { file: moments_file.clone(), reason })?;
    let moments = checkpoint::parse_weights(&moments_file, &bytes)?;
    for (file, tensors, expected) in [
        (folder.join(WEIGHTS_FILE), &last.tensors, &record.weights),
        (moments_file.clone(), &moments, &record.moments),
    ] {
        let found = checksum(tensors);
        if found != *expected {
            return Err(damaged(&file, "checksum", found, expected));
        }
    }
    let mut weights = BTreeMap::new();
    let mut named = BTreeMap::new();
    for (name, tensor) in moments {
        match name.strip_prefix(WEIGHT) {
            Some(name) => weights.insert(name.to_owned(), tensor),
            None => named.insert(name, tensor),
        };
    }
    let mut adam = Adam {
        steps: record.steps,
        moments: moments_by_number(&moments_file, named, description)?,
    };
    let device = run.device.device().autodiff();
    let network = if config.optimizer.average > 0.0 {
        let mut averaged = Layers::new(description, &last.tensors, &device);
        averaged.exchange(|tensor, values| adam.moments[tensor].average = values.to_vec());
        let weights = Checkpoint { description: last.description.clone(), tensors: weights };
        weights.check(&moments_file)?;
        Network::new(description, &weights.tensors, &device)
    } else {
        Network::new(description, &last.tensors, &device)
    };
    let best = best(run.output, &record, &last)?;
    let random = |field: &str, generator: &Generator| {
        generator.generator().ok_or_else(|| {
            damaged(&file, field, format!("{generator:?}"), "64 hexadecimal digits and a number")
        })
    };
    let dropout = match &record.dropout {
        Some(generator) => Dropout::new(config.network.dropout, random("dropout", generator)?),
        None if config.network.dropout > 0.0 => {
            return Err(damaged(&file, "dropout", "nothing", "a random generator"));
        }
        None => Dropout::none(),
    };
    if record.config == *config {
        description.training.command = last.description.training.command.clone();
    }
    Ok(State {
        network,
        adam,
        order: random("order", &record.order)?,
        dropout,
        unroll: record.unroll,
        common: record.common,
        samples: record.samples,
        epochs: record.epochs,
        best: Some(best),
        since_best: record.since_best,
        seconds: record.seconds,
    })
}
