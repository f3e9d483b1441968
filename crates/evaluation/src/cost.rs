//! Time per predicted frame.

use serde::{Deserialize, Serialize};

use super::{Context, EvalError, Kind, Predictor, chaos, model_rollout::begin_stream};
use eddy_dataset::Stream;
use eddy_frames::{State, clock::Clock};
use eddy_inference::engine::Surrogate;
use eddy_mpm::Scene;

/// Warm-up frames and timed frames of each stream.
const FRAMES: [usize; 2] = [3, 40];
/// Share of a stream before the timed frames: bodies are in contact by then.
const START: f64 = 0.15;

/// Time per predicted frame on one thread. The substeps of a solver depend on the material, so kinds of scenes are
/// timed separately and weighted equally.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Cost {
    /// Mean of the kinds' medians (ms).
    pub p50: f64,
    /// Mean of the kinds' 99th percentiles (ms).
    pub p99: f64,
    /// Frames timed.
    pub frames: usize,
    /// By kind of scene.
    pub kinds: Vec<KindCost>,
}

/// Time per predicted frame in scenes of one kind.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct KindCost {
    /// Kind of scene.
    pub kind: Kind,
    /// Median (ms).
    pub p50: f64,
    /// 99th percentile (ms).
    pub p99: f64,
    /// Frames timed.
    pub frames: usize,
}

impl Cost {
    /// The cost over these kinds; `None` without any.
    fn of(kinds: Vec<KindCost>) -> Option<Self> {
        let mean = |f: fn(&KindCost) -> f64| kinds.iter().map(f).sum::<f64>() / kinds.len() as f64;
        let (p50, p99) = (mean(|kind| kind.p50), mean(|kind| kind.p99));
        let frames = kinds.iter().map(|kind| kind.frames).sum();
        (!kinds.is_empty()).then_some(Self { p50, p99, frames, kinds })
    }
}

impl KindCost {
    /// The cost from times (s); `None` without any.
    fn of(kind: Kind, mut times: Vec<f64>) -> Option<Self> {
        times.sort_by(f64::total_cmp);
        let at = |share: usize| {
            let place = (times.len() * share).div_ceil(100);
            times.get(place.saturating_sub(1)).map(|seconds| 1e3 * seconds)
        };
        Some(Self { kind, p50: at(50)?, p99: at(99)?, frames: times.len() })
    }
}

/// Times a predictor frame by frame, the same number of frames on each stream. Models must have been loaded for one
/// thread. `None` for recorded rollouts, the truth and the mean, which compute nothing; kinds in which a solver fails are left out.
///
/// # Errors
/// As [`evaluate_scene`](super::evaluate_scene).
pub fn time(
    context: &Context,
    predictor: Predictor<'_>,
    streams: &[(Stream, Option<Scene>)],
) -> Result<Option<Cost>, EvalError> {
    let mut kinds = Vec::new();
    for kind in Kind::ALL {
        let mut times = Vec::new();
        for (stream, scene) in streams.iter().filter(|(s, _)| Kind::of(&s.material) == kind) {
            add_times(context, predictor, stream, scene.as_ref(), &mut times)?;
        }
        kinds.extend(KindCost::of(kind, times));
    }
    Ok(Cost::of(kinds))
}

/// Times a predictor on one stream (s).
fn add_times(
    context: &Context,
    predictor: Predictor<'_>,
    stream: &Stream,
    scene: Option<&Scene>,
    times: &mut Vec<f64>,
) -> Result<(), EvalError> {
    let start = (START * stream.states.len() as f64) as usize;
    let observed = &stream.states[start];
    let scene = || scene.ok_or(EvalError::NoScene { stream: stream.id });
    match predictor {
        Predictor::Model(surrogate) | Predictor::JoinedLate(surrogate) => {
            time_model(surrogate, stream, start, times)?;
        }
        Predictor::Baseline(baseline) => {
            let sweep = stream.sweep(start);
            let step = |state: &mut State| baseline.step(state, &context.ballistic, sweep.as_ref());
            time_simple(observed, step, times);
        }
        Predictor::LinearFit(fit) => {
            time_simple(observed, |state| fit.step(state, context.ballistic.dt), times);
        }
        Predictor::Restart(restart) => {
            if let Ok(mut restarted) = restart.begin(scene()?, stream, observed) {
                run(times, || restarted.next_state().is_some());
            }
        }
        Predictor::Chaos => {
            if let Ok(mut simulation) = chaos::at(scene()?, stream, start, FRAMES[0] + FRAMES[1]) {
                run(times, || matches!(simulation.next_frame(), Ok(Some(_))));
            }
        }
        Predictor::Recorded(_) | Predictor::Mean | Predictor::Truth => {}
    }
    Ok(())
}

/// Times steps until one fails.
fn run(times: &mut Vec<f64>, mut step: impl FnMut() -> bool) {
    for number in 0..FRAMES[0] + FRAMES[1] {
        let clock = Clock::start();
        let done = step();
        let taken = clock.now().as_secs_f64();
        if !done {
            return;
        }
        if number >= FRAMES[0] {
            times.push(taken);
        }
    }
}

/// Times a predictor without a memory.
fn time_simple(observed: &State, step: impl Fn(&mut State), times: &mut Vec<f64>) {
    let mut state = observed.clone();
    run(times, || {
        step(&mut state);
        true
    });
}

fn time_model(
    surrogate: &Surrogate,
    stream: &Stream,
    start: usize,
    times: &mut Vec<f64>,
) -> Result<(), EvalError> {
    let model_error = |reason| EvalError::Model { stream: stream.id, reason };
    let mut frame = stream.frame(start);
    let mut memory = begin_stream(surrogate, stream, start).map_err(model_error)?;
    let mut stepper = surrogate.stepper();
    let mut next = frame.clone();
    run(times, || {
        stepper.step_into(&mut memory, &frame, &mut next);
        std::mem::swap(&mut frame, &mut next);
        frame.check().is_ok()
    });
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kinds_are_weighted_equally_whatever_their_number_of_frames() {
        let slow = KindCost::of(Kind::Jelly, vec![0.006, 0.002, 0.004]).unwrap();
        assert_eq!((slow.p50, slow.p99, slow.frames), (4.0, 6.0, 3));
        let fast = KindCost::of(Kind::Liquid, vec![0.001; 40]).unwrap();
        let cost = Cost::of(vec![fast, slow]).unwrap();
        assert_eq!((cost.p50, cost.p99, cost.frames), (2.5, 3.5, 43));
        assert_eq!(KindCost::of(Kind::Rope, Vec::new()), None);
        assert_eq!(Cost::of(Vec::new()), None);
    }
}
