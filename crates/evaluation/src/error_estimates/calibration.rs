//! Calibration of error estimates by free rollouts over scenes that a model was not trained on.

use std::num::NonZeroUsize;

use rayon::prelude::*;

use super::{
    Outcome, Reliability, Sample, Sampler,
    fit::{Observation, least_squares, logistic},
};
use crate::{
    EvalError, EvaluationError, Settings, measure::Flights, model_rollout::roll_out_from_first,
    rollout_threads, selection::Selection, task::RolloutTask,
};
use eddy_dataset::Trajectory;
use eddy_frames::progress::Progress;
use eddy_inference::{
    engine::Surrogate,
    error_model::{CalibratedHorizon, ErrorModel, LEVELS, Linear, Regression, log_square},
};

/// Fewest streams, as errors and help say: two of each part.
const MIN_STREAMS: usize = 2 * FOLDS;
/// Frames ahead that are calibrated: estimates in between, which are interpolated, hold as well.
const CALIBRATED_FRAMES: [usize; 8] = [1, 2, 3, 5, 10, 20, 50, 100];
/// Parts of the streams, each left out of a fit once.
const FOLDS: usize = 5;

/// What to calibrate and on what.
#[derive(Clone, Debug)]
pub struct CalibrationRequest {
    /// Streams; those that the model was trained on are excluded.
    pub streams: Vec<Trajectory>,
    /// Young's modulus of all streams (density x velocity^2), for a model with the stiffness as an input; by default that of each stream.
    pub stiffness: Option<f32>,
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
    /// Remarks for the user, one sentence each: streams left out, numbers of frames that too few streams reach.
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
        let CalibrationRequest { horizon, starts, threads, .. } = request;
        for (field, found) in [("horizon", horizon), ("starts", starts)] {
            if found == 0 {
                return Err(EvaluationError::request(field, found, "at least 1"));
            }
        }
        let Selection { streams, context, mut remarks, .. } =
            streams_with_rollouts(surrogate, request)?;
        let horizons: Vec<u32> = horizons(horizon);
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
                    "rollouts of fewer than {MIN_STREAMS} streams can be compared with the truth {horizon} frames ahead: no \
                     estimates there"
                ));
                continue;
            };
            calibrated.push(at);
            reliability.extend(Reliability::by_horizon(&outcomes));
        }
        if calibrated.is_empty() {
            let usable = samples.iter().filter(|samples| !samples.is_empty()).count();
            let expected =
                "at least 10 with rollouts that do not diverge and start after the first frame";
            return Err(EvaluationError::request("streams", usable, expected));
        }
        let digest = eddy_dataset::digest(&streams, |_| ())?;
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

/// The streams that the model was not trained on, if there are enough with room for a rollout.
fn streams_with_rollouts(
    surrogate: &Surrogate,
    request: CalibrationRequest,
) -> Result<Selection, EvaluationError> {
    let settings = Settings::errors_only(request.horizon, request.starts);
    let CalibrationRequest { streams, stiffness, .. } = request;
    let mut selection = Selection::new(settings, &[surrogate.description()], streams, stiffness)?;
    let Selection { streams, context, remarks, .. } = &mut selection;
    let all = streams.len();
    streams.retain(|stream| !context.starts(stream.frames).is_empty());
    if streams.len() < all {
        let short = all - streams.len();
        remarks.push(format!("{short} of {all} streams are too short for a rollout: left out"));
    }
    if streams.len() < MIN_STREAMS {
        let expected = "at least 10 that the model was not trained on, with room for a rollout";
        return Err(EvaluationError::request("streams", streams.len(), expected));
    }
    Ok(selection)
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
        let error = least_squares(&observations(|sample| log_square(sample.error).into()));
        let worse = |sample: &Sample| f64::from(u8::from(sample.error > sample.ballistic_error));
        (error, logistic(&observations(worse)))
    };
    let folds: [_; FOLDS] = std::array::from_fn(|fold| fit(Some(fold)));
    let all = || {
        let numbered = scenes.iter().enumerate();
        numbered.flat_map(|(scene, samples)| samples.iter().map(move |s| (fold(scene), s)))
    };
    let left_out = |(fold, sample): (usize, &Sample)| {
        (fold, log_square(sample.error) - folds[fold].0.value(&sample.features))
    };
    let residuals: Vec<(usize, f32)> = all().map(left_out).collect();
    // The residuals of a part, like its regression, must not tell how the estimates hold for that part.
    let quantiles = |without: Option<usize>| {
        let others = residuals.iter().filter(|(fold, _)| Some(*fold) != without);
        let mut others: Vec<f32> = others.map(|(_, residual)| *residual).collect();
        others.sort_by(f32::total_cmp);
        LEVELS.map(|level| quantile(&others, level))
    };
    let at = |(linear, worse_than_ballistic): &(Linear, Linear), without| CalibratedHorizon {
        frames: horizon,
        error: Regression { linear: linear.clone(), residuals: quantiles(without) },
        worse_than_ballistic: worse_than_ballistic.clone(),
    };
    let judged: [_; FOLDS] = std::array::from_fn(|fold| at(&folds[fold], Some(fold)));
    let outcomes = all().filter_map(|(fold, sample)| Outcome::new(&judged[fold], sample)).collect();
    Some((at(&fit(None), None), outcomes))
}

/// The numbers of frames ahead that are calibrated, up to the largest, which is one of them.
fn horizons(largest: usize) -> Vec<u32> {
    let before = CALIBRATED_FRAMES.into_iter().filter(|&ahead| ahead < largest);
    before.chain([largest]).map(|ahead| ahead as u32).collect()
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
    use eddy_dataset::test_streams::simulated;
    use eddy_frames::progress::Silent;
    use eddy_inference::{
        checkpoint::Checkpoint,
        error_model::{FEATURES, Features},
    };
    use eddy_mpm::{Extent, Preset};

    /// Scenes of few particles and 13 frames.
    fn truth(scenes: u32) -> (TempDir, Vec<Trajectory>) {
        simulated(Extent::of(Preset::Kinds, 250).unwrap(), scenes).unwrap()
    }

    fn shipped() -> Surrogate {
        Surrogate::load(&Checkpoint::shipped().unwrap(), NonZeroUsize::new(1)).unwrap()
    }

    fn request(streams: &[Trajectory]) -> CalibrationRequest {
        let streams = streams.to_vec();
        let (stiffness, threads) = (None, NonZeroUsize::new(2));
        CalibrationRequest { streams, stiffness, horizon: 7, starts: 3, threads }
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
        assert_eq!(frames, [1, 2, 3, 5, 7]);
        // Late rollouts of each stream run out of truth.
        assert_eq!(
            reliability.iter().map(|r| r.estimates).collect::<Vec<_>>(),
            [36, 36, 24, 24, 12]
        );
        let alone = CalibrationRequest { threads: NonZeroUsize::new(1), ..request(&streams) };
        assert_eq!(Calibration::of(&surrogate, alone, &Silent).unwrap().model, model);
    }

    #[test]
    fn how_estimates_hold_is_said_of_scenes_that_they_were_not_made_from() {
        let sample = |scene: usize, error: f64| Sample {
            horizon: 5,
            features: Features([scene as f32; FEATURES]),
            error,
            ballistic_error: 1.0,
        };
        let scenes = |last: f64| -> Vec<Vec<Sample>> {
            let error = |scene: usize| if scene < 8 { 1.0 } else { last };
            let of = |scene: usize| {
                (0..5).map(|n| sample(scene % 3, error(scene) * 1.1f64.powi(n))).collect()
            };
            (0..10).map(of).collect()
        };
        let [alike, other] = [1.0, 1e6].map(|last| {
            let (_, outcomes) = calibrate(5, &scenes(last)).unwrap();
            // Of the last part.
            outcomes[40..].iter().filter(|outcome| outcome.level <= 0.9).count()
        });
        assert!(alike >= 8, "{alike}");
        assert_eq!(other, 0, "these errors are far above all that the estimates were made from");
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
