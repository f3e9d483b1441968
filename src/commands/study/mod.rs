//! `eddy study`: the paper's comparisons, from nothing to a report.
//!
//! 1. The scenes of every preset are simulated, as `eddy simulate` does.
//! 2. [`networks`]: what is compared is trained with every seed, some at a time, as `eddy train` does.
//!    [`curves`]: the same for the dense networks of the activations.
//! 3. The networks are judged on the scenes that nobody was trained on, as `eddy eval` does.
//! 4. [`speed`]: how long training steps take.
//! 5. [`report`]: all of it as a page and as Markdown.
//!
//! What has come to its end is not done again.

mod curves;
mod networks;
mod report;
mod speed;

use std::{
    collections::VecDeque,
    fs,
    path::Path,
    sync::{
        Mutex, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    thread,
};

use anyhow::{Context, bail, ensure};
use clap::Parser as _;

use super::{Interrupt, eval, progress_bar, simulate};
use crate::cli::{Cli, Command, StudyArgs};
use eddy::{
    config::Overrides,
    eval::Report,
    model::DeviceKind,
    page::command_line,
    study::{Comparison, Folders, StudyConfig, Trained, Variant},
    train::TrainConfig,
};

/// Runs a comparison.
pub fn run(args: StudyArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    let study = settings(&args)?;
    if args.comparison == Comparison::Activations {
        ensure!(
            args.device == DeviceKind::Flex,
            "--device: found {}, expected flex: dense networks are trained on it",
            args.device.name()
        );
    }
    args.device.check()?;
    let work = Work {
        folders: Folders::new(&args.output),
        comparison: args.comparison,
        variants: args.comparison.variants(&study),
        presets: args.comparison.presets(&study),
        study: &study,
        jobs: args.jobs.get(),
        device: args.device,
        quiet,
        interrupt,
        failed: AtomicBool::new(false),
    };
    work.simulate()?;
    match args.comparison {
        Comparison::Activations => curves::run(&work)?,
        Comparison::Cores | Comparison::Loss | Comparison::Window => networks::run(&work)?,
    }
    if interrupt.requested() {
        bail!("interrupted: the same command goes on");
    }
    work.judge()?;
    if args.comparison == Comparison::Cores {
        speed::run(&work)?;
    }
    if interrupt.requested() {
        bail!("interrupted: the same command goes on");
    }
    report::write(&work)
}

/// A preset's settings, then those of the file.
fn settings(args: &StudyArgs) -> anyhow::Result<StudyConfig> {
    let defaults = if args.paper { StudyConfig::paper() } else { StudyConfig::quick() };
    let named = || match &args.config {
        Some(file) => file.display().to_string(),
        None => "command line".to_owned(),
    };
    let study = match &args.config {
        Some(file) => Overrides::read(file)?.over(&defaults)?,
        None => defaults,
    };
    study.check().with_context(named)?;
    study.dense.check().with_context(named)?;
    for Variant { config, .. } in args.comparison.variants(&study) {
        config.check().with_context(named)?;
    }
    Ok(study)
}

/// A comparison on its way.
struct Work<'a> {
    folders: Folders,
    comparison: Comparison,
    study: &'a StudyConfig,
    variants: Vec<Variant>,
    presets: &'a [String],
    /// Networks that are trained at a time.
    jobs: usize,
    /// What trains the networks whose cores, losses or windows are compared.
    device: DeviceKind,
    quiet: bool,
    interrupt: &'a Interrupt,
    /// Whether one of them has failed: the others stop.
    failed: AtomicBool,
}

impl Work<'_> {
    /// Whether what runs is to stop.
    fn stops(&self) -> bool {
        self.interrupt.requested() || self.failed.load(Ordering::Relaxed)
    }

    fn simulate(&self) -> anyhow::Result<()> {
        for preset in self.presets {
            let words = self.simulation(preset);
            let Command::Simulate(args) = self.parsed(&words)? else {
                bail!("{}: found another command, expected simulate", words.join(" "));
            };
            simulate::run(args, self.quiet, self.interrupt)?;
        }
        Ok(())
    }

    /// Judges every network on each preset, unless this very judgement is there.
    fn judge(&self) -> anyhow::Result<()> {
        for preset in self.presets {
            let folder = self.folders.judgement(self.comparison, preset);
            if self.variants.is_empty() || self.is_judged(preset, &folder)? {
                continue;
            }
            let words = self.judgement(preset);
            let Command::Eval(args) = self.parsed(&words)? else {
                bail!("{}: found another command, expected eval", words.join(" "));
            };
            let mut report = eval::judge(&args, self.quiet, self.interrupt)?;
            report.made.command = command_line(&words);
            report.save(&folder).with_context(|| in_words(&folder))?;
        }
        Ok(())
    }

    /// The command that simulates a preset's scenes.
    fn simulation(&self, preset: &str) -> Vec<String> {
        let data = &self.study.data;
        let mut words = command("simulate");
        words.extend(["--preset".into(), preset.to_owned()]);
        words.extend(["--scenes".into(), data.scenes.to_string()]);
        words.extend(["--seed".into(), data.seed.to_string()]);
        if let Some(duration) = data.duration {
            words.extend(["--duration".into(), duration.to_string()]);
        }
        words.extend(["--output".into(), in_words(&self.folders.data(preset))]);
        words
    }

    /// The command that trains a network with a seed. Its settings are in a file beside its folder.
    fn training(&self, preset: &str, variant: &Variant, seed: u64) -> Vec<String> {
        let output = self.folders.run(preset, &variant.name, seed);
        let mut words = command("train");
        words.extend(["--data".into(), in_words(&self.folders.data(preset))]);
        words.extend(["--config".into(), in_words(&output.with_extension("toml"))]);
        words.extend(["--output".into(), in_words(&output), "--resume".into()]);
        if self.device != DeviceKind::default() {
            words.extend(["--device".into(), self.device.name().into()]);
        }
        words
    }

    /// The command that judges a preset's networks.
    fn judgement(&self, preset: &str) -> Vec<String> {
        let mut words = command("eval");
        words.push("--checkpoint".into());
        let run = |(variant, seed): (&Variant, u64)| {
            in_words(&self.folders.run(preset, &variant.name, seed))
        };
        words.extend(self.runs().map(run));
        words.extend(["--data".into(), in_words(&self.folders.data(preset))]);
        words.extend(["--horizon".into(), self.study.judging.horizon.to_string()]);
        words.extend(["--starts".into(), self.study.judging.starts.to_string()]);
        let folder = self.folders.judgement(self.comparison, preset);
        words.extend(["--output".into(), in_words(&folder)]);
        words
    }

    /// Every command that this study stands for, in order; learning curves have none.
    fn commands(&self) -> Vec<String> {
        let mut lines = Vec::new();
        for preset in self.presets {
            lines.push(command_line(&self.simulation(preset)));
            for (variant, seed) in self.runs() {
                lines.push(command_line(&self.training(preset, variant, seed)));
            }
            if !self.variants.is_empty() {
                lines.push(command_line(&self.judgement(preset)));
            }
        }
        lines
    }

    /// Tells a command line, and what it means.
    fn parsed(&self, words: &[String]) -> anyhow::Result<Command> {
        self.tell(&command_line(words));
        Ok(Cli::try_parse_from(words)?.command)
    }

    /// Whether the report in `folder` is that of all the networks.
    fn is_judged(&self, preset: &str, folder: &Path) -> anyhow::Result<bool> {
        if !folder.exists() {
            return Ok(false);
        }
        let report = Report::load(folder)?;
        let judged: Vec<_> = report.predictors.iter().filter_map(|p| p.digest.as_ref()).collect();
        let networks = self.trained(preset)?;
        let networks: Vec<_> = networks.iter().map(|(_, trained)| &trained.checkpoint).collect();
        Ok(report.made.command == command_line(&self.judgement(preset)) && judged == networks)
    }

    /// What the networks' training came to, in the order of [`Work::runs`].
    fn trained(&self, preset: &str) -> anyhow::Result<Vec<(&Variant, Trained)>> {
        let mut all = Vec::new();
        for (variant, seed) in self.runs() {
            let folder = self.folders.run(preset, &variant.name, seed);
            let config = TrainConfig { seed, ..variant.config.clone() };
            let trained = Trained::find(&folder, &config, self.device)?.with_context(|| {
                format!("{}: found no trained network, expected one", folder.display())
            })?;
            all.push((variant, trained));
        }
        Ok(all)
    }

    /// Every network with every seed. The seed goes round slowest, so that a study that is stopped has whole seeds.
    fn runs(&self) -> impl Iterator<Item = (&Variant, u64)> {
        let seeds = self.study.seeds.iter();
        seeds.flat_map(|&seed| self.variants.iter().map(move |variant| (variant, seed)))
    }

    /// Does tasks, `jobs` at a time, until one fails or all are to stop. What comes out is a line to tell, or nothing
    /// where a task was stopped.
    fn each<T: Send>(
        &self,
        tasks: VecDeque<T>,
        what: &str,
        run: impl Fn(T) -> anyhow::Result<Option<String>> + Sync,
    ) -> anyhow::Result<()> {
        let bar = progress_bar(tasks.len() as u64, what, self.quiet);
        bar.tick();
        let jobs = self.jobs.min(tasks.len());
        let tasks = Mutex::new(tasks);
        let next = || tasks.lock().unwrap_or_else(PoisonError::into_inner).pop_front();
        let worker = || -> anyhow::Result<()> {
            while let (false, Some(task)) = (self.stops(), next()) {
                let outcome = run(task);
                let line = outcome.inspect_err(|_| self.failed.store(true, Ordering::Relaxed))?;
                if let Some(line) = line {
                    bar.suspend(|| self.tell(&line));
                    bar.inc(1);
                }
            }
            Ok(())
        };
        let outcomes: Vec<anyhow::Result<()>> = thread::scope(|scope| {
            let workers: Vec<_> = (0..jobs).map(|_| scope.spawn(worker)).collect();
            let join = |worker: thread::ScopedJoinHandle<'_, _>| {
                worker.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
            };
            workers.into_iter().map(join).collect()
        });
        bar.finish_and_clear();
        outcomes.into_iter().collect()
    }

    fn tell(&self, line: &str) {
        if !self.quiet {
            println!("{line}");
        }
    }
}

/// The first words of a command line.
fn command(name: &str) -> Vec<String> {
    vec!["eddy".to_owned(), name.to_owned()]
}

fn in_words(path: &Path) -> String {
    path.display().to_string()
}

/// Writes a settings file, so that its command line can be given by hand.
fn write(file: &Path, text: &str) -> anyhow::Result<()> {
    let folder = file.parent().unwrap_or(Path::new("."));
    let written = fs::create_dir_all(folder).and_then(|()| fs::write(file, text));
    written.with_context(|| file.display().to_string())
}
