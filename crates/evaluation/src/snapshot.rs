//! Frames of a rollout beside the true ones, for pictures (the paper's Fig. 7).

use super::{Context, EvalError, Predictor, SHOWN_FRAMES, measure::Flights, task::RolloutTask};
use eddy_dataset::Stream;
use eddy_frames::{Frame, Material, tool::Shape};
use eddy_mpm::Scene;

/// One rollout of several predictors from the same frame, at some frames ahead.
#[derive(Clone, Debug)]
pub struct Snapshot {
    /// Name of the stream's bag.
    pub scene: String,
    /// The materials that occur.
    pub materials: Vec<Material>,
    /// The last observed frame of the stream, from 0.
    pub start: usize,
    /// The frames ahead that are shown.
    pub ahead: Vec<usize>,
    /// The true frames.
    pub truth: Vec<Frame>,
    /// The tools at these frames, and the forces of true matter on them.
    pub tools: Vec<Vec<Shape>>,
    /// The predicted frames, `[predictor][ahead]`.
    pub predicted: Vec<Vec<Frame>>,
}

/// Preferred start as a share of the stream: bodies begin to collide by then.
const START: f64 = 0.15;

/// Lets predictors roll out from one frame of a stream: the start of its evaluation nearest to 15 % of the stream.
/// `None` when no start has truth up to the horizon.
///
/// # Errors
/// As [`evaluate_scene`](super::evaluate_scene).
pub fn snapshot(
    context: &Context,
    predictors: &[Predictor<'_>],
    stream: &Stream,
    scene: Option<&Scene>,
) -> Result<Option<Snapshot>, EvalError> {
    let horizon = context.settings.horizon;
    let starts = context.starts(stream.states.len());
    let whole = |start: &&usize| **start + horizon < stream.states.len();
    let wanted = (START * stream.states.len() as f64) as usize;
    let nearest = starts.iter().filter(whole).min_by_key(|start| start.abs_diff(wanted));
    let Some(&start) = nearest else { return Ok(None) };
    let ahead: Vec<usize> = SHOWN_FRAMES.into_iter().filter(|&ahead| ahead <= horizon).collect();
    let (flights, starts) = (Flights::default(), [start]);
    let reach = ahead.last().copied().unwrap_or(1);
    let task = RolloutTask { stream, scene, starts: &starts, flights: &flights, horizon, reach };
    let mut predicted = Vec::new();
    for predictor in predictors {
        let mut frames = Vec::new();
        predictor.roll_out(context, &task, &mut |_, rollout| {
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
    let truth: Vec<_> = ahead.iter().map(|&ahead| stream.frame(start + ahead)).collect();
    let tools = match &stream.tools {
        Some(tools) => {
            let scale = tools.force_scale(stream.domain.upper[1] - stream.domain.lower[1]);
            truth.iter().map(|frame| tools.shapes_at(frame.sequence, scale)).collect()
        }
        None => vec![Vec::new(); truth.len()],
    };
    let (scene, materials) = (stream.name(), stream.materials());
    Ok(Some(Snapshot { scene, materials, start, ahead, truth, tools, predicted }))
}
