//! The model fed with its own output.

use super::{predictor::Predicting, steps::OnTheWay};
use crate::dataset::State;
use eddy_frames::Frame;
use eddy_inference::engine::{HiddenState, ModelError, Stepper, Surrogate};

/// Predicted states, one for each frame ahead.
#[derive(Clone, Debug, PartialEq)]
pub struct Rollout {
    /// The predicted states. From the frame on that is not finite, the last finite one.
    pub states: Vec<State>,
    /// Whether a prediction was not finite.
    pub diverged: bool,
}

impl Rollout {
    /// States from `next`, called `frames` times, until it gives `None` or something that is not
    /// finite; from then on the last good one, at first `observed`.
    pub(super) fn collect(
        observed: &State,
        frames: usize,
        mut next: impl FnMut() -> Option<State>,
    ) -> Self {
        let mut rollout = Self { states: Vec::with_capacity(frames), diverged: false };
        for _ in 0..frames {
            let state = if rollout.diverged { None } else { next().filter(is_finite) };
            rollout.diverged |= state.is_none();
            let last = || rollout.states.last().unwrap_or(observed).clone();
            let state = state.unwrap_or_else(last);
            rollout.states.push(state);
        }
        rollout
    }

    /// A rollout without a single prediction.
    pub(super) fn lost(observed: &State, frames: usize) -> Self {
        Self { states: vec![observed.clone(); frames], diverged: true }
    }
}

fn is_finite(state: &State) -> bool {
    let numbers = |rows: &[[f32; 2]]| rows.as_flattened().iter().all(|x| x.is_finite());
    numbers(&state.position) && numbers(&state.velocity)
}

/// Observes a stream from its first frame on, as a node does, and predicts `reach` frames after each
/// of the frames `starts` with the memory it has there. `each` gets the number of the start and its
/// rollout. Returns what the next frames predicted on the way came to, over `horizon` frames after
/// each start.
///
/// A rollout is made before the frames after its start are looked at: they cannot leak into it.
///
/// # Errors
/// [`ModelError`] when the model cannot take the particles.
pub(super) fn roll_out_from_first(
    surrogate: &Surrogate,
    what: &Predicting<'_>,
    each: &mut dyn FnMut(usize, Rollout),
) -> Result<OnTheWay, ModelError> {
    let Predicting { stream, starts, reach, .. } = *what;
    let mut follower = what.follower();
    let mut stepper = surrogate.stepper();
    let mut memory = surrogate.start(&stream.frame(0))?;
    let mut ahead = memory.clone();
    let end = starts.last().copied().unwrap_or(0).max(follower.end());
    for index in 0..=end {
        let frame = stepper.step(&mut memory, &stream.frame(index));
        if let Some(number) = starts.iter().position(|&start| start == index) {
            ahead.clone_from(&memory);
            let observed = &stream.states[index];
            each(number, roll_out(&mut stepper, &mut ahead, observed, frame.clone(), reach));
        }
        if index + 1 < stream.states.len() {
            follower.add(index, &frame.position, &frame.velocity);
        }
    }
    Ok(follower.finish())
}

/// As [`roll_out_from_first`], but of a stream joined in the middle: before each start the model has
/// seen no more than its warm-up.
///
/// # Errors
/// As [`roll_out_from_first`].
///
/// # Panics
/// When a start has fewer frames up to it than the warm-up.
pub(super) fn roll_out_joined_late(
    surrogate: &Surrogate,
    what: &Predicting<'_>,
    each: &mut dyn FnMut(usize, Rollout),
) -> Result<(), ModelError> {
    let Predicting { stream, starts, reach, .. } = *what;
    let warm_up = (surrogate.description().warm_up as usize).max(1);
    let mut stepper = surrogate.stepper();
    for (number, &start) in starts.iter().enumerate() {
        let first = stream.frame(start + 1 - warm_up);
        let mut memory = surrogate.start(&first)?;
        let mut frame = stepper.step(&mut memory, &first);
        for index in start + 2 - warm_up..=start {
            stepper.step_into(&mut memory, &stream.frame(index), &mut frame);
        }
        each(number, roll_out(&mut stepper, &mut memory, &stream.states[start], frame, reach));
    }
    Ok(())
}

/// `first` and what follows from it, `reach` states in all.
fn roll_out(
    stepper: &mut Stepper,
    memory: &mut HiddenState,
    observed: &State,
    first: Frame,
    reach: usize,
) -> Rollout {
    let (mut last, mut next) = (first.clone(), first);
    let mut begun = false;
    Rollout::collect(observed, reach, || {
        if begun {
            std::mem::swap(&mut last, &mut next);
            stepper.step_into(memory, &last, &mut next);
        }
        begun = true;
        Some(State { position: next.position.clone(), velocity: next.velocity.clone() })
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        dataset::{Stream, load_trajectories},
        measure::Flights,
    };
    use eddy_inference::checkpoint::Checkpoint;

    fn sample() -> Stream {
        let bag = concat!(env!("CARGO_MANIFEST_DIR"), "/../../bags/sample");
        let stream = load_trajectories(&[bag.into()], u64::MAX, &mut |_, _| ()).unwrap().remove(0);
        stream.cut(0..stream.frames).unwrap()
    }

    fn shipped() -> Surrogate {
        Surrogate::load(&Checkpoint::shipped().unwrap(), None).unwrap()
    }

    /// The rollouts of both ways to observe.
    fn predict(stream: &Stream, start: usize, reach: usize) -> [Rollout; 2] {
        let (surrogate, mut rollouts) = (shipped(), Vec::new());
        let mut keep = |_: usize, rollout: Rollout| rollouts.push(rollout);
        let what = Predicting {
            stream,
            scene: None,
            starts: &[start],
            flights: &Flights::default(),
            horizon: reach,
            reach,
        };
        roll_out_from_first(&surrogate, &what, &mut keep).unwrap();
        roll_out_joined_late(&surrogate, &what, &mut keep).unwrap();
        rollouts.try_into().unwrap()
    }

    #[test]
    fn a_future_of_nan_changes_no_rollout() {
        let stream = sample();
        let (start, reach) = (8, 10);
        let mut blind = stream.clone();
        for state in &mut blind.states[start + 1..] {
            state.position.fill([f32::NAN; 2]);
            state.velocity.fill([f32::NAN; 2]);
        }
        let seeing = predict(&stream, start, reach);
        assert_eq!(predict(&blind, start, reach), seeing);
        for rollout in seeing {
            assert!(!rollout.diverged);
            assert_ne!(rollout.states[0], rollout.states[reach - 1], "nothing moved at all");
        }
    }

    #[test]
    fn a_rollout_has_the_memory_of_the_stream_or_of_the_warm_up_only() {
        let (stream, start, reach) = (sample(), 12, 3);
        let surrogate = shipped();
        let warm_up = surrogate.description().warm_up as usize;
        let by_hand = |first: usize| {
            let mut stepper = surrogate.stepper();
            let mut memory = surrogate.start(&stream.frame(first)).unwrap();
            let mut frame = stream.frame(first);
            for index in first..=start {
                frame = stepper.step(&mut memory, &stream.frame(index));
            }
            (1..reach).for_each(|_| frame = stepper.step(&mut memory, &frame));
            frame.position
        };
        let last = predict(&stream, start, reach).map(|r| r.states[reach - 1].position.clone());
        assert_eq!(last, [by_hand(0), by_hand(start + 1 - warm_up)]);
    }

    #[test]
    fn a_state_that_is_not_finite_ends_a_rollout_but_not_its_frames() {
        let state = |x: f32| State { position: vec![[x, 0.0]], velocity: vec![[0.0; 2]] };
        let mut next = [1.0, f32::NAN, 3.0].into_iter();
        let rollout = Rollout::collect(&state(0.0), 4, || next.next().map(state));
        assert!(rollout.diverged);
        assert_eq!(rollout.states, [state(1.0), state(1.0), state(1.0), state(1.0)]);
        let lost = Rollout::collect(&state(0.0), 1, || None);
        assert_eq!(lost, Rollout { states: vec![state(0.0)], diverged: true });
    }
}
