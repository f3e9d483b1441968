//! Launches and products of a step, with the shapes and places they share.

use super::{Staging, Training};
use crate::{
    device::{Factor, Kernel, List, Pointer, Product, Queue, Shape, count},
    error::Result,
    frame::data::Bodies,
    kernels::{
        frame::{loss::Frames, windows::Fetch},
        training::batch_loss::Unroll,
    },
    streams::Body,
    training::{Matrix, Settings},
};

/// Blocks that fetch windows: enough to keep the bus busy, few, since they wait beside those of the step.
const FETCHING: usize = 32;

impl Training {
    pub(super) fn frames(&self) -> usize {
        self.settings.warm_up + self.settings.unroll - 1
    }

    /// The place of frame `t` in a list of so many items a window.
    pub(super) fn at<T: bytemuck::Pod>(
        &self,
        list: &List<T>,
        t: usize,
        items: usize,
    ) -> Pointer<T> {
        list.pointer().plus(t * self.settings.batch * items)
    }

    pub(super) fn unroll_argument(&self) -> Unroll {
        let Settings { batch, warm_up, unroll, .. } = self.settings;
        let [batch, warm_up, unroll, decoded] =
            [batch, warm_up, unroll, self.settings.first_decoded()].map(count);
        Unroll { batch, warm_up, unroll, decoded }
    }

    pub(super) fn frames_argument(&self) -> Frames {
        let Unroll { batch, warm_up, unroll, decoded } = self.unroll_argument();
        let even = if warm_up > 1 { unroll as f32 / (warm_up - 1) as f32 } else { 0.0 };
        let (sides, motion) = (self.sides, self.motion);
        let weights_step = count(self.tables.weights_step());
        Frames { batch, warm_up, unroll, decoded, weights_step, sides, even, motion }
    }

    pub(super) fn launch(&self, shape: Shape, kernel: impl Kernel) -> Result<()> {
        self.launch_in(Queue::Main, shape, kernel)
    }

    pub(super) fn launch_in(&self, queue: Queue, shape: Shape, kernel: impl Kernel) -> Result<()> {
        // SAFETY: every call passes buffers that `new` has made for these shapes.
        unsafe { self.device.launch(queue, shape, &kernel) }
    }

    /// `output = input W` for `rows` rows; W has rows for the input's columns.
    pub(super) fn forward_product(
        &self,
        matrix: &Matrix,
        input: Pointer<f32>,
        output: Pointer<f32>,
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
        slopes: Pointer<f32>,
        gradient: Pointer<f32>,
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
        input: Pointer<f32>,
        slopes: Pointer<f32>,
        rows: usize,
    ) -> Result<()> {
        let gradient = self.optimizer.gradient(matrix);
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
        [left, right, result]: [Pointer<f32>; 3],
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

    pub(super) fn weight(&self, matrix: &Matrix) -> Pointer<f32> {
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
    pub(super) fn bodies(&self) -> Pointer<Body> {
        match (&self.store.bodies, &self.staging) {
            (Bodies::Device(buffer), _) | (_, Some(Staging { bodies: buffer, .. })) => {
                buffer.pointer()
            }
            (Bodies::Host(_), None) => Pointer::NULL,
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
            Shape::new(self.settings.batch.min(FETCHING), 1, 256),
            Fetch {
                host: host.pointer(),
                sources: staging.sources.pointer(),
                progress: self.tables.progress.pointer(),
                staged: staging.bodies.pointer(),
                ahead: count(ahead),
                bodies: count(frames * self.constants.particles),
                batch: count(self.settings.batch),
            },
        )
    }
}
