//! Rollouts of models: they observe a stream, then predict from their own output.

use super::{Rollout, error_estimates::Sampler, steps::StepResults, task::RolloutTask};
use eddy_dataset::Stream;
use eddy_frames::{Frame, State};
use eddy_inference::engine::{HiddenState, ModelError, Stepper, Surrogate};

/// Observes a stream from its first frame on, as a node does, and predicts `reach` frames after each of the frames
/// `starts` from the hidden state there. `each` receives the index of the start and its rollout, `sampler` the observed frames
/// and the rollouts. Returns the errors of the one-step predictions over `horizon` frames after each start.
///
/// A rollout is made before the frames after its start are read, so they cannot leak into it.
///
/// # Errors
/// [`ModelError`] when the model does not support the particles.
pub(super) fn roll_out_from_first(
    surrogate: &Surrogate,
    task: &RolloutTask<'_>,
    sampler: &mut Sampler<'_>,
    each: &mut dyn FnMut(usize, Rollout),
) -> Result<StepResults, ModelError> {
    let RolloutTask { stream, starts, reach, .. } = *task;
    let mut observer = task.observer();
    let mut stepper = surrogate.stepper();
    let mut hidden = begin_stream(surrogate, stream, 0)?;
    let mut ahead = hidden.clone();
    let mut predicted: Option<Frame> = None;
    let end = starts.last().copied().unwrap_or(0).max(observer.end());
    for index in 0..=end {
        let observed = stream.frame(index);
        sampler.observe(&observed, predicted.as_ref());
        let frame = predicted.insert(stepper.step(&mut hidden, &observed));
        if let Some(number) = starts.iter().position(|&start| start == index) {
            ahead.clone_from(&hidden);
            let observed = &stream.states[index];
            let rollout = roll_out(&mut stepper, &mut ahead, observed, frame.clone(), reach);
            sampler.add(index, &rollout);
            each(number, rollout);
        }
        if index + 1 < stream.states.len() {
            observer.add(index, &frame.position, &frame.velocity);
        }
    }
    stepper.check()?;
    Ok(observer.finish())
}

/// As [`roll_out_from_first`], but the model joins the stream in the middle: before each start it observes its
/// warm-up only.
///
/// # Errors
/// As [`roll_out_from_first`].
///
/// # Panics
/// When fewer frames than the warm-up precede a start.
pub(super) fn roll_out_joined_late(
    surrogate: &Surrogate,
    task: &RolloutTask<'_>,
    each: &mut dyn FnMut(usize, Rollout),
) -> Result<(), ModelError> {
    let RolloutTask { stream, starts, reach, .. } = *task;
    let warm_up = (surrogate.description().warm_up as usize).max(1);
    let mut stepper = surrogate.stepper();
    for (number, &start) in starts.iter().enumerate() {
        let first = start + 1 - warm_up;
        let mut hidden = begin_stream(surrogate, stream, first)?;
        let mut frame = stepper.step(&mut hidden, &stream.frame(first));
        for index in first + 1..=start {
            stepper.step_into(&mut hidden, &stream.frame(index), &mut frame);
        }
        each(number, roll_out(&mut stepper, &mut hidden, &stream.states[start], frame, reach));
    }
    stepper.check()
}

/// The hidden state of a stream that begins with frame `first`, with its stiffness if the network is conditioned on it.
pub(super) fn begin_stream(
    surrogate: &Surrogate,
    stream: &Stream,
    first: usize,
) -> Result<HiddenState, ModelError> {
    let stiffness = stream.stiffness.filter(|_| surrogate.description().stiffness);
    surrogate.start_with_stiffness(&stream.frame(first), stiffness)
}

/// `first` and the states predicted from it, `reach` in total.
fn roll_out(
    stepper: &mut Stepper,
    hidden: &mut HiddenState,
    observed: &State,
    first: Frame,
    reach: usize,
) -> Rollout {
    let (mut last, mut next) = (first.clone(), first);
    let mut begun = false;
    Rollout::collect(observed, reach, || {
        if begun {
            std::mem::swap(&mut last, &mut next);
            stepper.step_into(hidden, &last, &mut next);
        }
        begun = true;
        Some(State { position: next.position.clone(), velocity: next.velocity.clone() })
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::measure::Flights;
    use eddy_dataset::{LoadOptions, Stream, load_trajectories};
    use eddy_inference::checkpoint::Checkpoint;

    fn sample() -> Stream {
        let bag = concat!(env!("CARGO_MANIFEST_DIR"), "/../../bags/sample");
        let options = LoadOptions::within(u64::MAX);
        let loaded = load_trajectories(&[bag.into()], options, &mut |_, _| ()).unwrap();
        let stream = &loaded.streams[0];
        stream.cut(0..stream.frames).unwrap()
    }

    fn shipped() -> Surrogate {
        Surrogate::load(&Checkpoint::shipped().unwrap(), None).unwrap()
    }

    /// Rollouts from the first frame and joined late.
    fn predict(stream: &Stream, start: usize, reach: usize) -> [Rollout; 2] {
        let (surrogate, mut rollouts) = (shipped(), Vec::new());
        let mut keep = |_: usize, rollout: Rollout| rollouts.push(rollout);
        let task = RolloutTask {
            stream,
            scene: None,
            starts: &[start],
            flights: &Flights::default(),
            horizon: reach,
            reach,
        };
        let mut sampler = Sampler::new(&surrogate, stream, &[]);
        roll_out_from_first(&surrogate, &task, &mut sampler, &mut keep).unwrap();
        roll_out_joined_late(&surrogate, &task, &mut keep).unwrap();
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
    fn a_rollout_starts_from_the_hidden_state_of_the_stream_or_of_the_warm_up() {
        let (stream, start, reach) = (sample(), 12, 3);
        let surrogate = shipped();
        let warm_up = surrogate.description().warm_up as usize;
        let by_hand = |first: usize| {
            let mut stepper = surrogate.stepper();
            let mut hidden = surrogate.start(&stream.frame(first)).unwrap();
            let mut frame = stream.frame(first);
            for index in first..=start {
                frame = stepper.step(&mut hidden, &stream.frame(index));
            }
            (1..reach).for_each(|_| frame = stepper.step(&mut hidden, &frame));
            frame.position
        };
        let last = predict(&stream, start, reach).map(|r| r.states[reach - 1].position.clone());
        assert_eq!(last, [by_hand(0), by_hand(start + 1 - warm_up)]);
    }
}
