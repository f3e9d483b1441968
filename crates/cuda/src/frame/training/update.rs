//! Gradients by the weights, beside the backward pass, and what they change.

use crate::{
    device::{Address, Buffer, Queue, Shape},
    error::Result,
    frame::layout::Matrix,
    kernels::{Constants, Kernel},
};

use super::{CHUNKS, Training};

impl Training {
    /// The gradient by a matrix, in the side queue, once all slopes are there.
    pub(super) fn learn(
        &self,
        last: bool,
        matrix: &Matrix,
        input: Address,
        slopes: Address,
        rows: usize,
    ) -> Result<()> {
        if !last {
            return Ok(());
        }
        self.device.wait(Queue::Side, Queue::Main)?;
        self.weight_product(matrix, input, slopes, rows)?;
        self.measure(matrix)
    }

    /// The gradient by the pointwise encoder, and its change.
    pub(super) fn learn_points(&self, rows: usize) -> Result<()> {
        self.device.wait(Queue::Side, Queue::Main)?;
        let matrix = &self.layout.points;
        let Constants { encoder, .. } = self.constants;
        if self.constants.mean() {
            self.launch_in(
                Queue::Side,
                Kernel::EncoderGradient,
                Shape { grid: [encoder.div_ceil(32), matrix.rows, 1], block: [32, 32], shared: 0 },
                &[
                    self.d_pooled.address().into(),
                    self.sums.address().into(),
                    self.gradients.address().plus(matrix.first).into(),
                    rows.into(),
                    self.chunks.into(),
                ],
            )?;
        }
        if let Some(maximum) = &self.maximum {
            self.sum_maxima(maximum)?;
        }
        self.measure(matrix)?;
        self.change(true, matrix)
    }

    /// The queue of what follows a gradient: with several devices one beside the gradients', which go on while devices exchange
    /// those that are there.
    pub(super) fn updates(&self) -> Queue {
        if self.device.rank().count > 1 { Queue::Exchange } else { Queue::Side }
    }

    /// The gradient by a matrix averaged over the devices, its norms, and what shortens it.
    pub(super) fn measure(&self, matrix: &Matrix) -> Result<()> {
        let (gradient, queue) = (self.gradients.address().plus(matrix.first), self.updates());
        if queue != Queue::Side {
            self.device.wait(queue, Queue::Side)?;
        }
        // SAFETY: the matrix lies within the gradients.
        unsafe { self.device.average(queue, gradient, matrix.size()) }?;
        let tensors = matrix.tensors();
        let squares = self.tensor_squares.address().plus(matrix.tensor * CHUNKS);
        self.launch_in(
            queue,
            Kernel::SquaresOfGradient,
            // A block has 256 times 4 numbers or more.
            Shape::new(matrix.size().div_ceil(1024).min(CHUNKS), tensors, 256),
            &[
                gradient.into(),
                squares.into(),
                matrix.columns.into(),
                matrix.bias.into(),
                matrix.width.into(),
            ],
        )?;
        self.launch_in(
            queue,
            Kernel::Clip,
            Shape::new(tensors, 1, 256),
            &[
                squares.into(),
                self.tensor_scales.address().plus(matrix.tensor).into(),
                self.tensor_totals.address().plus(matrix.tensor).into(),
                self.settings.clip.into(),
            ],
        )
    }

    /// Adam for a matrix, once nothing needs the old weights any more.
    pub(super) fn change(&self, last: bool, matrix: &Matrix) -> Result<()> {
        if !last {
            return Ok(());
        }
        let queue = self.updates();
        self.device.wait(queue, Queue::Main)?;
        let at = |buffer: &Buffer| buffer.address().plus(matrix.first);
        let average = self.average.as_ref().map_or(Address::NULL, at);
        let quads = matrix.size() / 4;
        self.launch_in(
            queue,
            Kernel::Adam,
            Shape::new(quads.div_ceil(256), 1, 256),
            &[
                at(&self.weights).into(),
                at(&self.gradients).into(),
                at(&self.first).into(),
                at(&self.second).into(),
                average.into(),
                self.tensor_scales.address().plus(matrix.tensor).into(),
                self.schedule.address().into(),
                self.progress.address().into(),
                quads.into(),
                matrix.columns.into(),
                matrix.bias.into(),
                matrix.width.into(),
                self.settings.epsilon.into(),
            ],
        )
    }
}
