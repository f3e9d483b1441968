//! Gradients by the weights, beside the backward pass, and what they change.

use std::slice;

use crate::{
    device::{Pointer, Queue, Shape, count},
    error::Result,
    kernels::{Constants, frame::encoder::EncoderGradient},
    training::Matrix,
};

use super::Training;

impl Training {
    /// The gradient by a matrix, in the side queue, once all slopes are there.
    pub(super) fn learn(
        &self,
        last: bool,
        matrix: &Matrix,
        input: Pointer<f32>,
        slopes: Pointer<f32>,
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
                Shape { grid: [encoder.div_ceil(32), matrix.rows, 1], block: [32, 32], shared: 0 },
                EncoderGradient {
                    g: self.d_pooled.pointer(),
                    sums: self.sums.pointer(),
                    dw: self.optimizer.gradient(matrix),
                    rows: count(rows),
                    chunks: count(self.chunks),
                },
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
        let queue = self.updates();
        if queue != Queue::Side {
            self.device.wait(queue, Queue::Side)?;
        }
        self.optimizer.measure(queue, slice::from_ref(matrix))
    }

    /// Adam for a matrix, once nothing needs the old weights any more.
    pub(super) fn change(&self, last: bool, matrix: &Matrix) -> Result<()> {
        if !last {
            return Ok(());
        }
        let queue = self.updates();
        self.device.wait(queue, Queue::Main)?;
        self.optimizer.change(queue, slice::from_ref(matrix), &self.tables)
    }
}
