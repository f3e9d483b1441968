//! h_t = a_t h_{t-1} + b_t: over all frames at once, and one frame at a time.
//!
//! The plain form of minGRU and minLSTM is linear in the state with coefficients 0 <= a_t <= 1 that
//! do not depend on it, so that pairs (a, b) compose associatively:
//! (a2, b2) after (a1, b1) is (a2 a1, a2 b1 + b2). [`scan`] composes them by recursive doubling, in
//! ceil(log2 T) rounds of operations over whole tensors (Hillis and Steele 1986); no product can
//! overflow. [`step`] is the same recurrence for one frame; a property test joins the two.

use burn::tensor::{
    Tensor,
    activation::{relu, sigmoid},
};

use crate::checkpoint::Form;

/// Every h_t, `[T, R, H]`, from the coefficients `a` and `b`, both `[T, R, H]`, and the state before
/// the first frame, `[R, H]` (zero if not given).
pub(crate) fn scan(a: Tensor<3>, b: Tensor<3>, carried: Option<Tensor<2>>) -> Tensor<3> {
    let [frames, rows, hidden] = b.dims();
    let part = |tensor: &Tensor<3>, range: std::ops::Range<usize>| {
        tensor.clone().slice([range, 0..rows, 0..hidden])
    };
    let mut a = a;
    let mut b = match carried {
        None => b,
        Some(state) => {
            let first = part(&a, 0..1) * state.unsqueeze::<3>() + part(&b, 0..1);
            if frames == 1 { first } else { Tensor::cat(vec![first, part(&b, 1..frames)], 0) }
        }
    };
    let mut reach = 1; // b_t holds the composition of the last `reach` frames
    while reach < frames {
        let (early, late) = (0..frames - reach, reach..frames);
        let composed = part(&a, late.clone()) * part(&b, early.clone()) + part(&b, late.clone());
        b = Tensor::cat(vec![part(&b, 0..reach), composed], 0);
        if 2 * reach < frames {
            let composed = part(&a, late) * part(&a, early);
            a = Tensor::cat(vec![part(&a, 0..reach), composed], 0);
        }
        reach *= 2;
    }
    b // [T, R, H]
}

/// The next state, `[R, H]`, from the state before (zero if not given).
pub(crate) fn step(a: Tensor<2>, b: Tensor<2>, carried: Option<Tensor<2>>) -> Tensor<2> {
    match carried {
        None => b,
        Some(state) => a * state + b,
    }
}

/// What enters the state where the gate is open: the candidate itself, or in the log form
/// g(c) = c + 1/2 for c >= 0 and sigmoid(c) below. In that form too the recurrence is computed as it
/// stands: 0 <= a <= 1 keeps it from overflowing, and a zero state needs no logarithm.
pub(crate) fn candidate<const D: usize>(form: Form, candidate: Tensor<D>) -> Tensor<D> {
    match form {
        Form::Plain => candidate,
        // sigmoid(min(c, 0)) is 1/2 for c >= 0.
        Form::Log => relu(candidate.clone()) + sigmoid(candidate.clamp_max(0.0)),
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::{Device, TensorData};
    use proptest::prelude::*;

    use super::*;

    const ROWS: usize = 3;
    const HIDDEN: usize = 2;

    /// States and the gradients of sum(h^2) by a, b and the carried state, computed both ways.
    fn both_ways(a: &[f32], b: &[f32], carried: &[f32], frames: usize) -> [Vec<Vec<f32>>; 2] {
        let device = Device::flex().autodiff();
        let cube = |values: &[f32]| {
            let data = TensorData::new(values.to_vec(), [frames, ROWS, HIDDEN]);
            Tensor::<3>::from_data(data, &device).require_grad()
        };
        [true, false].map(|parallel| {
            let (a, b) = (cube(a), cube(b));
            let data = TensorData::new(carried.to_vec(), [ROWS, HIDDEN]);
            let start = Tensor::<2>::from_data(data, &device).require_grad();
            let states = if parallel {
                scan(a.clone(), b.clone(), Some(start.clone()))
            } else {
                let mut state = start.clone();
                let mut states = Vec::new();
                for t in 0..frames {
                    let at = |x: &Tensor<3>| {
                        x.clone().slice([t..t + 1, 0..ROWS, 0..HIDDEN]).squeeze_dim::<2>(0)
                    };
                    state = step(at(&a), at(&b), Some(state));
                    states.push(state.clone());
                }
                Tensor::stack(states, 0)
            };
            let gradients = states.clone().square().sum().backward();
            let numbers =
                |t: Option<Tensor<3>>| t.unwrap().into_data().try_to_vec::<f32>().unwrap();
            vec![
                states.inner().into_data().try_to_vec().unwrap(),
                numbers(a.grad(&gradients)),
                numbers(b.grad(&gradients)),
                start.grad(&gradients).unwrap().into_data().try_to_vec().unwrap(),
            ]
        })
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]
        #[test]
        fn the_scan_equals_single_steps_in_values_and_gradients(
            frames in 1usize..=64,
            seed in proptest::collection::vec((0f32..1.0, -1f32..1.0), 64 * ROWS * HIDDEN),
            carried in prop_oneof![
                Just(vec![0.0; ROWS * HIDDEN]),
                proptest::collection::vec(-2f32..2.0, ROWS * HIDDEN),
            ],
        ) {
            let count = frames * ROWS * HIDDEN;
            let (a, b): (Vec<f32>, Vec<f32>) = seed[..count].iter().copied().unzip();
            let [parallel, sequential] = both_ways(&a, &b, &carried, frames);
            for (found, expected) in parallel.iter().flatten().zip(sequential.iter().flatten()) {
                prop_assert!((found - expected).abs() <= 1e-5 * (1.0 + expected.abs()));
            }
        }
    }

    #[test]
    fn without_a_carried_state_the_scan_starts_from_zero() {
        let device = Device::flex();
        let a = Tensor::<3>::full([5, ROWS, HIDDEN], 0.5, &device);
        let b = Tensor::<3>::ones([5, ROWS, HIDDEN], &device);
        let zero = Tensor::<2>::zeros([ROWS, HIDDEN], &device);
        let with = scan(a.clone(), b.clone(), Some(zero)).into_data().try_to_vec::<f32>().unwrap();
        let without = scan(a, b, None).into_data().try_to_vec::<f32>().unwrap();
        assert_eq!(with, without);
        assert_eq!(without[4 * ROWS * HIDDEN], 1.9375);
    }
}
