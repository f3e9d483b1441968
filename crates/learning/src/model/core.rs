//! A layer of the core, of any kind.

use burn::tensor::Tensor;

use super::{
    fused,
    gru::Gru,
    linear::Linear,
    lstm::Lstm,
    mingru::MinGru,
    minlstm::MinLstm,
    mlp::Mlp,
    scan::step,
    state::{LayerState, at},
};
use eddy_inference::checkpoint::{Core, Description};

/// A layer of the core.
#[derive(Clone, Debug)]
#[expect(clippy::large_enum_variant, reason = "a network has few layers")]
pub(crate) enum RecurrentLayer {
    Mlp(Mlp),
    Lstm(Lstm),
    Gru(Gru),
    MinLstm(MinLstm),
    MinGru(MinGru),
}

impl RecurrentLayer {
    /// A layer of the described core; `linear` creates its parts by name.
    pub(crate) fn new(description: &Description, linear: impl Fn(&str) -> Linear) -> Self {
        let form = description.form;
        match description.core {
            Core::Mlp => Self::Mlp(Mlp {
                linear: linear("linear"),
                activation: description.frame.activation,
            }),
            Core::Lstm => Self::Lstm(Lstm { ih: linear("ih"), hh: linear("hh") }),
            Core::Gru => Self::Gru(Gru { ih: linear("ih"), hh: linear("hh") }),
            Core::MinLstm => Self::MinLstm(MinLstm {
                forget_gate: linear("forget_gate"),
                input_gate: linear("input_gate"),
                candidate: linear("candidate"),
                form,
                normalize_gates: description.normalize_gates,
            }),
            Core::MinGru => {
                Self::MinGru(MinGru { gate: linear("gate"), candidate: linear("candidate"), form })
            }
        }
    }

    /// Its linear parts, in the order of [`layout::core_parts`](eddy_inference::checkpoint::layout::core_parts).
    pub(crate) fn parts(&self) -> Vec<&Linear> {
        match self {
            Self::Mlp(Mlp { linear, .. }) => vec![linear],
            Self::Lstm(Lstm { ih, hh }) | Self::Gru(Gru { ih, hh }) => vec![ih, hh],
            Self::MinLstm(MinLstm { forget_gate, input_gate, candidate, .. }) => {
                vec![forget_gate, input_gate, candidate]
            }
            Self::MinGru(MinGru { gate, candidate, .. }) => vec![gate, candidate],
        }
    }

    /// As [`RecurrentLayer::parts`], to change them.
    pub(crate) fn parts_mut(&mut self) -> Vec<&mut Linear> {
        match self {
            Self::Mlp(Mlp { linear, .. }) => vec![linear],
            Self::Lstm(Lstm { ih, hh }) | Self::Gru(Gru { ih, hh }) => vec![ih, hh],
            Self::MinLstm(MinLstm { forget_gate, input_gate, candidate, .. }) => {
                vec![forget_gate, input_gate, candidate]
            }
            Self::MinGru(MinGru { gate, candidate, .. }) => vec![gate, candidate],
        }
    }

    /// All outputs, `[T, R, H]`, for the inputs, `[T, R, I]`, and the state after the last frame, from the state before the
    /// first (zero if none).
    pub(crate) fn observe(
        &self,
        input: Tensor<3>,
        carried: Option<LayerState>,
    ) -> (Tensor<3>, LayerState) {
        let hidden = carried.as_ref().map(|state| state.hidden.clone());
        let output = match self {
            Self::Mlp(layer) => layer.forward(input),
            Self::Lstm(layer) => return layer.observe(input, carried),
            Self::Gru(layer) => layer.observe(input, hidden),
            Self::MinLstm(layer) => layer.observe(input, hidden),
            Self::MinGru(layer) => layer.observe(input, hidden),
        };
        let last = output.dims()[0] - 1;
        let hidden = at(&output, last);
        (output, LayerState { hidden, cell: None })
    }

    /// The next state, which includes the output, `[R, H]`, for the input, `[R, I]`, from the previous state (zero if none).
    pub(crate) fn step(&self, input: Tensor<2>, carried: Option<LayerState>) -> LayerState {
        if fused::runs_on(&input.device()) {
            return self.observe(input.unsqueeze(), carried).1;
        }
        let hidden = carried.as_ref().map(|state| state.hidden.clone());
        let hidden = match self {
            Self::Mlp(layer) => layer.forward(input),
            Self::Lstm(layer) => return layer.step(input, carried),
            Self::Gru(layer) => layer.step(input, hidden),
            Self::MinLstm(layer) => {
                let (a, b) = layer.coefficients(input);
                step(a, b, hidden)
            }
            Self::MinGru(layer) => {
                let (a, b) = layer.coefficients(input);
                step(a, b, hidden)
            }
        };
        LayerState { hidden, cell: None }
    }
}
