//! Muon on a device, for the weights of hidden layers.

#![expect(unsafe_code, reason = "a struct that the device reads")]

use super::Packing;
use crate::{
    device::{Address, Argument, Buffer, Device, Queue, Shape},
    error::{CudaError, Result},
    kernels::Kernel,
};

/// Parts of a tensor's longer side, `MUON_PARTS` of the kernels.
const PARTS: usize = 8;
/// Root mean square of a step at a learning rate of 1, as on the processor.
const STEP: f32 = 0.2;
/// Largest shorter side of a tensor, padding included: four square matrices fit into the shared memory of a block (227 KiB).
const LARGEST: usize = 112;

/// `struct Orthogonal` of the kernels.
#[derive(Clone, Copy)]
#[repr(C)]
struct Orthogonal {
    first: u32,
    rows: i32,
    columns: i32,
    stride: i32,
    tensor: i32,
    gram: u32,
    step: f32,
}

// SAFETY: numbers of 4 bytes without padding between them.
unsafe impl bytemuck::Zeroable for Orthogonal {}
// SAFETY: as above.
unsafe impl bytemuck::Pod for Orthogonal {}

/// The tensors that it changes, and memory for its products.
pub(super) struct Muon {
    /// `Orthogonal` of each.
    table: Buffer,
    /// Parts of the products of each with its transpose, `[PARTS, size, size]`; then the polynomial in place of the first one.
    grams: Buffer,
    tensors: usize,
    /// Largest shorter and longer side.
    largest: [usize; 2],
    /// Most numbers of a tensor.
    most: usize,
}

/// Where weights, their gradients, momentum and average are.
pub(super) struct Numbers {
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
        let (mut all, mut grams, mut largest) = (Vec::new(), 0, [0; 2]);
        let parts = packing
            .matrices()
            .iter()
            .flat_map(|matrix| (0..matrix.tensors() / 2).map(move |part| (matrix, part)));
        for (matrix, part) in parts.filter(|(matrix, part)| matrix.is_hidden(*part)) {
            let (rows, columns) = (matrix.bias, matrix.width);
            let sides = [rows.min(columns), rows.max(columns)];
            let [inputs, outputs] = matrix.shape(part);
            if sides[0] > LARGEST {
                let setting = format!("optimizer.kind = muon for {inputs} x {outputs} weights");
                let expected = "at most 112 inputs or outputs";
                return Err(CudaError::Unsupported { setting, expected });
            }
            all.push(Orthogonal {
                first: (matrix.first + part * columns) as u32,
                rows: rows as i32,
                columns: columns as i32,
                stride: matrix.columns as i32,
                tensor: (matrix.tensor + 2 * part) as i32,
                gram: grams as u32,
                step: STEP * (inputs.max(outputs) as f32).sqrt(),
            });
            grams += PARTS * sides[0] * sides[0];
            largest = [0, 1].map(|side| largest[side].max(sides[side]));
        }
        let table = device.allocate(size_of_val(all.as_slice()))?;
        device.write(&table, 0, bytemuck::cast_slice(&all))?;
        let most = all.iter().map(|tensor| (tensor.rows * tensor.columns) as usize).max();
        Ok(Self {
            table,
            grams: device.allocate(4 * grams)?,
            tensors: all.len(),
            largest,
            most: most.unwrap_or_default(),
        })
    }

    /// Calls `launch` with the kernels of a step, once gradients are measured and nothing needs the old weights any more.
    pub(super) fn change(
        &self,
        numbers: &Numbers,
        [schedule, progress]: [Address; 2],
        launch: impl Fn(Queue, Kernel, Shape, &[Argument]) -> Result<()>,
    ) -> Result<()> {
        let Numbers { weights, gradients, momentum, average, scales } = *numbers;
        let [shorter, longer] = self.largest;
        let (table, grams) = (self.table.address(), self.grams.address());
        let rows = longer.div_ceil(PARTS);
        launch(
            Queue::Main,
            Kernel::MuonGram,
            Shape { shared: 4 * rows * shorter, ..Shape::new(PARTS, self.tensors, 256) },
            &[table.into(), gradients.into(), momentum.into(), scales.into(), grams.into()],
        )?;
        launch(
            Queue::Main,
            Kernel::MuonPolynomial,
            Shape { shared: 16 * shorter * shorter, ..Shape::new(self.tensors, 1, 256) },
            &[table.into(), scales.into(), grams.into()],
        )?;
        launch(
            Queue::Main,
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
                schedule.into(),
                progress.into(),
            ],
        )
    }
}
