//! Frames of a rollout beside the true ones, to look at (the paper's Fig. 7).

use super::{Arena, EvalError, Predictor, SHOWN, measure::Flights, predictor::Predicting};
use crate::dataset::Stream;
use eddy_frames::{Frame, Material};
use eddy_mpm::Scene;

/// One rollout of several predictors from the same frame, at some frames ahead.
#[derive(Clone, Debug)]
pub struct Snapshot {
    /// The bag that the stream is from.
    pub scene: String,
    /// What it is made of.
    pub materials: Vec<Material>,
    /// Frame of the stream that was observed last, from 0.
    pub start: usize,
    /// Frames ahead of it that are shown.
    pub ahead: Vec<usize>,
    /// The true frames.
    pub truth: Vec<Frame>,
    /// The predicted frames of each predictor, in their order.
    pub predicted: Vec<Vec<Frame>>,
}

/// Where in a stream a rollout is looked at, about: things have begun to meet by then.
const START: f64 = 0.15;

/// Lets predictors roll out from one frame of a stream, of those that rollouts start from when it is judged:
/// the one after about 15 % of it. `None` where none has truth up to the horizon.
///
/// # Errors
/// As [`judge_scene`](super::judge_scene).
pub fn snapshot(
    arena: &Arena,
    predictors: &[Predictor<'_>],
    stream: &Stream,
    scene: Option<&Scene>,
) -> Result<Option<Snapshot>, EvalError> {
    let horizon = arena.settings.horizon;
    let starts = arena.starts(stream.states.len());
    let whole = |start: &&usize| **start + horizon < stream.states.len();
    let wanted = (START * stream.states.len() as f64) as usize;
    let nearest = starts.iter().filter(whole).min_by_key(|start| start.abs_diff(wanted));
    let Some(&start) = nearest else { return Ok(None) };
    let ahead: Vec<usize> = SHOWN.into_iter().filter(|&ahead| ahead <= horizon).collect();
    let (flights, starts) = (Flights::default(), [start]);
    let reach = ahead.last().copied().unwrap_or(1);
    let what = Predicting { stream, scene, starts: &starts, flights: &flights, horizon, reach };
    let mut predicted = Vec::new();
    for predictor in predictors {
        let mut frames = Vec::new();
        predictor.roll_out(arena, &what, &mut |_, rollout| {
            frames = ahead
                .iter()
                .map(|&ahead| {
                    let state = rollout.states[ahead - 1].clone();
                    let truth = stream.frame(start + ahead);
                    Frame { position: state.position, velocity: state.velocity, ..truth }
                })
                .collect();
        })?;
        predicted.push(frames);
    }
    let truth = ahead.iter().map(|&ahead| stream.frame(start + ahead)).collect();
    let (scene, materials) = (stream.name(), stream.materials());
    Ok(Some(Snapshot { scene, materials, start, ahead, truth, predicted }))
}
