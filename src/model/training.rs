//! The networks' layers as [`fused`](super::fused) operations: which kernel computes which.

use std::sync::Arc;

use burn::tensor::Tensor;
use rayon::prelude::*;

use super::{
    fused::{Operation, apply, input},
    sparse::Table,
    surroundings::{FULL, Ground, LEAST_MASS},
};
use crate::{
    checkpoint::{Activation, layout::NODE_FEATURES},
    kernels::{
        activation::{Elu, Relu, Sigmoid, Tanh},
        encoder::{Encoder, Gradients},
        gathered::{Convolution, Down, Up},
        gru::{self, Gru},
        linear::Linear,
        lstm::{self, Lstm},
        minimal::Minimal,
        nodes::Nodes,
        rest::{Rest, SHAPE_FEATURES},
        transfer::{by_position, mass, to_nodes, to_particles},
    },
};

/// A linear layer: `input` `[R, I]`, `weight` `[I, O]` and `bias` `[O]` to `[R, O]`.
pub(crate) fn linear(input: Tensor<2>, weight: Tensor<2>, bias: Tensor<1>) -> Tensor<2> {
    let shape = [input.dims()[0], bias.dims()[0]];
    apply(
        LinearLayer { rectified: false },
        [self::input(input), self::input(weight), self::input(bias)],
        shape,
    )
}

/// The same with a ReLU behind it.
pub(crate) fn rectified(input: Tensor<2>, weight: Tensor<2>, bias: Tensor<1>) -> Tensor<2> {
    let shape = [input.dims()[0], bias.dims()[0]];
    apply(
        LinearLayer { rectified: true },
        [self::input(input), self::input(weight), self::input(bias)],
        shape,
    )
}

#[derive(Clone, Copy, Debug)]
struct LinearLayer {
    /// Whether there is a ReLU behind it.
    rectified: bool,
}

impl Operation<3> for LinearLayer {
    type Kept = ();

    fn forward(&self, [input, weight, bias]: [&[f32]; 3]) -> (Vec<f32>, ()) {
        let mut output = Linear { weight, bias }.forward(input);
        if self.rectified {
            rectify(&mut output);
        }
        (output, ())
    }

    fn backward(
        &self,
        [input, weight, bias]: [&[f32]; 3],
        output: &[f32],
        (): (),
        gradient: &[f32],
        [by_input, by_weight, _]: [bool; 3],
    ) -> [Vec<f32>; 3] {
        let passed: Vec<f32>;
        let gradient = if self.rectified {
            passed = passed_on(output, gradient);
            &passed
        } else {
            gradient
        };
        let by = Linear { weight, bias }.backward(input, gradient, by_input, by_weight);
        [by.input, by.weight, by.bias]
    }
}

/// Mean over the particles of the activated linear layer: `points` `[B N, F]`, `weight` `[F, E]` and
/// `bias` `[E]` to `[B, E]`. `F` is 5 or 8.
pub(crate) fn encode(
    activation: Activation,
    particles: usize,
    points: Tensor<2>,
    weight: Tensor<2>,
    bias: Tensor<1>,
) -> Tensor<2> {
    let [rows, features] = points.dims();
    let shape = [rows / particles, bias.dims()[0]];
    let inputs = [input(points), input(weight), input(bias)];
    let kind = Encode { activation, particles };
    match features {
        5 => apply(EncodeOf::<5>(kind), inputs, shape),
        8 => apply(EncodeOf::<8>(kind), inputs, shape),
        other => unreachable!("{other} features: materials enter as one number or as four"),
    }
}

#[derive(Clone, Copy, Debug)]
struct Encode {
    activation: Activation,
    particles: usize,
}

#[derive(Clone, Copy, Debug)]
struct EncodeOf<const F: usize>(Encode);

impl<const F: usize> Operation<3> for EncodeOf<F> {
    type Kept = ();

    fn forward(&self, [points, weight, bias]: [&[f32]; 3]) -> (Vec<f32>, ()) {
        let Encode { activation, particles } = self.0;
        let layer = Encoder::<F> { weight, bias, particles };
        let means = match activation {
            Activation::Sigmoid => layer.forward(Sigmoid, points),
            Activation::Tanh => layer.forward(Tanh, points),
            Activation::Relu => layer.forward(Relu, points),
            Activation::Elu => layer.forward(Elu, points),
        };
        (means, ())
    }

    fn backward(
        &self,
        [points, weight, bias]: [&[f32]; 3],
        _means: &[f32],
        (): (),
        gradient: &[f32],
        [by_points, _, _]: [bool; 3],
    ) -> [Vec<f32>; 3] {
        let Encode { activation, particles } = self.0;
        let layer = Encoder::<F> { weight, bias, particles };
        let Gradients { points, weight, bias } = match activation {
            Activation::Sigmoid => layer.backward(Sigmoid, points, gradient, by_points),
            Activation::Tanh => layer.backward(Tanh, points, gradient, by_points),
            Activation::Relu => layer.backward(Relu, points, gradient, by_points),
            Activation::Elu => layer.backward(Elu, points, gradient, by_points),
        };
        [points, weight, bias]
    }
}

/// The states of minGRU: gate and candidate `[T, R, H]`, the state before `[R, H]`, to `[T, R, H]`.
pub(crate) fn mingru(
    kind: Minimal,
    gate: Tensor<3>,
    candidate: Tensor<3>,
    carried: Tensor<2>,
) -> Tensor<3> {
    let shape = gate.dims();
    apply(kind, [input(gate), input(candidate), input(carried)], shape)
}

impl Operation<3> for Minimal {
    type Kept = ();

    fn forward(&self, [gate, candidate, carried]: [&[f32]; 3]) -> (Vec<f32>, ()) {
        (Minimal::forward(*self, [gate], candidate, carried), ())
    }

    fn backward(
        &self,
        [gate, candidate, carried]: [&[f32]; 3],
        states: &[f32],
        (): (),
        gradient: &[f32],
        _wanted: [bool; 3],
    ) -> [Vec<f32>; 3] {
        let by = Minimal::backward(*self, [gate], candidate, carried, states, gradient);
        let [gate] = by.gates;
        [gate, by.candidate, by.carried]
    }
}

/// The states of minLSTM: gates and candidate `[T, R, H]`, the state before `[R, H]`, to `[T, R, H]`.
pub(crate) fn minlstm(
    kind: Minimal,
    [forget, update]: [Tensor<3>; 2],
    candidate: Tensor<3>,
    carried: Tensor<2>,
) -> Tensor<3> {
    let shape = forget.dims();
    apply(kind, [input(forget), input(update), input(candidate), input(carried)], shape)
}

impl Operation<4> for Minimal {
    type Kept = ();

    fn forward(&self, [forget, update, candidate, carried]: [&[f32]; 4]) -> (Vec<f32>, ()) {
        (Minimal::forward(*self, [forget, update], candidate, carried), ())
    }

    fn backward(
        &self,
        [forget, update, candidate, carried]: [&[f32]; 4],
        states: &[f32],
        (): (),
        gradient: &[f32],
        _wanted: [bool; 4],
    ) -> [Vec<f32>; 4] {
        let by = Minimal::backward(*self, [forget, update], candidate, carried, states, gradient);
        let [forget, update] = by.gates;
        [forget, update, by.candidate, by.carried]
    }
}

/// The states of a GRU layer: products of the inputs `[T, R, 3 H]`, recurrent weights `[H, 3 H]` and
/// bias `[3 H]`, the state before `[R, H]`, to `[T, R, H]`.
pub(crate) fn gru(
    inputs: Tensor<3>,
    weight: Tensor<2>,
    bias: Tensor<1>,
    hidden: Tensor<2>,
) -> Tensor<3> {
    let [frames, rows, _] = inputs.dims();
    let shape = [frames, rows, hidden.dims()[1]];
    apply(GruLayer, [input(inputs), input(weight), input(bias), input(hidden)], shape)
}

#[derive(Clone, Copy, Debug)]
struct GruLayer;

impl Operation<4> for GruLayer {
    /// Gates and recurrent products.
    type Kept = [Vec<f32>; 2];

    fn forward(&self, [inputs, weight, bias, hidden]: [&[f32]; 4]) -> (Vec<f32>, Self::Kept) {
        let gru::Run { states, gates, recurrent } = Gru { inputs, weight, bias, hidden }.forward();
        (states, [gates, recurrent])
    }

    fn backward(
        &self,
        [inputs, weight, bias, hidden]: [&[f32]; 4],
        states: &[f32],
        [gates, recurrent]: Self::Kept,
        gradient: &[f32],
        [_, _, _, by_start]: [bool; 4],
    ) -> [Vec<f32>; 4] {
        let layer = Gru { inputs, weight, bias, hidden };
        let by = layer.backward(states, &gates, &recurrent, gradient, by_start);
        [by.inputs, by.weight, by.bias, by.hidden]
    }
}

/// Outputs and cells of an LSTM layer, side by side: products of the inputs `[T, R, 4 H]`, recurrent
/// weights `[H, 4 H]` and bias `[4 H]`, output and cell before, `[R, H]`, to `[T, R, 2 H]`.
pub(crate) fn lstm(
    inputs: Tensor<3>,
    weight: Tensor<2>,
    bias: Tensor<1>,
    [hidden, cell]: [Tensor<2>; 2],
) -> Tensor<3> {
    let [frames, rows, _] = inputs.dims();
    let shape = [frames, rows, 2 * hidden.dims()[1]];
    let inputs = [input(inputs), input(weight), input(bias), input(hidden), input(cell)];
    apply(LstmLayer, inputs, shape)
}

#[derive(Clone, Copy, Debug)]
struct LstmLayer;

impl Operation<5> for LstmLayer {
    /// Gates.
    type Kept = Vec<f32>;

    fn forward(&self, inputs: [&[f32]; 5]) -> (Vec<f32>, Self::Kept) {
        let [inputs, weight, bias, hidden, cell] = inputs;
        let lstm::Run { states, gates } = Lstm { inputs, weight, bias, hidden, cell }.forward();
        (states, gates)
    }

    fn backward(
        &self,
        inputs: [&[f32]; 5],
        states: &[f32],
        gates: Self::Kept,
        gradient: &[f32],
        [_, _, _, by_hidden, by_cell]: [bool; 5],
    ) -> [Vec<f32>; 5] {
        let [inputs, weight, bias, hidden, cell] = inputs;
        let layer = Lstm { inputs, weight, bias, hidden, cell };
        let by = layer.backward(states, &gates, gradient, by_hidden || by_cell);
        [by.inputs, by.weight, by.bias, by.hidden, by.cell]
    }
}

/// [`sparse::gathered`](super::sparse::gathered), with a ReLU behind it or without.
pub(crate) fn gathered(
    nodes: &Arc<Nodes>,
    table: Table,
    rectify: bool,
    rows: Tensor<2>,
    weight: Tensor<2>,
    bias: Tensor<1>,
) -> Tensor<2> {
    let (Table::Neighbours(level) | Table::Children(level)) = table;
    let shape = [nodes.level(level).len(), bias.dims()[0]];
    let inputs = [input(rows), input(weight), input(bias)];
    let nodes = nodes.clone();
    match table {
        Table::Neighbours(level) => apply(Around { nodes, level, rectify }, inputs, shape),
        Table::Children(level) => apply(FromChildren { nodes, level, rectify }, inputs, shape),
    }
}

#[derive(Clone, Debug)]
struct Around {
    nodes: Arc<Nodes>,
    level: usize,
    rectify: bool,
}

impl Around {
    fn layer<'a>(&'a self, weight: &'a [f32], bias: &'a [f32]) -> Convolution<'a> {
        let neighbours = &self.nodes.level(self.level).neighbours;
        Convolution { neighbours, weight, bias, rectify: self.rectify }
    }
}

impl Operation<3> for Around {
    type Kept = ();

    fn forward(&self, [rows, weight, bias]: [&[f32]; 3]) -> (Vec<f32>, ()) {
        (self.layer(weight, bias).forward(rows), ())
    }

    fn backward(
        &self,
        [rows, weight, bias]: [&[f32]; 3],
        output: &[f32],
        (): (),
        gradient: &[f32],
        [by_rows, by_weight, _]: [bool; 3],
    ) -> [Vec<f32>; 3] {
        let layer = self.layer(weight, bias);
        let by = layer.backward(rows, output, gradient, by_rows, by_weight);
        [by.input, by.weight, by.bias]
    }
}

#[derive(Clone, Debug)]
struct FromChildren {
    nodes: Arc<Nodes>,
    level: usize,
    rectify: bool,
}

impl FromChildren {
    fn layer<'a>(&'a self, weight: &'a [f32], bias: &'a [f32]) -> Down<'a> {
        let children = &self.nodes.level(self.level).children;
        let parent = &self.nodes.level(self.level - 1).parent;
        Down { children, parent, weight, bias, rectify: self.rectify }
    }
}

impl Operation<3> for FromChildren {
    type Kept = ();

    fn forward(&self, [rows, weight, bias]: [&[f32]; 3]) -> (Vec<f32>, ()) {
        (self.layer(weight, bias).forward(rows), ())
    }

    fn backward(
        &self,
        [rows, weight, bias]: [&[f32]; 3],
        output: &[f32],
        (): (),
        gradient: &[f32],
        [by_rows, by_weight, _]: [bool; 3],
    ) -> [Vec<f32>; 3] {
        let layer = self.layer(weight, bias);
        let by = layer.backward(rows, output, gradient, by_rows, by_weight);
        [by.input, by.weight, by.bias]
    }
}

/// [`sparse::spread`](super::sparse::spread).
pub(crate) fn spread(
    nodes: &Arc<Nodes>,
    level: usize,
    parents: Tensor<2>,
    weight: Tensor<2>,
    bias: Tensor<1>,
) -> Tensor<2> {
    let shape = [nodes.level(level).len(), bias.dims()[0]];
    let nodes = nodes.clone();
    apply(FromParent { nodes, level }, [input(parents), input(weight), input(bias)], shape)
}

#[derive(Clone, Debug)]
struct FromParent {
    nodes: Arc<Nodes>,
    level: usize,
}

impl FromParent {
    fn layer<'a>(&'a self, weight: &'a [f32], bias: &'a [f32]) -> Up<'a> {
        let children = &self.nodes.level(self.level + 1).children;
        let parent = &self.nodes.level(self.level).parent;
        Up { children, parent, weight, bias }
    }
}

impl Operation<3> for FromParent {
    type Kept = ();

    fn forward(&self, [parents, weight, bias]: [&[f32]; 3]) -> (Vec<f32>, ()) {
        (self.layer(weight, bias).forward(parents), ())
    }

    fn backward(
        &self,
        [parents, weight, bias]: [&[f32]; 3],
        _output: &[f32],
        (): (),
        gradient: &[f32],
        [by_parents, by_weight, _]: [bool; 3],
    ) -> [Vec<f32>; 3] {
        let by = self.layer(weight, bias).backward(parents, gradient, by_parents, by_weight);
        [by.input, by.weight, by.bias]
    }
}

/// [`sparse::write`](super::sparse::write): `[R, C]` and positions `[R, 2]` to `[M0, C + 5]`.
pub(crate) fn write(ground: &Ground, encoded: Tensor<2>, position: Tensor<2>) -> Tensor<2> {
    let width = encoded.dims()[1] + NODE_FEATURES;
    let shape = [ground.nodes.level(0).len(), width];
    apply(Write(ground.clone()), [input(encoded), input(position)], shape)
}

#[derive(Clone, Debug)]
struct Write(Ground);

impl Operation<2> for Write {
    /// Mass of each node.
    type Kept = Vec<f32>;

    fn forward(&self, [encoded, _]: [&[f32]; 2]) -> (Vec<f32>, Vec<f32>) {
        let Ground { nodes, walls, .. } = &self.0;
        let width = encoded.len() / nodes.order().len();
        let (sums, mass) = (to_nodes(nodes, encoded, width), mass(nodes));
        let mut written = Vec::with_capacity(mass.len() * (width + NODE_FEATURES));
        for ((sum, &mass), walls) in sums.chunks_exact(width).zip(&mass).zip(walls.iter()) {
            let scale = 1.0 / (mass + LEAST_MASS);
            written.extend(sum.iter().map(|sum| sum * scale));
            written.push(mass / FULL);
            written.extend(walls);
        }
        (written, mass)
    }

    fn backward(
        &self,
        [encoded, _]: [&[f32]; 2],
        written: &[f32],
        mass: Vec<f32>,
        gradient: &[f32],
        [by_encoded, by_place]: [bool; 2],
    ) -> [Vec<f32>; 2] {
        let nodes = &self.0.nodes;
        let width = encoded.len() / nodes.order().len();
        let mut by_sum = Vec::with_capacity(mass.len() * width);
        let mut by_mass = Vec::with_capacity(mass.len());
        let whole = width + NODE_FEATURES;
        let rows = gradient.chunks_exact(whole).zip(written.chunks_exact(whole));
        for ((gradient, written), mass) in rows.zip(&mass) {
            let scale = 1.0 / (mass + LEAST_MASS);
            by_sum.extend(gradient[..width].iter().map(|g| g * scale));
            let averages = gradient[..width].iter().zip(written).map(|(g, x)| g * x);
            by_mass.push(gradient[width] / FULL - scale * averages.sum::<f32>());
        }
        let mut place = Vec::new();
        if by_place {
            place = by_position(nodes, &by_sum, encoded, width);
            let ones = vec![1.0; nodes.order().len()];
            let more = by_position(nodes, &by_mass, &ones, 1);
            place.iter_mut().zip(more).for_each(|(place, more)| *place += more);
        }
        [if by_encoded { to_particles(nodes, &by_sum, width) } else { Vec::new() }, place]
    }
}

/// [`sparse::read`](super::sparse::read): `[M0, C]` and positions `[R, 2]` to `[R, C]`.
pub(crate) fn read(ground: &Ground, rows: Tensor<2>, position: Tensor<2>) -> Tensor<2> {
    let shape = [position.dims()[0], rows.dims()[1]];
    apply(Read(ground.nodes.clone()), [input(rows), input(position)], shape)
}

#[derive(Clone, Debug)]
struct Read(Arc<Nodes>);

impl Operation<2> for Read {
    type Kept = ();

    fn forward(&self, [rows, _]: [&[f32]; 2]) -> (Vec<f32>, ()) {
        (to_particles(&self.0, rows, rows.len() / self.0.level(0).len()), ())
    }

    fn backward(
        &self,
        [rows, _]: [&[f32]; 2],
        _output: &[f32],
        (): (),
        gradient: &[f32],
        [by_rows, by_place]: [bool; 2],
    ) -> [Vec<f32>; 2] {
        let width = rows.len() / self.0.level(0).len();
        [
            if by_rows { to_nodes(&self.0, gradient, width) } else { Vec::new() },
            if by_place { by_position(&self.0, rows, gradient, width) } else { Vec::new() },
        ]
    }
}

/// [`strain::shape`](super::strain::shape): positions `[T R, 2]` to `[T R, 5]`.
pub(crate) fn shape(rest: Arc<Rest>, position: Tensor<2>) -> Tensor<2> {
    let shape = [position.dims()[0], SHAPE_FEATURES];
    apply(Shape(rest), [input(position)], shape)
}

#[derive(Clone, Debug)]
struct Shape(Arc<Rest>);

impl Operation<1> for Shape {
    type Kept = ();

    fn forward(&self, [position]: [&[f32]; 1]) -> (Vec<f32>, ()) {
        (self.0.shape(position.as_chunks().0), ())
    }

    fn backward(
        &self,
        [position]: [&[f32]; 1],
        _shape: &[f32],
        (): (),
        gradient: &[f32],
        _wanted: [bool; 1],
    ) -> [Vec<f32>; 1] {
        [self.0.backward(position.as_chunks().0, gradient)]
    }
}

/// Numbers that a thread takes at once.
const CHUNK: usize = 1 << 14;

/// ReLU.
fn rectify(values: &mut [f32]) {
    values.par_chunks_mut(CHUNK).for_each(|part| part.iter_mut().for_each(|x| *x = x.max(0.0)));
}

/// The gradient in front of a ReLU: where its output is positive.
fn passed_on(output: &[f32], gradient: &[f32]) -> Vec<f32> {
    let pass = |(y, g): (&f32, &f32)| if *y > 0.0 { *g } else { 0.0 };
    output.par_iter().zip(gradient).with_min_len(CHUNK).map(pass).collect()
}
