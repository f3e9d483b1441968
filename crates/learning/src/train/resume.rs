//! Saves a run so that it can be resumed bit for bit.
//!
//! After every epoch (on a GPU at most every ten seconds), the folder `last` in the output is replaced. It contains
//!
//! | file | content |
//! |---|---|
//! | `model.toml`, `model.safetensors` | the checkpoint of the last epoch, always with f32 weights |
//! | `resume.toml` | settings, random generators, all epochs, counters, checksums |
//! | `resume.safetensors` | the optimizer's moments, `first.NAME` and `second.NAME` for each tensor, `[in, out]`; if the checkpoint contains averaged weights, also the weights themselves, `weight.NAME`, in the layout of checkpoints |
//!
//! The new folder is written as `last.new`; then `last` is renamed to `last.old` and `last.new` to `last`, and `last.old` is
//! deleted. If only `last.old` is found, the replacement is completed.
//!
//! Data and settings must be unchanged, except `epochs` and `patience`. With another number of `epochs`, the schedules
//! of learning rate and unroll continue as if it had been chosen from the start.

use std::{
    collections::BTreeMap,
    fs, io,
    path::{Path, PathBuf},
};

use super::{
    METRICS_FILE, Run, TrainConfig, TrainError,
    moments::{checksum, moments_by_name, moments_in_order},
    optimizer::Optimizer,
    record::{self, GeneratorState, RECORD_VERSION, Record, damaged, same_run},
    state::{self, RunState},
};
use crate::model::dropout::Dropout;
use eddy_inference::checkpoint::{
    self, Checkpoint, DESCRIPTION_FILE, Description, WEIGHTS_FILE, WeightFormat,
};
use eddy_settings::atomic;

/// Name of the folder with the last epoch, within the output.
pub const LAST_FOLDER: &str = "last";
/// Name of the record, within [`LAST_FOLDER`].
const RECORD_FILE: &str = "resume.toml";
/// Prefix of the names of weights in [`MOMENTS_FILE`].
const WEIGHT: &str = "weight.";
/// Name of the file with the optimizer's moments, within [`LAST_FOLDER`].
const MOMENTS_FILE: &str = "resume.safetensors";

/// Rejects an output folder that cannot be written to, or that contains a run unless `resume`. The folder is left unchanged.
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
    let outcome = atomic::write_synced(&probe, b"write test\n");
    // A leftover does no harm.
    let _ = fs::remove_file(&probe);
    for folder in missing {
        let _ = fs::remove_dir(folder);
    }
    outcome.map_err(failed)
}

/// What a folder contains of a run.
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

/// The run to resume, or a new one. If a run is resumed with the same settings, the description keeps its original command.
pub(super) fn begin(
    config: &TrainConfig,
    description: &mut Description,
    run: &Run,
) -> Result<RunState, TrainError> {
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
    Ok(RunState::new(config, description, run.start))
}

/// Replaces the last epoch on disk. `seconds` is the training time, `last` the checkpoint.
pub(super) fn save(
    run: &Run,
    config: &TrainConfig,
    state: &RunState,
    last: &Checkpoint,
    seconds: f64,
) -> Result<(), TrainError> {
    let mut moments = moments_by_name(&state.optimizer, &last.description);
    if config.optimizer.average > 0.0 {
        let weights = state::by_name(&last.description, &state.weights).into_iter();
        moments.extend(weights.map(|(name, weights)| (format!("{WEIGHT}{name}"), weights)));
    }
    let record = Record {
        format_version: RECORD_VERSION,
        data: last.description.data.clone(),
        device: run.device_name(),
        start: last.description.training.start.clone(),
        weights: checksum(&last.tensors),
        moments: checksum(&moments),
        steps: state.optimizer.steps,
        samples: state.samples,
        since_best: state.since_best,
        unroll: state.unroll,
        seconds,
        common: state.common.clone(),
        order: GeneratorState::of(&state.order),
        dropout: state.dropout.random().map(GeneratorState::of),
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
    write(MOMENTS_FILE, &checkpoint::render_weights(&moments, WeightFormat::F32))?;
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

/// Completes a replacement that was interrupted between its two renames.
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

/// The checkpoint with the smallest validation loss. If a process ended before writing it to the output, it is made from
/// [`LAST_FOLDER`].
fn best(output: &Path, record: &Record, last: &Checkpoint) -> Result<Checkpoint, TrainError> {
    let published = || last.with_weights(record.config.network.weights);
    let newest = record.epochs.last().filter(|epoch| epoch.best);
    let none = ![DESCRIPTION_FILE, WEIGHTS_FILE].iter().any(|file| output.join(file).exists());
    if newest.is_some() && none {
        published().save(output)?;
    }
    let best = Checkpoint::load(output)?;
    match newest {
        Some(epoch) if best.description.training.best_epoch != epoch.epoch => {
            let best = published();
            best.save(output)?;
            Ok(best)
        }
        _ => Ok(best),
    }
}

fn load(
    config: &TrainConfig,
    description: &mut Description,
    run: &Run,
) -> Result<RunState, TrainError> {
    let folder = run.output.join(LAST_FOLDER);
    let file = folder.join(RECORD_FILE);
    let record = record::read(&file)?;
    same_run(&file, config, description, run, &record)?;
    let last = Checkpoint::load(&folder)?;
    let (weights, optimizer) = tensors(&folder, config, description, &record, &last)?;
    let best = best(run.output, &record, &last)?;
    let random = |field: &str, generator: &GeneratorState| {
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
    Ok(RunState {
        weights: weights.into(),
        optimizer,
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

/// The weights and the state of the optimizer, after their checksums are verified.
fn tensors(
    folder: &Path,
    config: &TrainConfig,
    description: &Description,
    record: &Record,
    last: &Checkpoint,
) -> Result<(Vec<Vec<f32>>, Optimizer), TrainError> {
    let file = folder.join(MOMENTS_FILE);
    let bytes =
        fs::read(&file).map_err(|reason| TrainError::File { file: file.clone(), reason })?;
    let moments = checkpoint::parse_weights(&file, &bytes, WeightFormat::F32)?;
    for (file, tensors, expected) in [
        (&folder.join(WEIGHTS_FILE), &last.tensors, &record.weights),
        (&file, &moments, &record.moments),
    ] {
        let found = checksum(tensors);
        if found != *expected {
            return Err(damaged(file, "checksum", found, expected));
        }
    }
    let (mut weights, mut named) = (BTreeMap::new(), BTreeMap::new());
    for (name, tensor) in moments {
        match name.strip_prefix(WEIGHT) {
            Some(name) => weights.insert(name.to_owned(), tensor),
            None => named.insert(name, tensor),
        };
    }
    let moments = moments_in_order(&file, named, description)?;
    let mut optimizer = Optimizer::new(config, description);
    (optimizer.steps, optimizer.moments) = (record.steps, moments);
    if config.optimizer.average == 0.0 {
        return Ok((state::in_order(description, &last.tensors), optimizer));
    }
    // The checkpoint contains the running average of the weights.
    let averages = state::in_order(description, &last.tensors);
    for (moments, average) in optimizer.moments.iter_mut().zip(averages) {
        moments.average = average;
    }
    let weights = Checkpoint::new(last.description.clone(), weights);
    weights.check(&file)?;
    Ok((state::in_order(description, &weights.tensors), optimizer))
}
