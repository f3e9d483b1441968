use proptest::prelude::*;
use pulp::Scalar;

use super::{recurrent::Layer, *};
use crate::with_cell;

/// Every cell in every form.
fn cells() -> Vec<AnyCell> {
    let forms = [Form::Plain, Form::Log];
    let of = |core| match core {
        Core::Mlp => Activation::ALL.map(|activation| AnyCell::Mlp(Mlp { activation })).to_vec(),
        Core::MinGru => forms.map(|form| AnyCell::MinGru(MinGru { form })).to_vec(),
        Core::MinLstm => [false, true]
            .map(|normalize| forms.map(|form| AnyCell::MinLstm(MinLstm { form, normalize })))
            .concat(),
        Core::Gru => vec![AnyCell::Gru(Gru)],
        Core::Lstm => vec![AnyCell::Lstm(Lstm)],
    };
    Core::ALL.into_iter().flat_map(of).collect()
}

/// The new state, and the sums as the gradient needs them.
fn next<C: Cell>(
    cell: C,
    mut sums: [f32; MAX_SUMS],
    mut state: [f32; 2],
) -> ([f32; 2], [f32; MAX_SUMS]) {
    cell.next(Scalar::new(), &mut sums, &mut state);
    (state, sums)
}

proptest! {
    #[test]
    fn gradients_are_slopes(
        sums in prop::array::uniform4(-2f32..2.0),
        state in prop::array::uniform2(-2f32..2.0),
        weights in prop::array::uniform2(-2f32..2.0),
    ) {
        // Not at the bends of ReLU, ELU and g.
        let sums = sums.map(|x| if x.abs() < 0.05 { 0.05 } else { x });
        for any in cells() {
            with_cell!(any, |cell, _| check_gradient(cell, sums, state, weights)?);
        }
    }

    /// Columns of vectors and of their rests.
    #[test]
    fn all_frames_in_vectors_equal_single_steps(
        columns in 1usize..40,
        frames in 1usize..4,
        seed in 0usize..1_000,
    ) {
        for any in cells() {
            with_cell!(any, |cell, _| check_vectors(cell, columns, frames, seed)?);
        }
    }
}

/// Numbers from -2 to 2.
fn numbers(seed: usize, count: usize) -> Vec<f32> {
    (seed..seed + count).map(|k| (k * 7_919 % 401) as f32 / 100.0 - 2.0).collect()
}

/// Compares all frames with single steps. Recurrent weights are zero, so that no sum depends on the state.
fn check_vectors<C: Cell>(
    cell: C,
    columns: usize,
    frames: usize,
    seed: usize,
) -> Result<(), TestCaseError> {
    let core = C::CORE;
    let (gates, states) = (core.gates(), core.states());
    let initial = numbers(seed, states * columns);
    // [T, G, M], [G, M]
    let (sums, bias) =
        (numbers(seed + 7, frames * gates * columns), numbers(seed + 3, gates * columns));
    let found = if core.recurrent_part().is_some() {
        let weight = vec![0.0; columns * gates * columns];
        let layer = Layer { cell, inputs: &sums, weight: &weight, bias: &bias, initial: &initial };
        layer.forward().states
    } else {
        let of_gate = |gate| -> Vec<f32> {
            let frames = sums.chunks_exact(gates * columns);
            frames.flat_map(|frame| &frame[gate * columns..(gate + 1) * columns]).copied().collect()
        };
        let lists: Vec<_> = (0..gates).map(of_gate).collect();
        let lists: Vec<_> = lists.iter().map(Vec::as_slice).collect();
        parallel::forward(cell, &lists, &initial)
    };
    for column in 0..columns {
        let mut state: [f32; 2] =
            std::array::from_fn(|k| initial.get(k * columns + column).copied().unwrap_or_default());
        for t in 0..frames {
            let mut own: Vec<f32> =
                (0..gates).map(|gate| sums[(t * gates + gate) * columns + column]).collect();
            own.resize(MAX_SUMS, 0.0);
            for gate in (0..gates).filter(|_| core.recurrent_part().is_some()) {
                let place = if core.split_gate() == Some(gate) { gates } else { gate };
                own[place] += bias[gate * columns + column];
            }
            cell.next(Scalar::new(), &mut own, &mut state);
            for (k, expected) in state.iter().enumerate().take(states) {
                let found = found[(t * states + k) * columns + column];
                prop_assert!((found - expected).abs() < 1e-5, "{cell:?}: {found} {expected}");
            }
        }
    }
    Ok(())
}

/// Compares the gradients of a weighted sum of the new state with central differences.
fn check_gradient<C: Cell>(
    cell: C,
    sums: [f32; MAX_SUMS],
    state: [f32; 2],
    weights: [f32; 2],
) -> Result<(), TestCaseError> {
    const STEP: f32 = 1e-2;
    let used = C::CORE.states();
    let loss = |sums, state| {
        let (new, _) = next(cell, sums, state);
        (0..used).map(|number| weights[number] * new[number]).sum::<f32>()
    };
    let slope = |up: f32, down: f32| (up - down) / (2.0 * STEP);
    let (new, mut by_sums) = next(cell, sums, state);
    let mut by_state = weights;
    cell.gradient(Scalar::new(), &mut by_sums, state, new, &mut by_state);
    for k in 0..C::CORE.sums() {
        let moved = |step| {
            let mut sums = sums;
            sums[k] += step;
            loss(sums, state)
        };
        let expected = slope(moved(STEP), moved(-STEP));
        prop_assert!(
            (by_sums[k] - expected).abs() < 3e-3,
            "{cell:?}: sum {k}: {} {expected}",
            by_sums[k]
        );
    }
    for k in 0..used {
        let moved = |step| {
            let mut state = state;
            state[k] += step;
            loss(sums, state)
        };
        let expected = slope(moved(STEP), moved(-STEP));
        prop_assert!(
            (by_state[k] - expected).abs() < 3e-3,
            "{cell:?}: state {k}: {} {expected}",
            by_state[k]
        );
    }
    Ok(())
}
