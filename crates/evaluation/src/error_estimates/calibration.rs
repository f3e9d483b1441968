//! Calibration of error estimates by free rollouts over scenes that a model was not trained on.

use std::num::NonZeroUsize;

use rayon::prelude::*;

use super::{
    Outcome, Reliability, Sample, Sampler,
    fit::{Observation, least_squares, logistic},
    reliability::logarithm,
};
use crate::{
    EvalError, EvaluationError, SHOWN_FRAMES, Settings, dataset::Trajectory, measure::Flights,
    model_rollout::roll_out_from_first, rollout_threads, selection::Selection, task::RolloutTask,
};
use eddy_frames::progress::Progress;
use eddy_inference::{
    engine::Surrogate,
    error_model::{CalibratedHorizon, ErrorModel, LEVELS, Linear, Regression},
};

/// Fewest streams: two of each part.
pub const MIN_STREAMS: usize = 2 * FOLDS;
/// Parts of the streams, each left out of a fit once.
const FOLDS: usize = 5;

/// What to calibrate and on what.
#[derive(Clone, Debug)]
pub struct CalibrationRequest {
    /// Streams; those that the model was trained on are excluded.
    pub streams: Vec<Trajectory>,
    /// Largest number of frames ahead.
    pub horizon: usize,
    /// Rollouts per stream.
    pub starts: usize,
    /// Streams rolled out in parallel; by default one per core, or more with a model on a device.
    pub threads: Option<NonZeroUsize>,
}

/// Calibrated estimates, and how well they hold for scenes left out of the fit.
#[derive(Clone, Debug)]
pub struct Calibration {
    /// The estimates.
    pub model: ErrorModel,
    /// How well estimates for each fifth of the scenes hold that were fitted to the others.
    pub reliability: Vec<Reliability>,
    /// Remarks for the user, one sentence each: excluded streams, numbers of frames that no stream reaches.
    pub remarks: Vec<String>,
}

impl Calibration {
    /// Rolls out a model over streams and fits estimates of its errors.
    ///
    /// # Errors
    /// [`EvaluationError`] when a number is out of range, there are fewer than [`MIN_STREAMS`] streams that the model was not
    /// trained on, the model cannot predict one of them, or the calibration was cancelled.
    pub fn of(
        surrogate: &Surrogate,
        request: CalibrationRequest,
        progress: &dyn Progress,
    ) -> Result<Self, EvaluationError> {
        let CalibrationRequest { streams, horizon, starts, threads } = request;
        for (field, found) in [("horizon", horizon), ("starts", starts)] {
            if found == 0 {
                return Err(EvaluationError::request(field, found, "at least 1"));
            }
        }
        let settings = Settings::errors_only(horizon, starts);
        let Selection { streams, context, digest, mut remarks } =
            Selection::new(settings, &[surrogate.description()], streams)?;
        let has_rollouts = |stream: &Trajectory| !context.starts(stream.frames).is_empty();
        let streams: Vec<Trajectory> = streams.into_iter().filter(has_rollouts).collect();
        if streams.len() < MIN_STREAMS {
            let expected = "at least 10 that the model was not trained on, with room for a rollout";
            return Err(EvaluationError::request("streams", streams.len(), expected));
        }
        let horizons: Vec<u32> =
            SHOWN_FRAMES.iter().filter(|&&ahead| ahead <= horizon).map(|&h| h as u32).collect();
        let threads =
            threads.map_or_else(|| rollout_threads([surrogate], &streams), NonZeroUsize::get);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build()?;
        progress.begin(streams.len() as u64, "scenes");
        let samples = |stream: &Trajectory| {
            if progress.cancelled() {
                return Err(EvaluationError::Cancelled);
            }
            let starts = context.starts(stream.frames);
            let found = samples(surrogate, stream, &starts, &horizons)?;
            progress.advance(1);
            Ok(found)
        };
        let samples: Result<Vec<_>, _> =
            pool.install(|| streams.par_iter().with_max_len(1).map(samples).collect());
        progress.finish();
        let samples = samples?;
        let (mut calibrated, mut reliability) = (Vec::new(), Vec::new());
        for &horizon in &horizons {
            let Some((at, outcomes)) = calibrate(horizon, &samples) else {
                remarks.push(format!(
                    "too few rollouts are compared with the truth {horizon} frames ahead: no estimates there"
                ));
                continue;
            };
            calibrated.push(at);
            reliability.extend(Reliability::by_horizon(&outcomes));
        }
        let rollouts = streams.iter().map(|stream| context.starts(stream.frames).len()).sum();
        let seen = streams.iter().map(Trajectory::fingerprint).collect::<Result<_, _>>()?;
        let model = ErrorModel {
            format_version: 1,
            checkpoint: surrogate.digest().to_owned(),
            data: digest,
            streams: streams.len(),
            rollouts,
            seen,
            horizons: calibrated,
        };
        Ok(Self { model, reliability, remarks })
    }
}

/// Samples of the rollouts from `starts`.
fn samples(
    surrogate: &Surrogate,
    stream: &Trajectory,
    starts: &[usize],
    horizons: &[u32],
) -> Result<Vec<Sample>, EvaluationError> {
    let whole = stream.cut(0..stream.frames)?;
    let horizon = horizons.last().map_or(1, |&last| last as usize);
    let task = RolloutTask {
        stream: &whole,
        scene: None,
        starts,
        flights: &Flights::default(),
        horizon: 1,
        reach: horizon,
    };
    let mut sampler = Sampler::new(surrogate, &whole, horizons);
    roll_out_from_first(surrogate, &task, &mut sampler, &mut |_, _| ()).map_err(|reason| {
        let reason = Box::new(EvalError::Model { stream: stream.id, reason }.into());
        EvaluationError::Scene { bag: stream.source.clone(), reason }
    })?;
    Ok(sampler.finish())
}

/// The estimates for one number of frames ahead, and how those fitted to other scenes hold for each scene; `None` if fewer than
/// [`MIN_STREAMS`] scenes have samples. `samples` are those of each scene.
fn calibrate(horizon: u32, samples: &[Vec<Sample>]) -> Option<(CalibratedHorizon, Vec<Outcome>)> {
    let of_horizon = |samples: &Vec<Sample>| -> Vec<Sample> {
        samples.iter().filter(|sample| sample.horizon == horizon).copied().collect()
    };
    let scenes: Vec<Vec<Sample>> =
        samples.iter().map(of_horizon).filter(|samples| !samples.is_empty()).collect();
    if scenes.len() < MIN_STREAMS {
        return None;
    }
    // Contiguous parts: the kinds of simulated scenes take turns.
    let fold = |scene: usize| scene * FOLDS / scenes.len();
    let fit = |left_out: Option<usize>| {
        let used = scenes.iter().enumerate().filter(|&(scene, _)| Some(fold(scene)) != left_out);
        let used: Vec<&Sample> = used.flat_map(|(_, samples)| samples).collect();
        let observations = |value: fn(&Sample) -> f64| -> Vec<Observation> {
            used.iter().map(|sample| (sample.features, value(sample))).collect()
        };
        let error = least_squares(&observations(|sample| logarithm(sample.error)));
        let worse = |sample: &Sample| f64::from(u8::from(sample.error > sample.ballistic_error));
        (error, logistic(&observations(worse)))
    };
    let folds: [_; FOLDS] = std::array::from_fn(|fold| fit(Some(fold)));
    let all = || {
        let numbered = scenes.iter().enumerate();
        numbered.flat_map(|(scene, samples)| samples.iter().map(move |s| (fold(scene), s)))
    };
    let left_out = |(fold, sample): (usize, &Sample)| {
        logarithm(sample.error) as f32 - folds[fold].0.value(&sample.features)
    };
    let mut residuals: Vec<f32> = all().map(left_out).collect();
    residuals.sort_by(f32::total_cmp);
    let residuals = LEVELS.map(|level| quantile(&residuals, level));
    let at = |(linear, worse_than_ballistic): (Linear, Linear)| CalibratedHorizon {
        frames: horizon,
        error: Regression { linear, residuals },
        worse_than_ballistic,
    };
    let folds = folds.map(at);
    let outcomes = all().filter_map(|(fold, sample)| Outcome::new(&folds[fold], sample)).collect();
    Some((at(fit(None)), outcomes))
}

/// The quantile of sorted numbers at `level`, interpolated.
fn quantile(sorted: &[f32], level: f32) -> f32 {
    let last = sorted.len() - 1;
    let at = level * last as f32;
    let below = (at as usize).min(last);
    let above = (below + 1).min(last);
    sorted[below] + (at - below as f32) * (sorted[above] - sorted[below])
}

#[cfg(test)]
mod tests {
    use tempfile::TempDir;

    use super::*;
    use crate::dataset::{
        load_trajectories,
        simulate::{SimulationRequest, Source, simulate},
    };
    use eddy_frames::progress::Silent;
    use eddy_inference::checkpoint::Checkpoint;
    use eddy_mpm::{self as mpm, Extent, Preset};

    /// Scenes of few particles and 13 frames.
    fn truth(scenes: u32) -> (TempDir, Vec<Trajectory>) {
        let folder = tempfile::tempdir().unwrap();
        let request = SimulationRequest {
            source: Source::Random(Extent::of(Preset::Kinds, 250).unwrap()),
            name: "kinds".to_owned(),
            scene_name: None,
            scenes,
            seed: 5,
            settings: mpm::Settings { duration: Some(0.2), ..mpm::Settings::default() },
            fields: false,
            device: None,
            threads: None,
        };
        simulate(&request, folder.path(), &Silent, None).unwrap().complete().unwrap();
        let streams = load_trajectories(&[folder.path().into()], u64::MAX, &mut |_, _| ()).unwrap();
        (folder, streams)
    }

    fn shipped() -> Surrogate {
        Surrogate::load(&Checkpoint::shipped().unwrap(), NonZeroUsize::new(1)).unwrap()
    }

    fn request(streams: &[Trajectory]) -> CalibrationRequest {
        let streams = streams.to_vec();
        CalibrationRequest { streams, horizon: 7, starts: 3, threads: NonZeroUsize::new(2) }
    }

    #[test]
    fn every_horizon_that_rollouts_reach_is_calibrated_whatever_the_number_of_threads() {
        let (_folder, streams) = truth(12);
        let surrogate = shipped();
        let Calibration { model, reliability, .. } =
            Calibration::of(&surrogate, request(&streams), &Silent).unwrap();
        assert_eq!((model.streams, model.rollouts), (12, 36));
        assert_eq!(model.checkpoint, surrogate.digest());
        let frames: Vec<u32> = model.horizons.iter().map(|at| at.frames).collect();
        assert_eq!(frames, [1, 5]);
        // The last rollout of each stream ends before its fifth frame.
        assert_eq!(reliability.iter().map(|r| r.estimates).collect::<Vec<_>>(), [36, 24]);
        // Residuals are those of the same estimates: half of the errors are below the median.
        let median = reliability[1].coverage[10];
        assert!((0.4..0.6).contains(&median), "{median}");
        let alone = CalibrationRequest { threads: NonZeroUsize::new(1), ..request(&streams) };
        assert_eq!(Calibration::of(&surrogate, alone, &Silent).unwrap().model, model);
    }

    #[test]
    fn too_few_streams_and_horizons_are_rejected() {
        let (_folder, streams) = truth(9);
        for (request, words) in [
            (request(&streams), "streams: found 9, expected at least 10 that the model was not"),
            (CalibrationRequest { horizon: 40, ..request(&streams) }, "streams: the longest has"),
        ] {
            let error = Calibration::of(&shipped(), request, &Silent).unwrap_err();
            assert!(error.to_string().contains(words), "{error}");
        }
    }
}
