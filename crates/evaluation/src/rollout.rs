//! Predicted states of a free rollout.

use eddy_frames::State;

/// Predicted states, one per frame ahead.
#[derive(Clone, Debug, PartialEq)]
pub struct Rollout {
    /// The predicted states. From the first frame that is not finite on, the last finite state.
    pub states: Vec<State>,
    /// Whether a prediction was not finite.
    pub diverged: bool,
}

impl Rollout {
    /// `frames` states from `next`. After `None` or a state that is not finite, repeats the last finite state, or
    /// `observed` if there is none.
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

    /// A rollout that failed before its first prediction.
    pub(super) fn lost(observed: &State, frames: usize) -> Self {
        Self { states: vec![observed.clone(); frames], diverged: true }
    }
}

fn is_finite(state: &State) -> bool {
    let numbers = |rows: &[[f32; 2]]| rows.as_flattened().iter().all(|x| x.is_finite());
    numbers(&state.position) && numbers(&state.velocity)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn after_a_state_that_is_not_finite_the_last_finite_one_is_repeated() {
        let state = |x: f32| State { position: vec![[x, 0.0]], velocity: vec![[0.0; 2]] };
        let mut next = [1.0, f32::NAN, 3.0].into_iter();
        let rollout = Rollout::collect(&state(0.0), 4, || next.next().map(state));
        assert!(rollout.diverged);
        assert_eq!(rollout.states, [state(1.0), state(1.0), state(1.0), state(1.0)]);
        let lost = Rollout::collect(&state(0.0), 1, || None);
        assert_eq!(lost, Rollout { states: vec![state(0.0)], diverged: true });
    }
}
