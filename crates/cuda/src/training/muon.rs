//! Muon on a device, for the weights of hidden layers.

#![expect(unsafe_code, reason = "launches on memory of the device")]

use super::{Packing, Tables};
use crate::{
    device::{Device, Kernel, List, Pointer, Queue, Shape, count},
    error::{CudaError, Result},
    kernels::training::muon::{self, MUON_PARTS, MuonGram, MuonPolynomial, MuonTensor},
};

/// Root mean square of a step at a learning rate of 1, as on the processor.
const STEP: f32 = 0.2;
/// Shared memory that a block may have on an H100, beside a sum's (bytes).
const SHARED: usize = 226 << 10;

/// The tensors that it changes, and memory for its products.
pub(super) struct Muon {
    table: List<MuonTensor>,
    /// Parts of the products of each with its transpose, `[MUON_PARTS, size, size]`; then the polynomial in place of the first one.
    grams: List<f32>,
    tensors: usize,
    /// Shared memory of a block, as of [`shared`], at most.
    shared: [usize; 2],
    /// Most numbers of a tensor.
    most: usize,
}

/// Where weights, their gradients, momentum and average are.
pub(super) struct Buffers {
    pub(super) weights: Pointer<f32>,
    pub(super) gradients: Pointer<f32>,
    pub(super) momentum: Pointer<f32>,
    pub(super) average: Pointer<f32>,
    pub(super) scales: Pointer<f32>,
}

impl Muon {
    /// Memory for the hidden layers among these matrices.
    ///
    /// # Errors
    /// [`CudaError::Unsupported`] for a layer that is too wide, [`CudaError::Call`].
    pub(super) fn new(device: &dyn Device, packing: &Packing) -> Result<Self> {
        let (mut all, mut grams, mut most_shared) = (Vec::new(), 0, [0; 2]);
        let parts = packing
            .matrices()
            .iter()
            .flat_map(|matrix| (0..matrix.tensors() / 2).map(move |part| (matrix, part)));
        for (matrix, part) in parts.filter(|(matrix, part)| matrix.is_hidden(*part)) {
            let (rows, columns) = (matrix.bias, matrix.width);
            let sides = [rows.min(columns), rows.max(columns)];
            let [inputs, outputs] = matrix.shape(part);
            let needed = shared(sides);
            if needed.into_iter().any(|bytes| bytes > SHARED) {
                let setting = format!("optimizer.kind = muon for {inputs} x {outputs} weights");
                let expected = "at most 120 inputs or outputs, or optimizer.kind = adam";
                return Err(CudaError::Unsupported { setting, expected });
            }
            all.push(MuonTensor {
                first: count(matrix.first + part * columns),
                rows: count(rows),
                columns: count(columns),
                stride: count(matrix.columns),
                tensor: count(matrix.tensor + 2 * part),
                gram: count(grams),
                step: STEP * (inputs.max(outputs) as f32).sqrt(),
            });
            grams += MUON_PARTS * sides[0] * sides[0];
            most_shared = [0, 1].map(|kernel| needed[kernel].max(most_shared[kernel]));
        }
        let most = all.iter().map(|tensor| (tensor.rows * tensor.columns) as usize).max();
        Ok(Self {
            table: List::of(device, &all)?,
            grams: List::new(device, grams)?,
            tensors: all.len(),
            shared: most_shared,
            most: most.unwrap_or_default(),
        })
    }

    /// A step, once gradients are measured and nothing needs the old weights any more.
    pub(super) fn change(
        &self,
        device: &dyn Device,
        buffers: &Buffers,
        tables: &Tables,
    ) -> Result<()> {
        fn launch(device: &dyn Device, shape: Shape, kernel: impl Kernel) -> Result<()> {
            // SAFETY: `new` has made the table and the products, for tensors within the other buffers.
            unsafe { device.launch(Queue::Main, shape, &kernel) }
        }
        let Buffers { weights, gradients, momentum, average, scales } = *buffers;
        let (tensors, grams) = (self.table.pointer(), self.grams.pointer());
        let [rows, squares] = self.shared;
        launch(
            device,
            Shape { shared: rows, ..Shape::new(MUON_PARTS, self.tensors, 256) },
            MuonGram { tensors, gradients, momentum, scales, grams },
        )?;
        launch(
            device,
            Shape { shared: squares, ..Shape::new(self.tensors, 1, 256) },
            MuonPolynomial { tensors, scales, grams },
        )?;
        launch(
            device,
            Shape::new((self.most / 4).div_ceil(256), self.tensors, 256),
            muon::Muon {
                tensors,
                weights,
                gradients,
                momentum,
                average,
                scales,
                grams,
                schedule: tables.schedule.pointer(),
                progress: tables.progress.pointer(),
            },
        )
    }
}

/// Shared memory of a block for a tensor's part and for its polynomial, by the tensor's shorter and longer side (bytes).
fn shared([shorter, longer]: [usize; 2]) -> [usize; 2] {
    [4 * longer.div_ceil(MUON_PARTS) * shorter, 4 * 4 * shorter * shorter]
}
