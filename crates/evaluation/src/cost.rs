//! What a predicted frame costs.

use serde::{Deserialize, Serialize};

use super::{Arena, EvalError, Kind, Predictor, chaos};
use crate::dataset::Stream;
use eddy_frames::clock::Clock;
use eddy_inference::engine::Surrogate;
use eddy_mpm::Scene;

/// Frames before the clock starts, and timed frames, of each stream.
const FRAMES: [usize; 2] = [3, 40];
/// Where in a stream the clock starts: things have met by then.
const START: f64 = 0.15;

/// The time of a predicted frame on one thread. How many substeps a solver takes depends on the material:
/// kinds of scenes are timed apart, and count the same.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Cost {
    /// Mean of the kinds' medians (ms).
    pub p50: f64,
    /// Mean of the kinds' 99th percentiles (ms).
    pub p99: f64,
    /// Frames timed.
    pub frames: usize,
    /// By the kind of the scene.
    pub kinds: Vec<KindCost>,
}

/// The time of a predicted frame in scenes of one kind.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct KindCost {
    /// The kind.
    pub kind: Kind,
    /// Median (ms).
    pub p50: f64,
    /// 99th percentile (ms).
    pub p99: f64,
    /// Frames timed.
    pub frames: usize,
}

impl Cost {
    /// The cost in all of these kinds; `None` where there are none.
    fn of(kinds: Vec<KindCost>) -> Option<Self> {
        let mean = |f: fn(&KindCost) -> f64| kinds.iter().map(f).sum::<f64>() / kinds.len() as f64;
        let (p50, p99) = (mean(|kind| kind.p50), mean(|kind| kind.p99));
        let frames = kinds.iter().map(|kind| kind.frames).sum();
        (!kinds.is_empty()).then_some(Self { p50, p99, frames, kinds })
    }
}

impl KindCost {
    /// The cost by times (s); `None` where there are none.
    fn of(kind: Kind, mut times: Vec<f64>) -> Option<Self> {
        times.sort_by(f64::total_cmp);
        let at = |share: usize| {
            let place = (times.len() * share).div_ceil(100);
            times.get(place.saturating_sub(1)).map(|seconds| 1e3 * seconds)
        };
        Some(Self { kind, p50: at(50)?, p99: at(99)?, frames: times.len() })
    }
}

/// Times a predictor on some streams, one frame after the other: as many of each. Models must have
/// been loaded for one thread. `None` for what takes no time, the truth and the mean; kinds of scenes in which a solver
/// fails have no time.
///
/// # Errors
/// As [`judge_scene`](super::judge_scene).
pub fn time(
    arena: &Arena,
    predictor: Predictor<'_>,
    streams: &[(Stream, Option<Scene>)],
) -> Result<Option<Cost>, EvalError> {
    let mut kinds = Vec::new();
    for kind in Kind::ALL {
        let mut times = Vec::new();
        for (stream, scene) in streams.iter().filter(|(s, _)| Kind::of(&s.material) == kind) {
            add_times(arena, predictor, stream, scene.as_ref(), &mut times)?;
        }
        kinds.extend(KindCost::of(kind, times));
    }
    Ok(Cost::of(kinds))
}

/// Times a predictor on one stream (s).
fn add_times(
    arena: &Arena,
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
            let mut state = observed.clone();
            run(times, || {
                baseline.step(&mut state, &arena.ballistic);
                true
            });
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
        Predictor::Mean | Predictor::Truth => {}
    }
    Ok(())
}

/// Times steps until they fail.
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

fn time_model(
    surrogate: &Surrogate,
    stream: &Stream,
    start: usize,
    times: &mut Vec<f64>,
) -> Result<(), EvalError> {
    let of_model = |reason| EvalError::Model { stream: stream.id, reason };
    let mut frame = stream.frame(start);
    let mut memory = surrogate.start(&frame).map_err(of_model)?;
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
    fn kinds_count_the_same_however_many_frames_were_timed() {
        let slow = KindCost::of(Kind::Jelly, vec![0.006, 0.002, 0.004]).unwrap();
        assert_eq!((slow.p50, slow.p99, slow.frames), (4.0, 6.0, 3));
        let fast = KindCost::of(Kind::Liquid, vec![0.001; 40]).unwrap();
        let cost = Cost::of(vec![fast, slow]).unwrap();
        assert_eq!((cost.p50, cost.p99, cost.frames), (2.5, 3.5, 43));
        assert_eq!(KindCost::of(Kind::Rope, Vec::new()), None);
        assert_eq!(Cost::of(Vec::new()), None);
    }
}
