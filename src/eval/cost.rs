//! What a predicted frame costs.

use serde::Serialize;

use super::{Arena, Baseline, EvalError, Predictor, chaos};
use crate::{
    clock::Clock,
    dataset::{State, Stream},
    engine::Surrogate,
    mpm::Scene,
};

/// Frames before the clock starts, and timed frames, of each stream.
const FRAMES: [usize; 2] = [3, 40];
/// Where in a stream the clock starts: things have met by then.
const START: f64 = 0.15;

/// The time of a predicted frame on one thread.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Cost {
    /// Median (ms).
    pub p50: f64,
    /// 99th percentile (ms).
    pub p99: f64,
    /// Frames timed.
    pub frames: usize,
}

/// Times a predictor on some streams, one frame after the other: as many of each. Models must have
/// been loaded for one thread. `None` for what takes no time, the truth.
///
/// # Errors
/// As [`judge_scene`](super::judge_scene).
pub fn time(
    arena: &Arena,
    predictor: Predictor<'_>,
    streams: &[(Stream, Option<Scene>)],
) -> Result<Option<Cost>, EvalError> {
    let mut times = Vec::new();
    for (stream, scene) in streams {
        let start = (START * stream.states.len() as f64) as usize;
        let observed = &stream.states[start];
        let scene = || scene.as_ref().ok_or(EvalError::NoScene { stream: stream.id });
        let of_rival = |reason| EvalError::Rival { stream: stream.id, reason };
        match predictor {
            Predictor::Model(surrogate) | Predictor::JoinedLate(surrogate) => {
                time_model(surrogate, stream, start, &mut times)?;
            }
            Predictor::Baseline(baseline) => {
                let mut state = observed.clone();
                run(&mut times, || time_baseline(baseline, arena, &mut state));
            }
            Predictor::Restart(restart) => {
                let restarted = restart.begin(scene()?, stream, observed);
                let mut restarted = restarted.map_err(of_rival)?;
                run(&mut times, || restarted.next_state().is_some());
            }
            Predictor::Chaos => {
                let mut simulation =
                    chaos::at(scene()?, stream, start, FRAMES[0] + FRAMES[1]).map_err(of_rival)?;
                run(&mut times, || matches!(simulation.next_frame(), Ok(Some(_))));
            }
            Predictor::Truth => {}
        }
    }
    times.sort_by(f64::total_cmp);
    let at = |share: usize| {
        let place = (times.len() * share).div_ceil(100);
        times.get(place.saturating_sub(1)).map(|seconds| 1e3 * seconds)
    };
    let frames = times.len();
    Ok(at(50).zip(at(99)).map(|(p50, p99)| Cost { p50, p99, frames }))
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
    let mut next = frame.clone();
    run(times, || {
        surrogate.step_into(&mut memory, &frame, &mut next);
        std::mem::swap(&mut frame, &mut next);
        frame.check().is_ok()
    });
    Ok(())
}

fn time_baseline(baseline: Baseline, arena: &Arena, state: &mut State) -> bool {
    if let Some(next) = baseline.roll_out(state, 1, &arena.ballistic).pop() {
        *state = next;
    }
    true
}
