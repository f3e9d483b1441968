//! Trains every network with every seed.

use std::{
    collections::VecDeque,
    fs,
    path::{Path, PathBuf},
    sync::{Mutex, PoisonError},
};

use anyhow::{Context, bail};

use super::{
    Losses, Trained, Variant,
    run::{Work, load, write_settings},
};
use eddy_dataset::{Dataset, available_memory};
use eddy_frames::{clock::Clock, progress::Progress};
use eddy_inference::{checkpoint::Description, engine::Surrogate};
use eddy_learning::{
    model::DeviceKind,
    train::{Epoch, LAST_FOLDER, Machine, Run, TrainConfig, linear_fit_loss, rollout_loss, train},
};
use eddy_pages::command_line;

/// A network with one seed.
struct Task {
    /// Its name in messages.
    name: String,
    config: TrainConfig,
    device: DeviceKind,
    output: PathBuf,
    /// The equivalent command.
    command: String,
}

/// Trains the missing networks.
pub(super) fn run(work: &Work) -> anyhow::Result<()> {
    for set in &work.data_sets {
        let set = set.name.as_str();
        let mut tasks = VecDeque::new();
        for (number, (variant, seed)) in work.runs().enumerate() {
            tasks.extend(Task::missing(work, set, variant, seed, work.device_of(number))?);
        }
        if tasks.is_empty() {
            continue;
        }
        let dataset = work.load_data(set)?;
        let at_once = work.jobs.min(tasks.len());
        let memory = available_memory() / at_once as u64;
        work.each(tasks, "networks", |task| task.run(work, &dataset, memory, at_once))?;
        if work.stops() {
            break;
        }
    }
    Ok(())
}

/// Trains a network, unless it is trained. Returns a message; `None` if it was stopped.
pub(super) fn run_one(
    work: &Work,
    set: &str,
    variant: &Variant,
    seed: u64,
) -> anyhow::Result<Option<String>> {
    match Task::missing(work, set, variant, seed, work.device)? {
        Some(task) => task.run(work, &work.load_data(set)?, available_memory(), 1),
        None => Ok(Some("is already trained".to_owned())),
    }
}

/// The losses of a checkpoint on training scenes, and of the linear fit on those for validation.
fn losses(
    config: &TrainConfig,
    dataset: &Dataset,
    description: &Description,
    model: &Surrogate,
) -> anyhow::Result<Losses> {
    let (validation, train) = (&dataset.validation, &dataset.train);
    // Consecutive ones, as those for validation: kinds of scenes come in turn.
    let seen = &train[..validation.len().min(train.len())];
    Ok(Losses {
        seen: rollout_loss(model, &config.validation, seen)?,
        linear_fit: linear_fit_loss(description, &config.validation, validation)?,
    })
}

/// Trains without output, as several networks are trained at once.
struct StopSignal<'a>(&'a Work<'a>);

impl Progress for StopSignal<'_> {
    fn cancelled(&self) -> bool {
        self.0.stops()
    }
}

impl Task {
    /// A network that is not trained yet.
    fn missing(
        work: &Work,
        set: &str,
        variant: &Variant,
        seed: u64,
        device: DeviceKind,
    ) -> anyhow::Result<Option<Self>> {
        let config = TrainConfig { seed, ..variant.config.clone() };
        let output = work.folders.run(set, &variant.name, seed);
        if Trained::find(&output, &config, work.device, work.gpu_precision())?.is_some() {
            // Left by a process that was killed after the result was saved.
            return remove_last(&output).map(|()| None);
        }
        let name = format!("{set} {} seed {seed}", variant.name);
        let command = command_line(&work.command_lines().training(set, variant, seed));
        Ok(Some(Self { name, config, device, output, command }))
    }

    /// Trains the network and returns a message; `None` if it was stopped.
    fn run(
        &self,
        work: &Work,
        dataset: &Dataset,
        memory: u64,
        at_once: usize,
    ) -> anyhow::Result<Option<String>> {
        let Self { name, config, device, output, command } = self;
        // Beside the folder, which `train` creates.
        write_settings(&output.with_extension("toml"), &toml::to_string(config)?)?;
        let clock = Clock::start();
        let ends = Mutex::new(Vec::new());
        let note = |_: &Epoch| {
            let mut ends = ends.lock().unwrap_or_else(PoisonError::into_inner);
            ends.push(clock.now().as_secs_f64());
        };
        let run = Run {
            device: *device,
            gpu: work.gpu(),
            output,
            start: None,
            resume: true,
            machine: Machine::with_free_disk(memory, output)?,
            command: command.clone(),
            progress: &StopSignal(work),
            on_epoch: &note,
        };
        let outcome = train(config, dataset, &run).with_context(|| name.clone())?;
        if outcome.interrupted {
            return Ok(None);
        }
        let Some(best) = outcome.best else { bail!("{name}: training finished without an epoch") };
        let mut epoch_ends = ends.into_inner().unwrap_or_else(PoisonError::into_inner);
        if epoch_ends.len() < outcome.epochs.len() {
            epoch_ends.clear(); // resumed
        }
        let trained = Trained {
            epoch_ends,
            checkpoint: best.digest().to_owned(),
            parameters: best.parameters(),
            seconds: outcome.seconds,
            at_once,
            samples: outcome.samples,
            device: work.device,
            precision: work.gpu_precision().to_owned(),
            config: config.clone(),
            epochs: outcome.epochs,
            losses: losses(config, dataset, &best.description, &load(&best, *device)?)?,
        };
        trained.save(output)?;
        remove_last(output)?;
        let best = &best.description.training;
        Ok(Some(format!(
            "{name}: {} epochs in {:.0} s, best epoch {} with validation loss {:.3}",
            best.epochs, trained.seconds, best.best_epoch, best.validation_loss
        )))
    }
}

/// Removes the state for resuming: it is three times as large as the network and no longer needed.
fn remove_last(output: &Path) -> anyhow::Result<()> {
    let last = output.join(LAST_FOLDER);
    if !last.exists() {
        return Ok(());
    }
    fs::remove_dir_all(&last).with_context(|| last.display().to_string())
}
