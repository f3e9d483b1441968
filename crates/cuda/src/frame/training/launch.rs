//! Launches and products of a step, with the shapes and places they share.

use super::{Staging, Training};
use crate::{
    device::{Address, Argument, Buffer, Factor, Product, Queue, Shape},
    error::Result,
    frame::data::Bodies,
    kernels::Kernel,
    training::{Matrix, Settings},
};

/// Blocks that fetch windows: enough to keep the bus busy, few, since they wait beside those of the step.
const FETCHING: usize = 32;

impl Training {
    pub(super) fn frames(&self) -> usize {
        self.settings.warm_up + self.settings.unroll - 1
    }

    /// The place of frame `t` in a buffer of so many numbers a window.
    pub(super) fn at(&self, buffer: &Buffer, t: usize, numbers: usize) -> Address {
        buffer.address().plus(t * self.settings.batch * numbers)
    }

    /// `struct Unroll` of the kernels.
    pub(super) fn unroll_argument(&self) -> Argument {
        let Settings { batch, warm_up, unroll, .. } = self.settings;
        let counts =
            [batch, warm_up, unroll, self.settings.first_decoded()].map(|count| count as u32);
        Argument::from_bytes(bytemuck::cast_slice(&counts))
    }

    /// `struct Frames` of the kernels.
    pub(super) fn frames_argument(&self) -> Argument {
        let Settings { batch, warm_up, unroll, .. } = self.settings;
        let even = if warm_up > 1 { unroll as f32 / (warm_up - 1) as f32 } else { 0.0 };
        let counts =
            [batch, warm_up, unroll, self.settings.first_decoded(), self.tables.weights_step()]
                .map(|count| count as u32);
        let numbers = [self.sides, even].into_iter().chain(self.motion.into_iter().flatten());
        let words: Vec<u32> = counts.into_iter().chain(numbers.map(f32::to_bits)).collect();
        Argument::from_bytes(bytemuck::cast_slice(&words))
    }

    pub(super) fn launch(
        &self,
        kernel: Kernel,
        shape: Shape,
        arguments: &[Argument],
    ) -> Result<()> {
        self.launch_in(Queue::Main, kernel, shape, arguments)
    }

    pub(super) fn launch_in(
        &self,
        queue: Queue,
        kernel: Kernel,
        shape: Shape,
        arguments: &[Argument],
    ) -> Result<()> {
        // SAFETY: every call of this file passes the kernel's parameters in type and order, and buffers that
        // `new` has made for these shapes.
        unsafe { self.device.launch(queue, kernel, shape, arguments) }
    }

    /// `output = input W` for `rows` rows; W has rows for the input's columns.
    pub(super) fn forward_product(
        &self,
        matrix: &Matrix,
        input: Address,
        output: Address,
        rows: usize,
    ) -> Result<()> {
        self.product(
            Queue::Main,
            [input, self.weight(matrix), output],
            [false, false],
            [matrix.rows, matrix.columns, matrix.columns],
            [rows, matrix.rows, matrix.columns],
            false,
        )
    }

    /// `gradient = slopes W'`.
    pub(super) fn backward_product(
        &self,
        matrix: &Matrix,
        slopes: Address,
        gradient: Address,
        rows: usize,
        add: bool,
    ) -> Result<()> {
        self.product(
            Queue::Main,
            [slopes, self.weight(matrix), gradient],
            [false, true],
            [matrix.columns, matrix.columns, matrix.rows],
            [rows, matrix.columns, matrix.rows],
            add,
        )
    }

    /// `dW = input' slopes`, in the side queue.
    pub(super) fn weight_product(
        &self,
        matrix: &Matrix,
        input: Address,
        slopes: Address,
        rows: usize,
    ) -> Result<()> {
        let gradient = self.optimizer.gradients.address().plus(matrix.first);
        self.product(
            Queue::Side,
            [input, slopes, gradient],
            [true, false],
            [matrix.rows, matrix.columns, matrix.columns],
            [matrix.rows, rows, matrix.columns],
            false,
        )
    }

    pub(super) fn product(
        &self,
        queue: Queue,
        [left, right, result]: [Address; 3],
        transposed: [bool; 2],
        strides: [usize; 3],
        sizes: [usize; 3],
        add: bool,
    ) -> Result<()> {
        let left = Factor { at: left, stride: strides[0], transposed: transposed[0] };
        let right = Factor { at: right, stride: strides[1], transposed: transposed[1] };
        let product = Product { left, right, result, stride: strides[2], sizes, add };
        // SAFETY: buffers are those that `new` has made for these sizes.
        unsafe { self.device.multiply(queue, &product) }
    }

    pub(super) fn weight(&self, matrix: &Matrix) -> Address {
        self.optimizer.weight(matrix)
    }

    /// Blocks over the hidden units of all windows' frames.
    pub(super) fn units(&self, frames: usize) -> Shape {
        let blocks = self.constants.hidden_columns().div_ceil(128);
        Shape { grid: [blocks, self.settings.batch, frames], block: [128, 1], shared: 0 }
    }

    /// Blocks over the particles of all windows' frames.
    pub(super) fn particles(&self, frames: usize) -> Shape {
        let blocks = self.constants.particles.div_ceil(256);
        Shape { grid: [blocks, self.settings.batch, frames], block: [256, 1], shared: 0 }
    }

    /// Where the bodies of the step's windows lie in the memory of the device.
    pub(super) fn bodies(&self) -> Address {
        match (&self.store.bodies, &self.staging) {
            (Bodies::Device(buffer), _) | (_, Some(Staging { bodies: buffer, .. })) => {
                buffer.address()
            }
            (Bodies::Host(_), None) => Address::NULL,
        }
    }

    /// Fetches the windows of the step `ahead` steps from now, if they lie in the memory of the host.
    pub(super) fn fetch(&self, queue: Queue, ahead: usize) -> Result<()> {
        let (Bodies::Host(host), Some(staging)) = (&self.store.bodies, &self.staging) else {
            return Ok(());
        };
        let frames = self.settings.warm_up + self.settings.unroll;
        self.launch_in(
            queue,
            Kernel::Fetch,
            Shape::new(self.settings.batch.min(FETCHING), 1, 256),
            &[
                host.address().into(),
                staging.sources.address().into(),
                self.tables.progress.address().into(),
                staging.bodies.address().into(),
                ahead.into(),
                (frames * self.constants.particles).into(),
                self.settings.batch.into(),
            ],
        )
    }
}
