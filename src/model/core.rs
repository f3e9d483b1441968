//! Recurrent layers: each turns its input into the coefficients of h_t = a_t h_{t-1} + b_t.

use burn::{module::Module, nn::Linear, tensor::Tensor};

use super::{
    mingru::MinGru,
    minlstm::MinLstm,
    scan::{scan, step},
};
use crate::checkpoint::Core;

/// One recurrent layer. Its output is its state.
#[derive(Module, Debug)]
pub(crate) enum RecurrentLayer {
    MinGru(MinGru),
    MinLstm(MinLstm),
}

impl RecurrentLayer {
    /// A layer of the given kind; `linear` makes its parts by name.
    pub(crate) fn new(core: Core, linear: impl Fn(&str) -> Linear) -> Self {
        match core {
            Core::MinGru => {
                Self::MinGru(MinGru { gate: linear("gate"), candidate: linear("candidate") })
            }
            Core::MinLstm => Self::MinLstm(MinLstm {
                forget_gate: linear("forget_gate"),
                input_gate: linear("input_gate"),
                candidate: linear("candidate"),
            }),
        }
    }

    /// Its linear parts by name.
    pub(crate) fn parts(&self) -> impl Iterator<Item = (&'static str, &Linear)> {
        let parts = match self {
            Self::MinGru(MinGru { gate, candidate }) => {
                vec![("gate", gate), ("candidate", candidate)]
            }
            Self::MinLstm(MinLstm { forget_gate, input_gate, candidate }) => vec![
                ("forget_gate", forget_gate),
                ("input_gate", input_gate),
                ("candidate", candidate),
            ],
        };
        parts.into_iter()
    }

    /// The coefficients (a, b), each of the input's shape `[.., H]`.
    pub(crate) fn coefficients<const D: usize>(&self, input: Tensor<D>) -> (Tensor<D>, Tensor<D>) {
        match self {
            Self::MinGru(layer) => layer.coefficients(input),
            Self::MinLstm(layer) => layer.coefficients(input),
        }
    }

    /// All states `[T, R, H]` for the inputs `[T, R, H]`, from the state before them (zero if not
    /// given).
    pub(crate) fn scan(&self, input: Tensor<3>, carried: Option<Tensor<2>>) -> Tensor<3> {
        let (a, b) = self.coefficients(input);
        scan(a, b, carried)
    }

    /// The next state `[R, H]` for the input `[R, H]` (from zero if no state is given).
    pub(crate) fn step(&self, input: Tensor<2>, carried: Option<Tensor<2>>) -> Tensor<2> {
        let (a, b) = self.coefficients(input);
        match carried {
            None => b,
            Some(state) => step(a, b, state),
        }
    }
}
