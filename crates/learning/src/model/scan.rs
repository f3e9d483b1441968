//! The linear recurrence h_t = a_t h_{t-1} + b_t over all frames at once.
//!
//! minGRU and minLSTM are linear in the state, with coefficients 0 <= a_t <= 1 that do not depend on it. Pairs (a, b)
//! therefore compose associatively: (a2, b2) after (a1, b1) is (a2 a1, a2 b1 + b2). [`scan`] composes them by recursive
//! doubling, in ceil(log2 T) rounds of operations over whole tensors (Hillis and Steele 1986); no product can overflow.
//! A property test compares it with the recurrence frame by frame.

use burn::tensor::Tensor;

/// All h_t, `[T, R, H]`, from the coefficients `a` and `b`, `[T, R, H]` each, and the state before the first frame, `[R, H]`
/// (zero if none).
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

#[cfg(test)]
mod tests {
    use burn::tensor::{
        Device, TensorData,
        activation::{relu, sigmoid},
    };
    use proptest::prelude::*;

    use super::*;
    use crate::model::{core::candidate, state::at};
    use eddy_inference::ops::cell::Form;

    const ROWS: usize = 3;
    const HIDDEN: usize = 2;

    /// An implementation of minGRU: the states, `[T, R, H]`, from gate, candidate and previous state.
    type Implementation = fn(Form, Tensor<3>, Tensor<3>, Option<Tensor<2>>) -> Tensor<3>;

    /// Tensor operations, all frames at once.
    fn doubling(
        form: Form,
        gate: Tensor<3>,
        c: Tensor<3>,
        carried: Option<Tensor<2>>,
    ) -> Tensor<3> {
        let update = sigmoid(gate);
        scan(1.0 - update.clone(), update * candidate(form, c), carried)
    }

    /// Tensor operations, frame by frame.
    fn sequential(
        form: Form,
        gate: Tensor<3>,
        c: Tensor<3>,
        carried: Option<Tensor<2>>,
    ) -> Tensor<3> {
        let mut state = carried;
        let states = (0..gate.dims()[0]).map(|t| {
            let update = sigmoid(at(&gate, t));
            let c = candidate(form, c.clone().slice([t..t + 1, 0..ROWS, 0..HIDDEN]));
            let entering = update.clone() * at(&c, 0);
            let next = match state.take() {
                None => entering,
                Some(state) => (1.0 - update) * state + entering,
            };
            state = Some(next.clone());
            next
        });
        Tensor::stack(states.collect(), 0)
    }

    /// The log form by cumulative sums of logarithms (Heinsen 2023), as in the reference implementation of Feng et al., with the
    /// carried state as the first entry. Values only.
    fn heinsen(gate: Tensor<3>, c: Tensor<3>, carried: Tensor<2>) -> Tensor<3> {
        let softplus = |x: Tensor<3>| burn::tensor::activation::softplus(x, 1.0);
        let log_g = |c: Tensor<3>| {
            let positive = (relu(c.clone()).add_scalar(0.5)).log();
            let above = c.clone().greater_equal_elem(0.0).float();
            positive * above.clone() + softplus(c.neg()).neg() * (1.0 - above)
        };
        let frames = gate.dims()[0];
        let log_a = softplus(gate.clone()).neg();
        let log_b = softplus(gate.neg()).neg() + log_g(c);
        let log_b = Tensor::cat(vec![carried.log().unsqueeze::<3>(), log_b], 0);
        let first = Tensor::zeros([1, ROWS, HIDDEN], &log_a.device());
        let a = Tensor::cat(vec![first, log_a], 0).cumsum(0);
        let x = log_b - a.clone();
        let largest = x.clone().max_dim(0);
        let sums = (x - largest.clone()).exp().cumsum(0).log() + largest;
        (a + sums).exp().slice([1..frames + 1, 0..ROWS, 0..HIDDEN])
    }

    /// States, and the gradients of a weighted sum of their squares by gate, candidate and previous state.
    fn run(
        implementation: Implementation,
        form: Form,
        numbers: &[(f32, f32)],
        carried: Option<&[f32]>,
    ) -> Vec<Vec<f32>> {
        let device = Device::flex().autodiff();
        let frames = numbers.len() / ROWS / HIDDEN;
        let cube = |values: Vec<f32>| {
            Tensor::<3>::from_data(TensorData::new(values, [frames, ROWS, HIDDEN]), &device)
        };
        let gate = cube(numbers.iter().map(|pair| pair.0).collect()).require_grad();
        let c = cube(numbers.iter().map(|pair| pair.1).collect()).require_grad();
        let carried = carried.map(|values| {
            let data = TensorData::new(values.to_vec(), [ROWS, HIDDEN]);
            Tensor::<2>::from_data(data, &device).require_grad()
        });
        let states = implementation(form, gate.clone(), c.clone(), carried.clone());
        let weights = (0..numbers.len()).map(|i| ((i * 7919) % 101) as f32 / 101.0).collect();
        let gradients = (states.clone().square() * cube(weights)).sum().backward();
        let values = |t: Tensor<3>| t.into_data().try_to_vec::<f32>().unwrap();
        let mut found = vec![
            values(states.inner()),
            values(gate.grad(&gradients).unwrap()),
            values(c.grad(&gradients).unwrap()),
        ];
        let by_carried = carried.map(|carried| carried.grad(&gradients).unwrap());
        found.extend(by_carried.map(|by| by.into_data().try_to_vec().unwrap()));
        found
    }

    /// Lengths from 1 to 1,024, log-uniform.
    fn frames() -> impl Strategy<Value = usize> {
        (0u32..=10).prop_flat_map(|power| (1usize << power) / 2 + 1..=1 << power)
    }

    fn numbers() -> impl Strategy<Value = Vec<(f32, f32)>> {
        frames().prop_flat_map(|frames| {
            proptest::collection::vec((-6f32..6.0, -2f32..2.0), frames * ROWS * HIDDEN)
        })
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]
        /// The previous state is absent, zero, or arbitrary.
        #[test]
        fn all_frames_at_once_equal_single_steps_in_values_and_gradients(
            numbers in numbers(),
            form in prop_oneof![Just(Form::Plain), Just(Form::Log)],
            carried in prop_oneof![
                Just(None),
                Just(Some(vec![0.0; ROWS * HIDDEN])),
                proptest::collection::vec(-2f32..2.0, ROWS * HIDDEN).prop_map(Some),
            ],
        ) {
            let carried = carried.as_deref();
            let expected = run(sequential, form, &numbers, carried);
            let found = run(doubling, form, &numbers, carried);
            prop_assert_eq!(found.len(), expected.len());
            for (found, expected) in found.iter().flatten().zip(expected.iter().flatten()) {
                prop_assert!((found - expected).abs() <= 2e-5 * (1.0 + expected.abs()));
            }
        }

        /// Few frames: over many, sums of exponentials lose the early terms.
        #[test]
        fn the_log_form_equals_a_scan_of_logarithms(
            numbers in (1usize..=12).prop_flat_map(|frames| {
                proptest::collection::vec((-4f32..4.0, -2f32..2.0), frames * ROWS * HIDDEN)
            }),
            carried in proptest::collection::vec(0.01f32..2.0, ROWS * HIDDEN),
        ) {
            let device = Device::flex();
            let frames = numbers.len() / ROWS / HIDDEN;
            let cube = |values: Vec<f32>| {
                Tensor::<3>::from_data(TensorData::new(values, [frames, ROWS, HIDDEN]), &device)
            };
            let gate = cube(numbers.iter().map(|pair| pair.0).collect());
            let c = cube(numbers.iter().map(|pair| pair.1).collect());
            let before = TensorData::new(carried, [ROWS, HIDDEN]);
            let before = Tensor::<2>::from_data(before, &device);
            let values = |t: Tensor<3>| t.into_data().try_to_vec::<f32>().unwrap();
            let found = values(sequential(Form::Log, gate.clone(), c.clone(), Some(before.clone())));
            let expected = values(heinsen(gate, c, before));
            for (found, expected) in found.iter().zip(&expected) {
                prop_assert!((found - expected).abs() <= 1e-4 * (1.0 + expected.abs()));
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
