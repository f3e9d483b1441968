//! Muon on a device, for the weights of hidden layers.

#![expect(unsafe_code, reason = "launches on memory of the device")]

use super::{Packing, Tables};
use crate::{
    device::{Address, Argument, Buffer, Device, Queue, Shape},
    error::{CudaError, Result},
    kernels::Kernel,
};

/// Parts of a tensor's longer side, `MUON_PARTS` of the kernels.
const PARTS: usize = 8;
/// Root mean square of a step at a learning rate of 1, as on the processor.
const STEP: f32 = 0.2;
/// Shared memory that a block may have on an H100, beside a sum's (bytes).
const SHARED: usize = 226 << 10;

/// `struct MuonTensor` of the kernels.
#[derive(Clone, Copy)]
#[repr(C)]
struct MuonTensor {
    first: u32,
    rows: i32,
    columns: i32,
    stride: i32,
    tensor: i32,
    gram: u32,
    step: f32,
}

// SAFETY: numbers of 4 bytes without padding between them.
unsafe impl bytemuck::Zeroable for MuonTensor {}
// SAFETY: as above.
unsafe impl bytemuck::Pod for MuonTensor {}

/// The tensors that it changes, and memory for its products.
pub(super) struct Muon {
    /// `MuonTensor` of each.
    table: Buffer,
    /// Parts of the products of each with its transpose, `[PARTS, size, size]`; then the polynomial in place of the first one.
    grams: Buffer,
    tensors: usize,
    /// Shared memory of a block, as of [`shared`], at most.
    shared: [usize; 2],
    /// Most numbers of a tensor.
    most: usize,
}

/// Where weights, their gradients, momentum and average are.
pub(super) struct Buffers {
    pub(super) weights: Address,
    pub(super) gradients: Address,
    pub(super) momentum: Address,
    pub(super) average: Address,
    pub(super) scales: Address,
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
                first: (matrix.first + part * columns) as u32,
                rows: rows as i32,
                columns: columns as i32,
                stride: matrix.columns as i32,
                tensor: (matrix.tensor + 2 * part) as i32,
                gram: grams as u32,
                step: STEP * (inputs.max(outputs) as f32).sqrt(),
            });
            grams += PARTS * sides[0] * sides[0];
            most_shared = [0, 1].map(|kernel| needed[kernel].max(most_shared[kernel]));
        }
        let table = device.allocate(size_of_val(all.as_slice()))?;
        device.write(&table, 0, bytemuck::cast_slice(&all))?;
        let most = all.iter().map(|tensor| (tensor.rows * tensor.columns) as usize).max();
        Ok(Self {
            table,
            grams: device.allocate(4 * grams)?,
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
        let Buffers { weights, gradients, momentum, average, scales } = *buffers;
        let (table, grams) = (self.table.address(), self.grams.address());
        let launch = |kernel, shape, arguments: &[Argument]| {
            // SAFETY: each call passes the kernel's parameters in type and order; `new` has made the table and the products, for
            // tensors within the other buffers.
            unsafe { device.launch(Queue::Main, kernel, shape, arguments) }
        };
        let [rows, squares] = self.shared;
        launch(
            Kernel::MuonGram,
            Shape { shared: rows, ..Shape::new(PARTS, self.tensors, 256) },
            &[table.into(), gradients.into(), momentum.into(), scales.into(), grams.into()],
        )?;
        launch(
            Kernel::MuonPolynomial,
            Shape { shared: squares, ..Shape::new(self.tensors, 1, 256) },
            &[table.into(), scales.into(), grams.into()],
        )?;
        launch(
            Kernel::Muon,
            Shape::new((self.most / 4).div_ceil(256), self.tensors, 256),
            &[
                table.into(),
                weights.into(),
                gradients.into(),
                momentum.into(),
                average.into(),
                scales.into(),
                grams.into(),
                tables.schedule.address().into(),
                tables.progress.address().into(),
            ],
        )
    }
}

/// Shared memory of a block for a tensor's part and for its polynomial, by the tensor's shorter and longer side (bytes).
fn shared([shorter, longer]: [usize; 2]) -> [usize; 2] {
    [4 * longer.div_ceil(PARTS) * shorter, 4 * 4 * shorter * shorter]
}
