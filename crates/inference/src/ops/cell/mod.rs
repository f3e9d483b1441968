//! The recurrent cells: the new state of each unit from its last state and the outputs of the layer's linear parts, its sums.
//!
//! s is the logistic function, f the network's activation; g(c) is c, in the log form c + 1/2 for c >= 0 and s(c) below. A sum
//! consists of W x + b, with the input x, and in GRU and LSTM of W h + b, with the last output h, too.
//!
//! | core | sums of a unit | new state |
//! |---|---|---|
//! | MLP | a | h' = f(a) |
//! | minGRU | z, c | h' = (1 - s(z)) h + s(z) g(c) (Feng et al. 2024, section 3.1; the paper's Fig. 6) |
//! | minLSTM | f, i, c | h' = s(f) h + s(i) g(c), normalised (1 - u) h + u g(c) with u = s(i) / (s(f) + s(i)) (section 3.2) |
//! | GRU | r, z, n, and apart from n its part m that depends on h | h' = (1 - s(z)) n' + s(z) h with n' = tanh(n + s(r) m) (Cho et al. 2014, as in PyTorch) |
//! | LSTM | i, f, g, o | c' = s(f) c + s(i) tanh(g), h' = s(o) tanh(c') (Hochreiter and Schmidhuber 1997, with the forget gate of Gers et al. 2000) |
//!
//! 1. This file: what each core consists of ([`Core`]), and its [`Cell`] with the gradient.
//! 2. [`parallel`]: MLP, minGRU and minLSTM over all frames, for training: their sums do not depend on the state.
//! 3. [`recurrent`]: GRU and LSTM frame by frame, for training.
//! 4. `device.cu`, [`DEVICE`]: the cells on GPUs.
//!
//! For prediction, [`engine`](crate::engine) computes the sums and the new state of a few units at once. The definition in burn
//! is `model/core.rs` of `eddy-learning`, the one in PyTorch `tests/peers/torch_core.py`.

pub mod parallel;
pub mod recurrent;
#[cfg(test)]
mod tests;

use pulp::Simd;
use serde::{Deserialize, Serialize};

use crate::{
    checkpoint::{Activation, Description},
    kernels::{
        activation::Activate,
        math::{positive, sigmoid, tanh},
    },
};

/// The cells on GPUs: `cell_forward` and `cell_gradient` of the core that [`Core::definitions`] names.
pub const DEVICE: &str = include_str!("device.cu");

/// The recurrent core of a network.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
#[serde(rename_all = "lowercase")]
pub enum Core {
    /// No recurrence: a linear layer and an activation, the paper's baseline.
    Mlp,
    /// Long short-term memory (Hochreiter and Schmidhuber 1997), as in PyTorch.
    Lstm,
    /// Gated recurrent unit (Cho et al. 2014), as in PyTorch.
    Gru,
    /// Forget gate, input gate, candidate (Feng et al. 2024, section 3.2).
    #[cfg_attr(feature = "clap", value(name = "minlstm"))]
    MinLstm,
    /// One gate, one candidate (Feng et al. 2024, section 3.1).
    #[default]
    #[cfg_attr(feature = "clap", value(name = "mingru"))]
    MinGru,
}

impl Core {
    /// All cores, in the paper's order.
    pub const ALL: [Self; 5] = [Self::Mlp, Self::Lstm, Self::Gru, Self::MinLstm, Self::MinGru];

    /// Its name in files and on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Mlp => "mlp",
            Self::Lstm => "lstm",
            Self::Gru => "gru",
            Self::MinLstm => "minlstm",
            Self::MinGru => "mingru",
        }
    }

    /// The linear parts of a layer that read its input, with the number of gates of each.
    pub const fn input_parts(self) -> &'static [(&'static str, usize)] {
        match self {
            Self::Mlp => &[("linear", 1)],
            Self::Lstm => &[("ih", 4)],
            Self::Gru => &[("ih", 3)],
            Self::MinLstm => &[("forget_gate", 1), ("input_gate", 1), ("candidate", 1)],
            Self::MinGru => &[("gate", 1), ("candidate", 1)],
        }
    }

    /// The linear part of a layer that reads its last output, with as many gates as read the input, if there is one.
    pub const fn recurrent_part(self) -> Option<&'static str> {
        match self {
            Self::Lstm | Self::Gru => Some("hh"),
            Self::Mlp | Self::MinLstm | Self::MinGru => None,
        }
    }

    /// Gates that a layer computes from its input.
    pub const fn gates(self) -> usize {
        let (mut gates, mut part) = (0, 0);
        while part < self.input_parts().len() {
            gates += self.input_parts()[part].1;
            part += 1;
        }
        gates
    }

    /// The gate whose part that depends on the last output is a sum of its own, behind the gates; it is the last gate.
    pub const fn split_gate(self) -> Option<usize> {
        match self {
            // The reset gate scales it.
            Self::Gru => Some(2),
            Self::Mlp | Self::Lstm | Self::MinLstm | Self::MinGru => None,
        }
    }

    /// Sums of a unit.
    pub const fn sums(self) -> usize {
        self.gates() + self.split_gate().is_some() as usize
    }

    /// Whether the new state depends on the last one.
    pub const fn remembers(self) -> bool {
        !matches!(self, Self::Mlp)
    }

    /// Numbers of a unit's state: its output, and the cell of LSTM.
    pub const fn states(self) -> usize {
        match self {
            Self::Lstm => 2,
            Self::Mlp | Self::Gru | Self::MinLstm | Self::MinGru => 1,
        }
    }

    /// Names of weight and bias of a linear part.
    pub fn tensors(self, layer: usize, part: &str) -> [String; 2] {
        ["weight", "bias"].map(|tensor| match self {
            Self::Lstm | Self::Gru => format!("core.{tensor}_{part}_l{layer}"),
            Self::Mlp | Self::MinLstm | Self::MinGru => format!("core.{layer}.{part}.{tensor}"),
        })
    }

    /// What [`DEVICE`] is compiled for.
    pub fn definitions(self) -> [(&'static str, usize); 6] {
        let name = match self {
            Self::Mlp => "MLP",
            Self::Lstm => "LSTM",
            Self::Gru => "GRU",
            Self::MinLstm => "MINLSTM",
            Self::MinGru => "MINGRU",
        };
        [
            (name, 1),
            ("GATES", self.gates()),
            ("RECURRENT", self.recurrent_part().is_some().into()),
            ("SPLIT_GATE", self.split_gate().unwrap_or(self.gates())),
            ("REMEMBERS", self.remembers().into()),
            ("STATES", self.states()),
        ]
    }
}

/// The form of the minimal recurrences; other cores have only the plain form.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Form {
    /// Candidates enter the state unchanged (the paper's Fig. 6).
    #[default]
    Plain,
    /// Candidates pass through g(x) = x + 1/2 for x >= 0 and sigmoid(x) below, which is positive, so that the recurrence can be
    /// computed in logarithms (Feng et al. 2024, appendix B). This is a different model.
    Log,
}

/// Most sums of a unit.
pub const MAX_SUMS: usize = 4;
/// Added to s(f) + s(i), which is zero in f32 if both gates are closed.
pub const MIN_GATE_SUM: f32 = 1e-12;

/// The state of some units: output, and the cell of LSTM.
pub type State<S> = [<S as Simd>::f32s; 2];

/// A cell, for some units at once.
pub trait Cell: Copy + std::fmt::Debug + Send + Sync + 'static {
    /// The core that this cell belongs to.
    const CORE: Core;

    /// The new state in place of the last one. In GRU and LSTM, what the gradient needs takes the place of `sums`.
    fn next<S: Simd>(self, simd: S, sums: &mut [S::f32s], state: &mut State<S>);

    /// The gradients by the sums in their place, and by the last state in the place of those by the new one, `by`. The sums are
    /// as [`Cell::next`] left them. In GRU and LSTM, the gradient by the last output lacks its part through the sums.
    fn gradient<S: Simd>(
        self,
        simd: S,
        sums: &mut [S::f32s],
        last: State<S>,
        new: State<S>,
        by: &mut State<S>,
    );
}

/// A linear layer and an activation, without recurrence.
#[derive(Clone, Copy, Debug)]
pub struct Mlp {
    /// f.
    pub activation: Activation,
}

impl Cell for Mlp {
    const CORE: Core = Core::Mlp;

    #[inline(always)]
    fn next<S: Simd>(self, simd: S, sums: &mut [S::f32s], state: &mut State<S>) {
        state[0] = self.activation.value(simd, sums[0]);
    }

    #[inline(always)]
    fn gradient<S: Simd>(
        self,
        simd: S,
        sums: &mut [S::f32s],
        _: State<S>,
        [output, _]: State<S>,
        by: &mut State<S>,
    ) {
        sums[0] = simd.mul_f32s(by[0], self.activation.slope(simd, sums[0], output));
        by[0] = simd.splat_f32s(0.0);
    }
}

/// One gate, one candidate.
#[derive(Clone, Copy, Debug)]
pub struct MinGru {
    /// Of the candidate.
    pub form: Form,
}

impl Cell for MinGru {
    const CORE: Core = Core::MinGru;

    #[inline(always)]
    fn next<S: Simd>(self, simd: S, sums: &mut [S::f32s], state: &mut State<S>) {
        let update = sigmoid(simd, sums[0]);
        let (candidate, _) = self.form.candidate(simd, sums[1]);
        state[0] = mix(simd, update, state[0], candidate);
    }

    #[inline(always)]
    fn gradient<S: Simd>(
        self,
        simd: S,
        sums: &mut [S::f32s],
        [last, _]: State<S>,
        _: State<S>,
        by: &mut State<S>,
    ) {
        let (candidate, slope) = self.form.candidate(simd, sums[1]);
        let update = sigmoid(simd, sums[0]);
        let kept = simd.sub_f32s(simd.splat_f32s(1.0), update);
        let by_update = simd.mul_f32s(by[0], simd.sub_f32s(candidate, last));
        sums[0] = simd.mul_f32s(by_update, simd.mul_f32s(update, kept));
        sums[1] = simd.mul_f32s(simd.mul_f32s(by[0], update), slope);
        by[0] = simd.mul_f32s(by[0], kept);
    }
}

/// Forget gate, input gate, candidate.
#[derive(Clone, Copy, Debug)]
pub struct MinLstm {
    /// Of the candidate.
    pub form: Form,
    /// Whether the gates are divided by their sum.
    pub normalize: bool,
}

impl Cell for MinLstm {
    const CORE: Core = Core::MinLstm;

    #[inline(always)]
    fn next<S: Simd>(self, simd: S, sums: &mut [S::f32s], state: &mut State<S>) {
        let (forget, input) = (sigmoid(simd, sums[0]), sigmoid(simd, sums[1]));
        let (candidate, _) = self.form.candidate(simd, sums[2]);
        state[0] = if self.normalize {
            let sum = simd.add_f32s(forget, input);
            let sum = simd.add_f32s(sum, simd.splat_f32s(MIN_GATE_SUM));
            mix(simd, simd.div_f32s(input, sum), state[0], candidate)
        } else {
            simd.mul_add_e_f32s(forget, state[0], simd.mul_f32s(input, candidate))
        };
    }

    #[inline(always)]
    fn gradient<S: Simd>(
        self,
        simd: S,
        sums: &mut [S::f32s],
        [last, _]: State<S>,
        _: State<S>,
        by: &mut State<S>,
    ) {
        let one = simd.splat_f32s(1.0);
        let (candidate, slope) = self.form.candidate(simd, sums[2]);
        let (forget, input) = (sigmoid(simd, sums[0]), sigmoid(simd, sums[1]));
        let (by_last, by_forget, by_input, by_candidate);
        if self.normalize {
            let sum = simd.add_f32s(forget, input);
            let inverse = simd.div_f32s(one, simd.add_f32s(sum, simd.splat_f32s(MIN_GATE_SUM)));
            let share = simd.mul_f32s(input, inverse);
            let kept = simd.sub_f32s(one, share);
            // The derivatives of the share i / (f + i) are (1 - share) / (f + i) by i and -share / (f + i) by f.
            let by_share = simd.mul_f32s(by[0], simd.sub_f32s(candidate, last));
            let by_share = simd.mul_f32s(by_share, inverse);
            by_last = simd.mul_f32s(by[0], kept);
            by_forget = simd.neg_f32s(simd.mul_f32s(by_share, share));
            by_input = simd.mul_f32s(by_share, kept);
            by_candidate = simd.mul_f32s(by[0], share);
        } else {
            by_last = simd.mul_f32s(by[0], forget);
            by_forget = simd.mul_f32s(by[0], last);
            by_input = simd.mul_f32s(by[0], candidate);
            by_candidate = simd.mul_f32s(by[0], input);
        }
        sums[0] = simd.mul_f32s(by_forget, sigmoid_slope(simd, forget));
        sums[1] = simd.mul_f32s(by_input, sigmoid_slope(simd, input));
        sums[2] = simd.mul_f32s(by_candidate, slope);
        by[0] = by_last;
    }
}

/// Reset gate, update gate, candidate.
#[derive(Clone, Copy, Debug)]
pub struct Gru;

impl Cell for Gru {
    const CORE: Core = Core::Gru;

    #[inline(always)]
    fn next<S: Simd>(self, simd: S, sums: &mut [S::f32s], state: &mut State<S>) {
        let [reset, update] = [sigmoid(simd, sums[0]), sigmoid(simd, sums[1])];
        let candidate = tanh(simd, simd.mul_add_e_f32s(reset, sums[3], sums[2]));
        (sums[0], sums[1], sums[2]) = (reset, update, candidate);
        state[0] = simd.mul_add_e_f32s(update, simd.sub_f32s(state[0], candidate), candidate);
    }

    #[inline(always)]
    fn gradient<S: Simd>(
        self,
        simd: S,
        sums: &mut [S::f32s],
        [last, _]: State<S>,
        _: State<S>,
        by: &mut State<S>,
    ) {
        let one = simd.splat_f32s(1.0);
        let (reset, update, candidate, apart) = (sums[0], sums[1], sums[2], sums[3]);
        let by_candidate = simd.mul_f32s(by[0], simd.sub_f32s(one, update));
        let by_candidate = simd.mul_f32s(by_candidate, tanh_slope(simd, candidate));
        let by_reset = simd.mul_f32s(by_candidate, apart);
        let by_update = simd.mul_f32s(by[0], simd.sub_f32s(last, candidate));
        sums[0] = simd.mul_f32s(by_reset, sigmoid_slope(simd, reset));
        sums[1] = simd.mul_f32s(by_update, sigmoid_slope(simd, update));
        sums[2] = by_candidate;
        sums[3] = simd.mul_f32s(by_candidate, reset);
        by[0] = simd.mul_f32s(by[0], update);
    }
}

/// Input gate, forget gate, candidate, output gate.
#[derive(Clone, Copy, Debug)]
pub struct Lstm;

impl Cell for Lstm {
    const CORE: Core = Core::Lstm;

    #[inline(always)]
    fn next<S: Simd>(self, simd: S, sums: &mut [S::f32s], state: &mut State<S>) {
        for gate in [0, 1, 3] {
            sums[gate] = sigmoid(simd, sums[gate]);
        }
        sums[2] = tanh(simd, sums[2]);
        state[1] = simd.mul_add_e_f32s(sums[1], state[1], simd.mul_f32s(sums[0], sums[2]));
        state[0] = simd.mul_f32s(sums[3], tanh(simd, state[1]));
    }

    #[inline(always)]
    fn gradient<S: Simd>(
        self,
        simd: S,
        sums: &mut [S::f32s],
        [_, last]: State<S>,
        [_, new]: State<S>,
        by: &mut State<S>,
    ) {
        let (input, forget, candidate, output) = (sums[0], sums[1], sums[2], sums[3]);
        let bent = tanh(simd, new);
        let through = simd.mul_f32s(simd.mul_f32s(by[0], output), tanh_slope(simd, bent));
        let by_cell = simd.add_f32s(by[1], through);
        let by_gate = |by, gate| simd.mul_f32s(by, sigmoid_slope(simd, gate));
        sums[0] = by_gate(simd.mul_f32s(by_cell, candidate), input);
        sums[1] = by_gate(simd.mul_f32s(by_cell, last), forget);
        sums[2] = simd.mul_f32s(simd.mul_f32s(by_cell, input), tanh_slope(simd, candidate));
        sums[3] = by_gate(simd.mul_f32s(by[0], bent), output);
        *by = [simd.splat_f32s(0.0), simd.mul_f32s(by_cell, forget)];
    }
}

impl Form {
    /// g(c) and its derivative.
    #[inline(always)]
    fn candidate<S: Simd>(self, simd: S, candidate: S::f32s) -> (S::f32s, S::f32s) {
        let one = simd.splat_f32s(1.0);
        match self {
            Self::Plain => (candidate, one),
            Self::Log => {
                let value = positive(simd, candidate);
                let above = simd.greater_than_f32s(candidate, simd.splat_f32s(0.0));
                (value, simd.select_f32s(above, one, sigmoid_slope(simd, value)))
            }
        }
    }
}

/// (1 - update) last + update candidate.
#[inline(always)]
fn mix<S: Simd>(simd: S, update: S::f32s, last: S::f32s, candidate: S::f32s) -> S::f32s {
    let kept = simd.sub_f32s(simd.splat_f32s(1.0), update);
    simd.mul_add_e_f32s(kept, last, simd.mul_f32s(update, candidate))
}

/// The derivative of a sigmoid with value y: y (1 - y).
#[inline(always)]
fn sigmoid_slope<S: Simd>(simd: S, y: S::f32s) -> S::f32s {
    simd.mul_f32s(y, simd.sub_f32s(simd.splat_f32s(1.0), y))
}

/// The derivative of a hyperbolic tangent with value y: 1 - y y.
#[inline(always)]
fn tanh_slope<S: Simd>(simd: S, y: S::f32s) -> S::f32s {
    simd.sub_f32s(simd.splat_f32s(1.0), simd.mul_f32s(y, y))
}

/// The cell of a network.
#[derive(Clone, Copy, Debug)]
#[expect(missing_docs, reason = "as in `Core`")]
pub enum AnyCell {
    Mlp(Mlp),
    MinGru(MinGru),
    MinLstm(MinLstm),
    Gru(Gru),
    Lstm(Lstm),
}

impl AnyCell {
    /// The cell of the described network.
    pub fn new(description: &Description) -> Self {
        let form = description.form;
        match description.core {
            Core::Mlp => Self::Mlp(Mlp { activation: description.frame.activation }),
            Core::MinGru => Self::MinGru(MinGru { form }),
            Core::MinLstm => {
                Self::MinLstm(MinLstm { form, normalize: description.normalize_gates })
            }
            Core::Gru => Self::Gru(Gru),
            Core::Lstm => Self::Lstm(Lstm),
        }
    }
}

/// Runs `$body` with `$cell`, the [`Cell`] in an [`AnyCell`], and `$gates`, the constant number of its gates.
#[macro_export]
macro_rules! with_cell {
    ($any:expr, |$cell:ident, $gates:tt| $body:expr) => {
        $crate::with_cell!(@ $any, $cell, $gates, $body, Mlp MinGru MinLstm Gru Lstm)
    };
    (@ $any:expr, $cell:ident, $gates:tt, $body:expr, $($variant:ident)*) => {
        match $any {
            $($crate::ops::cell::AnyCell::$variant($cell) => {
                const $gates: usize = $crate::ops::cell::Core::$variant.gates();
                $body
            })*
        }
    };
}
