//! Dense layers that predict a frame from one frame: the network of the paper's comparison of activations (supplement B).
//!
//! Signals are `[rows, columns]`, with a column of ones after the numbers, as in the frame model: the bias is a row of the
//! matrix.

#![expect(
    unsafe_code,
    reason = "launches and products, whose sizes are those of the buffers allocated here"
)]

use std::sync::Arc;

use crate::{
    device::{Device, Factor, Kernel, List, Pointer, Product, Queue, Shape, count},
    error::Result,
    kernels::{
        AXES, Program,
        dense::{DenseAdam, DenseBackward, DenseError, DenseForward},
        round_up,
    },
};
use eddy_inference::checkpoint::Activation;

/// The kernels' text, in parts.
const SOURCE: [&str; 3] =
    [include_str!("base.cu"), include_str!("common.cu"), include_str!("dense.cu")];
/// Threads of a block of the kernels of activations, and of the others.
const THREADS: [usize; 2] = [128, 256];

/// What the kernels are compiled for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Constants {
    /// Width of the hidden layers.
    pub width: usize,
    /// Their activation.
    pub activation: Activation,
}

/// Numbers with the ones, rounded up.
fn columns(numbers: usize) -> usize {
    round_up(numbers + 1, 8)
}

impl Program for Constants {
    fn source(&self) -> String {
        SOURCE.concat()
    }

    fn definitions(&self) -> Vec<(&'static str, usize)> {
        let activation = Activation::ALL.iter().position(|&kind| kind == self.activation);
        vec![
            ("DIM", AXES),
            ("H", self.width),
            ("HP", columns(self.width)),
            ("ACTIVATION", activation.unwrap_or_default()),
        ]
    }
}

/// How Adam moves: its rate and 1 / sqrt(1 - beta_2^t), both corrected for the start from zero, and its epsilon.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Move {
    /// Learning rate, corrected for the first moment's start from zero.
    pub rate: f32,
    /// 1 / sqrt(1 - beta_2^t).
    pub correction: f32,
    /// Epsilon.
    pub epsilon: f32,
}

/// The network on a device.
pub struct Dense {
    device: Arc<dyn Device>,
    constants: Constants,
    layers: Vec<Layer>,
    /// Inputs of the layers, and the output of the last: `[rows, columns]`.
    signals: Vec<List<f32>>,
    /// Gradients by the hidden layers' outputs.
    slopes: Vec<List<f32>>,
    truth: List<f32>,
    /// Sums of squared errors, by rows.
    squares: List<f32>,
    /// Numbers of a frame.
    features: usize,
    /// Rows that there is memory for.
    rows: usize,
}

/// A layer: matrices of `rows` by `columns`, with the bias in row `input`.
struct Layer {
    rows: usize,
    columns: usize,
    weight: List<f32>,
    gradient: List<f32>,
    first: List<f32>,
    second: List<f32>,
}

impl Dense {
    /// A network for frames of `features` numbers, with the weights `[in, out]` and bias of each layer, for batches of up to
    /// `rows` frames, on a device that has the kernels of `constants`.
    ///
    /// # Errors
    /// [`CudaError::Memory`](crate::CudaError::Memory), [`CudaError::Call`](crate::CudaError::Call).
    ///
    /// # Panics
    /// If weights have other sizes.
    pub fn new(
        device: Arc<dyn Device>,
        constants: Constants,
        features: usize,
        weights: &[[Vec<f32>; 2]],
        rows: usize,
    ) -> Result<Self> {
        let last = weights.len() - 1;
        let mut layers = Vec::new();
        for (number, [weight, bias]) in weights.iter().enumerate() {
            let [input, output] = [number == 0, number == last]
                .map(|is_end| if is_end { features } else { constants.width });
            assert_eq!([weight.len(), bias.len()], [input * output, output], "layer {number}");
            let (height, width) = (columns(input), columns(output));
            let mut matrix = vec![0.0; height * width];
            let from = weight.chunks_exact(output).chain([bias.as_slice()]);
            for (row, from) in matrix.chunks_exact_mut(width).zip(from) {
                row[..output].copy_from_slice(from);
            }
            let zeros = || List::new(&*device, matrix.len());
            layers.push(Layer {
                rows: height,
                columns: width,
                weight: List::of(&*device, &matrix)?,
                gradient: zeros()?,
                first: zeros()?,
                second: zeros()?,
            });
        }
        let signal = |columns: usize| List::new(&*device, rows * columns);
        let mut signals = vec![signal(columns(features))?];
        for layer in &layers {
            signals.push(signal(layer.columns)?);
        }
        let slopes = layers[1..].iter().map(|layer| signal(layer.rows)).collect::<Result<_>>()?;
        let (truth, squares) = (signal(columns(features))?, signal(1)?);
        Ok(Self { device, constants, layers, signals, slopes, truth, squares, features, rows })
    }

    /// A step on a batch: frames and the ones that follow, `[B, features]`. Returns the mean squared error before it.
    ///
    /// # Errors
    /// [`CudaError::Call`](crate::CudaError::Call).
    ///
    /// # Panics
    /// If there are more rows than memory for them.
    pub fn step(&mut self, input: &[f32], truth: &[f32], by: Move) -> Result<f64> {
        let loss = self.loss(input, truth)?;
        let rows = input.len() / self.features;
        let last = self.layers.len() - 1;
        for (number, layer) in self.layers.iter().enumerate().rev() {
            let above = match number == last {
                true => self.signals[last + 1].pointer(),
                false => self.slopes[number].pointer(),
            };
            let above = factor(above, layer.columns);
            let weight = factor(layer.weight.pointer(), layer.columns);
            if number > 0 {
                let sizes = [rows, layer.columns, layer.rows];
                let below = &self.slopes[number - 1];
                self.multiply(above, turned(weight), below, layer.rows, sizes)?;
                let signal = &self.signals[number];
                let backward = DenseBackward { d: below.pointer(), y: signal.pointer() };
                self.launch(self.hidden(rows), backward)?;
            }
            let signal = turned(factor(self.signals[number].pointer(), layer.rows));
            let sizes = [layer.rows, rows, layer.columns];
            self.multiply(signal, above, &layer.gradient, layer.columns, sizes)?;
            let numbers = layer.rows * layer.columns;
            self.launch(
                Shape::new(numbers.div_ceil(THREADS[1]), 1, THREADS[1]),
                DenseAdam {
                    w: layer.weight.pointer(),
                    g: layer.gradient.pointer(),
                    first: layer.first.pointer(),
                    second: layer.second.pointer(),
                    n: count(numbers),
                    rate: by.rate,
                    correction: by.correction,
                    epsilon: by.epsilon,
                },
            )?;
        }
        Ok(loss)
    }

    /// The mean squared error of predictions, `[B, features]` both.
    ///
    /// # Errors
    /// [`CudaError::Call`](crate::CudaError::Call).
    ///
    /// # Panics
    /// If there are more rows than memory for them.
    pub fn loss(&mut self, input: &[f32], truth: &[f32]) -> Result<f64> {
        let rows = input.len() / self.features;
        assert!(rows <= self.rows && input.len() == truth.len(), "{rows} rows of {}", self.rows);
        self.write(&self.signals[0], input)?;
        self.write(&self.truth, truth)?;
        let last = self.layers.len() - 1;
        for (number, layer) in self.layers.iter().enumerate() {
            let signal = factor(self.signals[number].pointer(), layer.rows);
            let weight = factor(layer.weight.pointer(), layer.columns);
            let output = &self.signals[number + 1];
            let sizes = [rows, layer.rows, layer.columns];
            self.multiply(signal, weight, output, layer.columns, sizes)?;
            if number < last {
                self.launch(self.hidden(rows), DenseForward { y: output.pointer() })?;
            }
        }
        let numbers = rows * self.features;
        self.launch(
            Shape::new(rows, 1, THREADS[1]),
            DenseError {
                y: self.signals[last + 1].pointer(),
                truth: self.truth.pointer(),
                squares: self.squares.pointer(),
                columns: count(columns(self.features)),
                width: count(self.features),
                scale: 2.0 / numbers as f32,
            },
        )?;
        let mut squares = vec![0.0f32; rows];
        self.device.read(&self.squares, 0, bytemuck::cast_slice_mut(&mut squares))?;
        Ok(squares.into_iter().map(f64::from).sum::<f64>() / numbers as f64)
    }

    /// Copies frames, with a column of ones after their numbers.
    fn write(&self, to: &List<f32>, frames: &[f32]) -> Result<()> {
        let width = columns(self.features);
        let mut padded = vec![0.0; frames.len() / self.features * width];
        for (row, frame) in padded.chunks_exact_mut(width).zip(frames.chunks_exact(self.features)) {
            row[..self.features].copy_from_slice(frame);
            row[self.features] = 1.0;
        }
        self.device.write(to, 0, bytemuck::cast_slice(&padded))
    }

    /// Blocks for a hidden layer's outputs.
    fn hidden(&self, rows: usize) -> Shape {
        Shape::new(columns(self.constants.width).div_ceil(THREADS[0]), rows, THREADS[0])
    }

    fn launch(&self, shape: Shape, kernel: impl Kernel) -> Result<()> {
        // SAFETY: `new` has allocated as much as the shapes ask for.
        unsafe { self.device.launch(Queue::Main, shape, &kernel) }
    }

    fn multiply(
        &self,
        left: Factor,
        right: Factor,
        result: &List<f32>,
        stride: usize,
        sizes: [usize; 3],
    ) -> Result<()> {
        let product = Product { left, right, result: result.pointer(), stride, sizes, add: false };
        // SAFETY: as above.
        unsafe { self.device.multiply(Queue::Main, &product) }
    }
}

fn factor(at: Pointer<f32>, stride: usize) -> Factor {
    Factor { at, stride, transposed: false }
}

fn turned(factor: Factor) -> Factor {
    Factor { transposed: true, ..factor }
}
