//! `eddy train`: from bags to a checkpoint.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail};
use eddy_cli::{
    Interrupt, Output, OutputKind, TerminalProgress, keep_freed_memory, on_disk, progress_bar,
    terminal,
};
use eddy_dataset::{Dataset, LoadOptions, Trajectory, available_memory};
use eddy_evaluation::skill_text;
use eddy_frames::clock::Clock;
use eddy_inference::checkpoint::{Checkpoint, Description};
use eddy_learning::{
    model::{Architecture, DeviceKind, GpuOptions},
    train::{
        Epoch, LAST_FOLDER, Machine, Outcome, Run, TrainConfig, TrainError, check_output,
        data_warnings, test_skill, train,
    },
};
use eddy_pages::{Table, command_line};
use eddy_settings::{Overrides, ensure_usage, usage::Usage};
use indicatif::{HumanBytes, HumanCount, ProgressDrawTarget};

use super::{counted, streams};
use crate::cli::{DEFAULT_HORIZON, TrainArgs};

/// Bytes of a GiB.
const GIB: f64 = (1u64 << 30) as f64;

/// Delay before a progress bar for loading (s).
const BAR_DELAY: f64 = 2.0;

/// Trains a network on the bags at `args.data` and writes the best checkpoint to `args.output`; with several seeds, one
/// run per seed in a directory there.
pub fn run(args: TrainArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    keep_freed_memory();
    let start = args.from.as_deref().map(Checkpoint::load).transpose()?;
    let config = settings(&args, start.as_ref())?;
    on_disk(&args.output)?;
    let runs = runs(&args, &config)?;
    let replaced = outputs(&args, &runs)?;
    let device = device(&args, &config)?;
    let dataset = load(&args, quiet)?;
    let warnings = data_warnings(&config, &dataset, start.as_ref());
    warnings.iter().for_each(|warning| tracing::warn!("{warning}"));
    if !quiet {
        introduce(&config, &dataset);
    }
    let progress = TerminalProgress::new(quiet, interrupt);
    // Measured once for all runs: memory that one frees stays with this process.
    let memory = available_memory();
    let mut outcomes = Vec::new();
    let mut ended = Ok(());
    for (config, output) in &runs {
        let run = Run {
            device,
            gpu: GpuOptions { count: args.gpus, precision: args.precision },
            output,
            start: start.as_ref(),
            resume: args.resume,
            machine: Machine::with_free_disk(memory, output)?,
            command: recorded_command(std::env::args()),
            progress: &progress,
            on_epoch: &|_| (),
        };
        match train_seed(&args, quiet, config, &dataset, &run) {
            Ok(outcome) => outcomes.push((config.seed, outcome)),
            Err(error) => ended = Err(error),
        }
        if ended.is_err() || outcomes.last().is_some_and(|(_, outcome)| outcome.interrupted) {
            break;
        }
    }
    if outcomes.len() > 1 {
        let table = comparison(&outcomes, config.validation.horizon);
        println!("{}", table.framed(terminal::columns()));
    }
    ended?;
    replaced.into_iter().for_each(Output::replaced);
    Ok(())
}

/// Makes room for the output of each run; with `--force`, returns those that are replaced.
fn outputs(args: &TrainArgs, runs: &[(TrainConfig, PathBuf)]) -> anyhow::Result<Vec<Output>> {
    let mut replaced = Vec::new();
    for (_, output) in runs {
        match check_output(output, args.resume) {
            Err(TrainError::Exists { .. }) if args.force => {
                replaced.push(Output::at(output, OutputKind::Checkpoint, true, &args.data)?);
            }
            outcome => outcome?,
        }
    }
    Ok(replaced)
}

/// The device, which is there.
fn device(args: &TrainArgs, config: &TrainConfig) -> anyhow::Result<DeviceKind> {
    let device = args.device.resolve(config.runs_on_gpus());
    device.check()?;
    ensure_usage!(
        args.gpus.get() == 1 || device.is_cuda(),
        "--gpus: found {} with --device {}, expected --device cuda",
        args.gpus,
        device.name()
    );
    Ok(device)
}

/// The run of a seed, with its result on the terminal.
fn train_seed(
    args: &TrainArgs,
    quiet: bool,
    config: &TrainConfig,
    dataset: &Dataset,
    run: &Run,
) -> anyhow::Result<Outcome> {
    let several = args.seed.len() > 1;
    if !quiet && several {
        println!("seed {}", config.seed);
    }
    let outcome = train(config, dataset, run);
    let outcome = match several {
        true => outcome.with_context(|| format!("seed {}", config.seed))?,
        false => outcome?,
    };
    if !quiet {
        summarize(args, config, dataset, run.output, &outcome)?;
    }
    if outcome.best.is_none() {
        bail!(
            "{}: interrupted before the first epoch ended: nothing is saved, and the same command starts again",
            run.output.display()
        );
    }
    Ok(outcome)
}

/// The command line as checkpoints record it: without the path of the program and without the words that say where the checkpoint goes.
/// The digest of a checkpoint covers it, and the same training has the same digest wherever it is written to.
fn recorded_command(arguments: impl Iterator<Item = String>) -> String {
    let mut arguments = arguments.skip(1);
    let mut recorded = vec!["eddy".to_owned()];
    while let Some(argument) = arguments.next() {
        let is_short = argument.starts_with("-o") && !argument.starts_with("--");
        match argument.as_str() {
            "--output" | "-o" => _ = arguments.next(),
            "--force" | "--resume" | "--quiet" | "-q" => {}
            _ if is_short || argument.starts_with("--output=") => {}
            _ => recorded.push(argument),
        }
    }
    recorded.join(" ")
}

/// The defaults of the recipe, or of the checkpoint to start from; then the file, then the command line.
fn settings(args: &TrainArgs, start: Option<&Checkpoint>) -> anyhow::Result<TrainConfig> {
    let overrides = match &args.config {
        None => Overrides::default(),
        Some(file) => Overrides::read(file)?,
    };
    let architecture: Option<Architecture> = match args.architecture {
        Some(architecture) => Some(architecture),
        None => overrides.get("architecture")?,
    };
    let start = start.map(|checkpoint| &checkpoint.description);
    let defaults = args.recipe.defaults(architecture, start);
    let defaults = defaults.map_err(|error| Usage::new(format_args!("--{error}")))?;
    let mut config = overrides.over(&defaults)?;
    config.architecture = args.architecture.unwrap_or(config.architecture);
    config.core = args.core.unwrap_or(config.core);
    config.epochs = args.epochs.unwrap_or(config.epochs);
    config.seed = args.seed.first().copied().unwrap_or(config.seed);
    match &args.config {
        Some(file) => config.check().with_context(|| file.display().to_string())?,
        None => config.check().map_err(on_command_line)?,
    }
    if let (Some(start), Some(folder)) = (start, &args.from) {
        config.check_start(start).with_context(|| folder.display().to_string())?;
    }
    Ok(config)
}

fn on_command_line(error: impl std::fmt::Display) -> Usage {
    Usage::new(format_args!("command line: {error}"))
}

/// Settings and output of each run: one for each seed.
fn runs(args: &TrainArgs, config: &TrainConfig) -> anyhow::Result<Vec<(TrainConfig, PathBuf)>> {
    let [_, others @ ..] = args.seed.as_slice() else {
        return Ok(vec![(config.clone(), args.output.clone())]);
    };
    if others.is_empty() {
        return Ok(vec![(config.clone(), args.output.clone())]);
    }
    let mut runs = Vec::new();
    for (number, &seed) in args.seed.iter().enumerate() {
        ensure_usage!(
            !args.seed[..number].contains(&seed),
            "--seed: found {seed} twice, expected different seeds"
        );
        let config = TrainConfig { seed, ..config.clone() };
        config.check().map_err(on_command_line)?;
        runs.push((config, args.output.join(format!("seed-{seed}"))));
    }
    Ok(runs)
}

/// Reads the bags, with a progress bar if it takes long.
fn load(args: &TrainArgs, quiet: bool) -> anyhow::Result<Dataset> {
    let memory = match args.memory {
        None => available_memory() / 2,
        Some(gib) => {
            ensure_usage!(
                gib.is_finite() && gib > 0.0,
                "--memory: found {gib}, expected a positive number of GiB"
            );
            (gib * GIB) as u64
        }
    };
    let bar = progress_bar(0, "frames read", true);
    let clock = Clock::start();
    let mut hidden = !quiet;
    let options = LoadOptions { memory, skip_streams: args.skip_streams };
    let dataset = Dataset::load(&args.data, options, &mut |done, all| {
        if hidden && clock.now().as_secs_f64() > BAR_DELAY {
            bar.set_draw_target(ProgressDrawTarget::stderr());
            hidden = false;
        }
        bar.set_length(all);
        bar.set_position(done);
    });
    bar.finish_and_clear();
    let dataset = dataset.map_err(|error| streams::refused(error, args.skip_streams))?;
    let Dataset { train, validation, test, skipped, .. } = &dataset;
    streams::name_skipped(skipped, train.iter().chain(validation).chain(test));
    Ok(dataset)
}

fn introduce(config: &TrainConfig, dataset: &Dataset) {
    println!(
        "{} {}: {} for training, {} for validation, {} for testing",
        config.architecture.name(),
        config.core.name(),
        counted(dataset.train.len() as u64, "stream"),
        dataset.validation.len(),
        dataset.test.len(),
    );
    println!(
        "unroll: frames predicted freely in training; validation: 0 is perfect, 1 as good as the"
    );
    println!(
        "best trivial predictor; skill: validation part, frames 1 and {}",
        config.validation.horizon
    );
    if let Some(store) = dataset.frame_store() {
        println!("frames stay on disk, up to {} of them in memory", HumanBytes(store.limit()));
    }
}

/// The result of a run, where its files are, and the next commands.
fn summarize(
    args: &TrainArgs,
    config: &TrainConfig,
    dataset: &Dataset,
    output: &Path,
    outcome: &Outcome,
) -> anyhow::Result<()> {
    let Outcome { epochs, best, interrupted, seconds, samples } = outcome;
    let how = if *interrupted { "interrupted" } else { "done" };
    println!(
        "{how}: {}, {} samples in {seconds:.0} s ({:.0} samples/s, including validation)",
        counted(epochs.len() as u64, "epoch"),
        HumanCount(*samples),
        *samples as f64 / seconds.max(1e-9),
    );
    let (Some(checkpoint), Some(best)) = (best, best_of(epochs)) else { return Ok(()) };
    println!(
        "best: epoch {}, validation loss {:.4} (best trivial predictor: 1)",
        best.epoch, best.validation_loss
    );
    let horizon = config.validation.horizon;
    let streams = |part: &[Trajectory]| counted(part.len() as u64, "stream");
    println!(
        "skill {} at frame 1, {} at frame {horizon}: validation ({})",
        skill_text(best.first_skill),
        skill_text(best.last_skill),
        streams(&dataset.validation),
    );
    let tested = if *interrupted { None } else { test_skill(checkpoint, dataset, horizon)? };
    if let Some((first, last)) = tested.as_ref().and_then(|skill| skill.first().zip(skill.last())) {
        println!(
            "skill {} at frame 1, {} at frame {horizon}: test ({}), as in `eddy eval`",
            skill_text(*first),
            skill_text(*last),
            streams(&dataset.test),
        );
    }
    let place = output.display();
    println!(
        "{place}: {} parameters, digest {}; last epoch in {LAST_FOLDER}/",
        HumanCount(checkpoint.parameters() as u64),
        checkpoint.short_digest(),
    );
    let curves = ["tensorboard", "--logdir", &place.to_string()].map(str::to_owned);
    println!("curves:   {}", command_line(&curves));
    if *interrupted {
        println!("resume:   the same command with --resume");
    }
    match horizon_of_test(checkpoint, dataset)? {
        Some(horizon) => println!("evaluate: {}", evaluation(args, output, &args.data, horizon)),
        None => println!(
            "evaluate: on other streams, as none of these is left for a test: {}",
            evaluation(args, output, &["BAGS".into()], DEFAULT_HORIZON)
        ),
    }
    Ok(())
}

/// The number of frames ahead, at most the default of `eddy eval`, that the test part allows; `None` if it has no stream that the
/// checkpoint has not seen.
fn horizon_of_test(checkpoint: &Checkpoint, dataset: &Dataset) -> anyhow::Result<Option<usize>> {
    let Description { training, warm_up, .. } = &checkpoint.description;
    let mut longest = 0;
    for stream in &dataset.test {
        let fingerprint = stream.fingerprint()?;
        if !training.seen.iter().any(|seen| *seen == fingerprint) {
            longest = longest.max(stream.frames);
        }
    }
    let left = longest.saturating_sub(*warm_up as usize);
    Ok((left > 0).then_some(left.min(DEFAULT_HORIZON)))
}

/// A command line that evaluates the checkpoint at `output`, into a folder that does not exist yet.
fn evaluation(args: &TrainArgs, output: &Path, data: &[PathBuf], horizon: usize) -> String {
    let name = output.file_name().unwrap_or_default().display();
    let reports = (1..).map(|number| match number {
        1 => format!("reports/{name}"),
        _ => format!("reports/{name}-{number}"),
    });
    let report = reports.into_iter().find(|report| !Path::new(report).exists());
    let mut words = ["eddy", "eval", "--checkpoint"].map(str::to_owned).to_vec();
    words.extend([output.display().to_string(), "--data".to_owned()]);
    words.extend(data.iter().map(|path| path.display().to_string()));
    if args.skip_streams {
        words.push("--skip-streams".to_owned());
    }
    if horizon < DEFAULT_HORIZON {
        words.extend(["--horizon".to_owned(), horizon.to_string()]);
    }
    words.extend(["--output".to_owned(), report.unwrap_or_default()]);
    command_line(&words)
}

/// The epoch with the lowest validation loss.
fn best_of(epochs: &[Epoch]) -> Option<&Epoch> {
    epochs.iter().rfind(|epoch| epoch.best)
}

/// A table of the runs of several seeds.
fn comparison(outcomes: &[(u64, Outcome)], horizon: usize) -> Table {
    let last = format!("skill at {horizon}");
    let titles = ["seed", "best epoch", "validation loss", "skill at 1", &last];
    let mut table = Table::new("validation part, by seed", titles);
    let best: Vec<_> = outcomes
        .iter()
        .filter_map(|(seed, outcome)| Some((seed, best_of(&outcome.epochs)?)))
        .collect();
    let numbers = |epoch: &Epoch| [epoch.validation_loss, epoch.first_skill, epoch.last_skill];
    let cells = |epoch: String, [loss, first, last]: [f64; 3]| {
        [epoch, format!("{loss:.4}"), format!("{first:+.4}"), format!("{last:+.4}")]
    };
    for (seed, epoch) in &best {
        table.row(seed.to_string(), cells(epoch.epoch.to_string(), numbers(epoch)));
    }
    let column = |index: usize| best.iter().map(move |(_, epoch)| numbers(epoch)[index]);
    let mean = |index| column(index).sum::<f64>() / best.len() as f64;
    let deviation = |index| {
        let mean = mean(index);
        let squares: f64 = column(index).map(|x| (x - mean) * (x - mean)).sum();
        (squares / (best.len() as f64 - 1.0)).sqrt()
    };
    let each = [0, 1, 2];
    let extreme = |index| match index {
        0 => column(0).fold(f64::INFINITY, f64::min),
        _ => column(index).fold(f64::NEG_INFINITY, f64::max),
    };
    table.row("mean", cells(String::new(), each.map(mean)));
    table.row("standard deviation", cells(String::new(), each.map(deviation)));
    table.row("best of each", cells(String::new(), each.map(extreme)));
    table
}

#[cfg(test)]
mod tests {
    use super::recorded_command;

    #[test]
    fn the_recorded_command_does_not_say_where_the_checkpoint_went() {
        let recorded = |line: &str| recorded_command(line.split(' ').map(str::to_owned));
        let expected = "eddy train --data bags/a bags/b --epochs 3";
        for line in [
            "eddy train --data bags/a bags/b --output checkpoints/one --epochs 3",
            "/usr/bin/eddy train --data bags/a bags/b --epochs 3 --output=elsewhere --force",
            "target/release/eddy -q train -o elsewhere --data bags/a bags/b --epochs 3 --resume",
            "eddy train -oelsewhere --data bags/a bags/b --epochs 3",
        ] {
            assert_eq!(recorded(line), expected, "{line}");
        }
    }
}
