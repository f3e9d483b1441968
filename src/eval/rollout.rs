//! The model fed with its own output.

use crate::{
    dataset::State,
    engine::{ModelError, Surrogate},
    frame::Frame,
};

/// Predicted states, one for each frame ahead.
#[derive(Clone, Debug, PartialEq)]
pub struct Rollout {
    /// The predicted states. From the frame on that is not finite, the last finite one.
    pub states: Vec<State>,
    /// Whether a prediction was not finite.
    pub diverged: bool,
}

/// Observes the frames in `observed` (at least one) and predicts `horizon` frames after the last one.
///
/// The truth after the last observed frame is no argument: it cannot leak into the rollout.
///
/// # Errors
/// [`ModelError`] when the model cannot take the particles.
///
/// # Panics
/// When `observed` is empty.
pub fn roll_out(
    surrogate: &Surrogate,
    observed: &[Frame],
    horizon: usize,
) -> Result<Rollout, ModelError> {
    let (first, later) = observed.split_first().expect("a rollout starts from observed frames");
    let mut memory = surrogate.start(first)?;
    let mut frame = surrogate.step(&mut memory, first);
    for seen in later {
        frame = surrogate.step(&mut memory, seen);
    }
    let mut last_finite = observed[observed.len() - 1].clone();
    let mut rollout = Rollout { states: Vec::with_capacity(horizon), diverged: false };
    for ahead in 1..=horizon {
        rollout.diverged |= frame.check().is_err();
        if !rollout.diverged {
            last_finite = frame.clone();
            if ahead < horizon {
                frame = surrogate.step(&mut memory, &frame);
            }
        }
        rollout.states.push(State {
            position: last_finite.position.clone(),
            velocity: last_finite.velocity.clone(),
        });
    }
    Ok(rollout)
}
