//! Who is judged, and how.

use std::{collections::BTreeMap, num::NonZeroUsize};

use anyhow::{Context, ensure};
use indicatif::ProgressBar;
use rayon::prelude::*;

use super::{rivals::Rivals, survey::Survey};
use crate::{
    cli::EvalArgs,
    commands::{Interrupt, progress_bar},
};
use eddy::{
    checkpoint::Checkpoint,
    dataset::{Stream, Trajectory},
    engine::Surrogate,
    eval::{
        self, Baseline, Contestant, Cost, Judged, JudgedScene, Kind, Origin, Predictor, Report,
        Role, Settings, Snapshot, chaos, judge_scene,
    },
    mpm::Scene,
    page::Provenance,
};

/// The most models whose rollouts are shown as pictures.
const PICTURED_MODELS: usize = 4;

/// Everything that is needed to judge.
pub(super) struct Contest {
    survey: Survey,
    rivals: Rivals,
    /// Names of the checkpoints.
    names: Vec<String>,
    /// The checkpoints' models, for one thread each: a set of them for every thread.
    models: Vec<Vec<Surrogate>>,
    join_late: bool,
    pool: rayon::ThreadPool,
}

impl Contest {
    /// Loads everyone, and refuses streams that a checkpoint cannot predict before the first
    /// prediction.
    pub(super) fn new(
        args: &EvalArgs,
        checkpoints: Vec<(String, Checkpoint)>,
        survey: Survey,
        interrupt: &Interrupt,
    ) -> anyhow::Result<Self> {
        // Zero stands for as many as there are cores.
        let threads = args.threads.map_or(0, NonZeroUsize::get);
        ensure!(threads <= 1024, "--threads: found {threads}, expected 1 to 1024");
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build()?;
        let load = |(name, checkpoint): &(String, Checkpoint)| {
            Surrogate::load(checkpoint, Some(NonZeroUsize::MIN)).with_context(|| name.clone())
        };
        let models: Vec<Vec<Surrogate>> = (0..pool.current_num_threads())
            .map(|_| checkpoints.iter().map(load).collect())
            .collect::<anyhow::Result<_>>()?;
        let names: Vec<String> = checkpoints.into_iter().map(|(name, _)| name).collect();
        let mut remarks = BTreeMap::new();
        for stream in &survey.streams {
            let first = stream.cut(0..1)?.frame(0);
            for (name, model) in names.iter().zip(&models[0]) {
                model.fits(&first).with_context(|| {
                    format!("{name}: {}: stream {}", stream.source.display(), stream.id)
                })?;
                for remark in model.remarks(&first) {
                    *remarks.entry(format!("{name}: {remark}")).or_insert(0) += 1;
                }
            }
        }
        for (remark, streams) in remarks {
            println!("{remark} ({streams} of {} streams)", survey.streams.len());
        }
        ensure!(!interrupt.requested(), "interrupted");
        let rivals = pool.install(|| Rivals::new(&args.rivals, &survey.streams))?;
        Ok(Self { survey, rivals, names, models, join_late: args.join_late, pool })
    }

    /// Judges and times everyone.
    pub(super) fn judge(&self, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<Report> {
        let Survey { streams, arena, digest } = &self.survey;
        let bar = progress_bar(streams.len() as u64, "scenes", quiet);
        let judge = |(stream, scene): (&Trajectory, &Option<Scene>)| {
            ensure!(!interrupt.requested(), "interrupted");
            let models = &self.models[rayon::current_thread_index().unwrap_or(0)];
            let whole = stream.cut(0..stream.frames)?;
            let predictors = self.predictors(models);
            let judged = judge_scene(arena, &predictors, &whole, scene.as_ref())
                .with_context(|| stream.source.display().to_string())?;
            bar.inc(1);
            Ok(judged)
        };
        let pairs: Vec<_> = streams.iter().zip(&self.rivals.scenes).collect();
        let scenes = self
            .pool
            .install(|| pairs.into_par_iter().map(judge).collect::<anyhow::Result<Vec<_>>>())?;
        bar.finish_and_clear();
        let samples = self.samples()?;
        let timed = self.predictors(&self.models[0]).into_iter();
        let costs = timed.map(|predictor| eval::time(arena, predictor, &samples));
        let costs = costs.collect::<Result<_, _>>()?;
        let snapshots = self.snapshots(&samples)?;
        Ok(self.report(scenes, costs, snapshots, digest.clone()))
    }

    /// One stream of each kind, to take the time on: the first that is judged.
    fn samples(&self) -> anyhow::Result<Vec<(Stream, Option<Scene>)>> {
        let all = || self.survey.streams.iter().zip(&self.rivals.scenes);
        let is_judged = |stream: &Trajectory| !self.survey.arena.starts(stream.frames).is_empty();
        let first = |kind: Kind| {
            all().find(|(stream, _)| Kind::of(&stream.material) == kind && is_judged(stream))
        };
        let cut = |(stream, scene): (&Trajectory, &Option<Scene>)| {
            Ok((stream.cut(0..stream.frames)?, scene.clone()))
        };
        Kind::ALL.into_iter().filter_map(first).map(cut).collect()
    }

    /// Rollouts to look at: of a few models and the first rival.
    fn snapshots(
        &self,
        samples: &[(Stream, Option<Scene>)],
    ) -> anyhow::Result<(Vec<usize>, Vec<Snapshot>)> {
        let all = self.predictors(&self.models[0]);
        let numbers = |wanted: fn(&Predictor<'_>) -> bool, most: usize| {
            let found = all.iter().enumerate().filter(move |(_, predictor)| wanted(predictor));
            found.map(|(number, _)| number).take(most)
        };
        let models = numbers(|p| matches!(p, Predictor::Model(_)), PICTURED_MODELS);
        let chosen: Vec<usize> =
            models.chain(numbers(|p| matches!(p, Predictor::Restart(_)), 1)).collect();
        let predictors: Vec<_> = chosen.iter().map(|&number| all[number]).collect();
        let arena = &self.survey.arena;
        let take = |(stream, scene): &(Stream, Option<Scene>)| {
            eval::snapshot(arena, &predictors, stream, scene.as_ref()).transpose()
        };
        let snapshots = samples.iter().filter_map(take).collect::<Result<_, _>>()?;
        Ok((chosen, snapshots))
    }

    /// Everyone, with the models of one thread.
    fn predictors<'a>(&self, models: &'a [Surrogate]) -> Vec<Predictor<'a>> {
        let late = models.iter().filter(|_| self.join_late).map(Predictor::JoinedLate);
        let rivals = self.rivals.predictors.iter().copied();
        let baselines = Baseline::ALL.map(Predictor::Baseline).into_iter().chain([Predictor::Mean]);
        let models = models.iter().map(Predictor::Model).chain(late);
        models.chain(baselines).chain(rivals).chain([Predictor::Truth]).collect()
    }

    fn report(
        &self,
        scenes: Vec<JudgedScene>,
        costs: Vec<Option<Cost>>,
        snapshots: (Vec<usize>, Vec<Snapshot>),
        data_digest: String,
    ) -> Report {
        let short = short_names(&self.names);
        let mut models = 0;
        let predictors = self.predictors(&self.models[0]);
        let contestants = predictors.iter().map(|predictor| {
            // Models come in the order of the checkpoints, once or twice.
            let number = models % self.names.len();
            if matches!(predictor, Predictor::Model(_) | Predictor::JoinedLate(_)) {
                models += 1;
            }
            contestant(predictor, &short[number], &self.names[number])
        });
        let contestants = contestants.collect();
        let notes = self.rivals.notes.clone();
        let made = Provenance::here();
        let judged = Judged { contestants, scenes, costs, data_digest, snapshots, notes, made };
        Report::new(&self.survey.arena, judged)
    }
}

/// Judges a single model on streams one after the other, with all the threads that it has.
pub(in crate::commands) fn judge_alone(
    surrogate: &Surrogate,
    name: &str,
    streams: Vec<Trajectory>,
    settings: Settings,
    bar: &ProgressBar,
) -> anyhow::Result<Report> {
    let Survey { streams, arena, digest } =
        Survey::new(settings, &[surrogate.description()], streams)?;
    let baselines = Baseline::ALL.map(Predictor::Baseline).into_iter().chain([Predictor::Mean]);
    let predictors: Vec<_> =
        std::iter::once(Predictor::Model(surrogate)).chain(baselines).collect();
    let judge = |stream: &Trajectory| {
        let judged = judge_scene(&arena, &predictors, &stream.cut(0..stream.frames)?, None)?;
        bar.inc(1);
        anyhow::Ok(judged)
    };
    let scenes = streams.iter().map(judge).collect::<anyhow::Result<Vec<_>>>()?;
    let contestants: Vec<_> = predictors.iter().map(|p| contestant(p, name, name)).collect();
    let costs = vec![None; contestants.len()];
    let snapshots = match streams.first() {
        Some(stream) => {
            eval::snapshot(&arena, &predictors[..1], &stream.cut(0..stream.frames)?, None)?
        }
        None => None,
    };
    let judged = Judged {
        contestants,
        scenes,
        costs,
        data_digest: digest,
        snapshots: (vec![0], snapshots.into_iter().collect()),
        notes: Vec::new(),
        made: Provenance::here(),
    };
    Ok(Report::new(&arena, judged))
}

/// What is said about a predictor; a model has a short name and a path.
fn contestant(predictor: &Predictor<'_>, short: &str, path: &str) -> Contestant {
    let origin = |surrogate: &Surrogate| Origin {
        checkpoint: path.to_owned(),
        digest: surrogate.digest().to_owned(),
        description: surrogate.description().clone(),
    };
    let (name, role, origin) = match predictor {
        Predictor::Model(surrogate) => (short.to_owned(), Role::Model, Some(origin(surrogate))),
        Predictor::JoinedLate(surrogate) => {
            (format!("{short}, joined late"), Role::JoinedLate, Some(origin(surrogate)))
        }
        Predictor::Baseline(baseline) => (baseline.name().to_owned(), Role::Baseline, None),
        Predictor::Mean => ("mean of the training".to_owned(), Role::Mean, None),
        Predictor::Restart(restart) => (restart.name().to_owned(), Role::Rival, None),
        Predictor::Chaos => (chaos::NAME.to_owned(), Role::Chaos, None),
        Predictor::Truth => ("truth".to_owned(), Role::Truth, None),
    };
    Contestant { name, role, origin }
}

/// The last parts of paths, where they differ; else whole paths.
pub(super) fn short_names(paths: &[String]) -> Vec<String> {
    let last = |path: &String| {
        let name = std::path::Path::new(path).file_name();
        name.map_or(path.clone(), |name| name.to_string_lossy().into_owned())
    };
    let mut short: Vec<String> = paths.iter().map(last).collect();
    short.sort();
    short.dedup();
    if short.len() < paths.len() { paths.to_vec() } else { paths.iter().map(last).collect() }
}
