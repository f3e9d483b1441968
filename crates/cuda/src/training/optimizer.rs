//! Weights, their gradients, and Adam, which changes one matrix at a time or several; Muon for the hidden layers' weights.
//!
//! If there are weights for several stiffnesses ("knots"), the weights of a step are their weighted mean. The gradient of a knot's
//! weights is that of the step times the knot's share of the mean. Lists of tensors have the tensors of each knot one after the other.

#![expect(unsafe_code, reason = "launches on memory of the device")]

use std::{collections::BTreeMap, sync::Arc};

use eddy_inference::checkpoint::{Weights, tensors_of_knots};

use super::{
    CHUNKS, Matrix, Packing, Settings, Tables,
    muon::{Buffers, Muon},
};
use crate::{
    device::{Address, Argument, Buffer, Device, Queue, Shape},
    error::Result,
    kernels::Kernel,
};

/// Words of a `Place` of the kernels.
const PLACE: usize = 8;

/// Weights on a device, with what their training needs.
pub struct Optimizer {
    device: Arc<dyn Device>,
    packing: Packing,
    /// `Place` of each matrix.
    places: Buffer,
    clip: f32,
    epsilon: f32,
    /// Of a step.
    pub(crate) weights: Buffer,
    pub(crate) gradients: Buffer,
    knots: Option<Knots>,
    /// Moments and averages of each knot, if there are several.
    first: Buffer,
    second: Buffer,
    average: Option<Buffer>,
    /// Parts of the squares of each tensor's gradient.
    squares: Buffer,
    /// What each is multiplied by.
    scales: Buffer,
    /// Squares of their norms.
    totals: Buffer,
    muon: Option<Muon>,
}

/// Weights for several stiffnesses.
struct Knots {
    count: usize,
    /// `[knots, size]`.
    weights: Buffer,
    /// What gradients are multiplied by, `[knots, tensors]`.
    scales: Buffer,
}

/// Where the weights of a knot, or the only ones, are, and what changes them.
struct OfKnot {
    weights: Address,
    first: Address,
    second: Address,
    average: Address,
    scales: Address,
}

impl Optimizer {
    /// Memory for these matrices, weights all zero.
    ///
    /// # Errors
    /// [`CudaError::Call`](crate::CudaError::Call), as of all that follows; [`CudaError::Unsupported`](crate::CudaError::Unsupported)
    /// for a layer that is too wide for Muon.
    pub(crate) fn new(
        device: &Arc<dyn Device>,
        packing: &Packing,
        settings: &Settings,
    ) -> Result<Self> {
        let numbers = |count: usize| device.allocate(4 * count);
        let place = |matrix: &Matrix| -> [u32; PLACE] {
            let Matrix { first, rows, columns, bias, width, tensor, .. } = *matrix;
            // All parts of a matrix are hidden, or none.
            let muon = usize::from(settings.muon && matrix.is_hidden(0));
            [first, rows, columns, bias, width, tensor, matrix.tensors(), muon].map(|n| n as u32)
        };
        let all: Vec<_> = packing.matrices().iter().map(place).collect();
        let places = device.allocate(size_of_val(all.as_slice()))?;
        device.write(&places, 0, bytemuck::cast_slice(&all))?;
        Ok(Self {
            places,
            clip: settings.clip,
            epsilon: settings.epsilon,
            weights: numbers(packing.size)?,
            gradients: numbers(packing.size)?,
            first: numbers(settings.knots * packing.size)?,
            second: numbers(settings.knots * packing.size)?,
            average: settings
                .average
                .then(|| numbers(settings.knots * packing.size))
                .transpose()?,
            knots: (settings.knots > 1)
                .then(|| {
                    Ok(Knots {
                        count: settings.knots,
                        weights: numbers(settings.knots * packing.size)?,
                        scales: numbers(settings.knots * packing.tensors)?,
                    })
                })
                .transpose()?,
            squares: numbers(packing.tensors * CHUNKS)?,
            scales: numbers(packing.tensors)?,
            totals: numbers(packing.tensors)?,
            muon: settings.muon.then(|| Muon::new(&**device, packing)).transpose()?,
            packing: packing.clone(),
            device: Arc::clone(device),
        })
    }

    /// Number of sets of weights.
    fn sets(&self) -> usize {
        self.knots.as_ref().map_or(1, |knots| knots.count)
    }

    /// The weights that are trained.
    fn trained(&self) -> &Buffer {
        self.knots.as_ref().map_or(&self.weights, |knots| &knots.weights)
    }

    /// Puts packed weights onto the device, those of each knot one after the other, and as their running average, which begins at them.
    pub(crate) fn write_weights(&self, all: &[f32]) -> Result<()> {
        [Some(self.trained()), self.average.as_ref()]
            .into_iter()
            .flatten()
            .try_for_each(|buffer| self.device.write(buffer, 0, bytemuck::cast_slice(all)))
    }

    /// Puts what the optimizer remembers of each tensor onto the device: first and second moments and the weights' running
    /// average, in the order of checkpoints' layers, matrices as `[in, out]`; empty before a tensor's first step.
    ///
    /// # Errors
    /// As above.
    pub fn set_moments<'a>(&self, moments: impl IntoIterator<Item = [&'a [f32]; 3]>) -> Result<()> {
        let moments: Vec<_> = moments.into_iter().collect();
        let buffers = [Some(&self.first), Some(&self.second), self.average.as_ref()];
        for (number, buffer) in buffers.into_iter().enumerate() {
            if let Some(buffer) = buffer {
                let of_knot = moments.chunks(self.packing.tensors).flat_map(|tensors| {
                    self.packing.pack_ordered(tensors.iter().map(|tensor| tensor[number]))
                });
                let mut all: Vec<f32> = of_knot.collect();
                all.resize(self.sets() * self.packing.size, 0.0);
                self.device.write(buffer, 0, bytemuck::cast_slice(&all))?;
            }
        }
        Ok(())
    }

    /// The weights in the order of checkpoints' layers, matrices as `[in, out]`, and the same of the first and second
    /// moments and the running average; that is empty where none is kept.
    ///
    /// # Errors
    /// As above.
    pub fn state(&self) -> Result<[Vec<Vec<f32>>; 4]> {
        let count = self.sets();
        let ordered = |buffer: Option<&Buffer>| match buffer {
            Some(buffer) => {
                let all = self.numbers(buffer, count)?;
                let of_knot = all.chunks(self.packing.size);
                Ok(of_knot.flat_map(|all| self.packing.unpack_ordered(all)).collect())
            }
            None => Ok(vec![Vec::new(); count * self.packing.tensors]),
        };
        let [weights, first, second] = [self.trained(), &self.first, &self.second];
        Ok([
            ordered(Some(weights))?,
            ordered(Some(first))?,
            ordered(Some(second))?,
            ordered(self.average.as_ref())?,
        ])
    }

    pub(super) fn weights(&self) -> Result<BTreeMap<String, Weights>> {
        self.read(self.trained(), self.sets())
    }

    pub(super) fn average(&self) -> Result<BTreeMap<String, Weights>> {
        self.read(self.averaged_weights(), self.sets())
    }

    pub(super) fn gradients(&self) -> Result<BTreeMap<String, Weights>> {
        self.read(&self.gradients, 1)
    }

    /// The running average where it lies on the device; the weights themselves where none is kept.
    pub(crate) fn averaged_weights(&self) -> &Buffer {
        self.average.as_ref().unwrap_or_else(|| self.trained())
    }

    fn read(&self, buffer: &Buffer, count: usize) -> Result<BTreeMap<String, Weights>> {
        let all = self.numbers(buffer, count)?;
        let mut of_knot = all.chunks(self.packing.size).map(|all| self.packing.unpack(all));
        Ok(match count {
            1 => of_knot.next().unwrap_or_default(),
            _ => tensors_of_knots(&of_knot.collect::<Vec<_>>()),
        })
    }

    fn numbers(&self, buffer: &Buffer, count: usize) -> Result<Vec<f32>> {
        let mut all = vec![0f32; count * self.packing.size];
        self.device.read(buffer, 0, bytemuck::cast_slice_mut(&mut all))?;
        Ok(all)
    }

    /// Where a matrix of the weights is.
    pub(crate) fn weight(&self, matrix: &Matrix) -> Address {
        self.weights.address().plus(matrix.first)
    }

    /// Where its gradient is.
    pub(crate) fn gradient(&self, matrix: &Matrix) -> Address {
        self.gradients.address().plus(matrix.first)
    }

    /// The gradients by these matrices, one behind the other in the network, averaged over the devices, their norms, and what
    /// shortens them.
    pub(crate) fn measure(&self, queue: Queue, matrices: &[Matrix]) -> Result<()> {
        let (Some(first), Some(last)) = (matrices.first(), matrices.last()) else { return Ok(()) };
        let numbers = last.first + last.size() - first.first;
        // SAFETY: the matrices lie one behind the other within the gradients.
        unsafe { self.device.average(queue, self.gradient(first), numbers) }?;
        let most = |of: fn(&Matrix) -> usize| matrices.iter().map(of).max().unwrap_or_default();
        // A block has 256 times 4 numbers or more.
        let chunks = most(Matrix::size).div_ceil(1024).min(CHUNKS);
        let squares = self.squares.address();
        self.launch(
            queue,
            Kernel::SquaresOfGradient,
            Shape {
                grid: [chunks, most(Matrix::tensors), matrices.len()],
                ..Shape::new(1, 1, 256)
            },
            &[self.place(first).into(), self.gradients.address().into(), squares.into()],
        )?;
        let tensors = last.tensor + last.tensors() - first.tensor;
        self.launch(
            queue,
            Kernel::Clip,
            Shape::new(tensors, 1, 256),
            &[
                squares.plus(first.tensor * CHUNKS).into(),
                self.scales.address().plus(first.tensor).into(),
                self.totals.address().plus(first.tensor).into(),
                self.clip.into(),
            ],
        )
    }

    /// Sets the weights of a step from those of the knots, if there are several.
    pub(crate) fn mix(&self, tables: &Tables) -> Result<()> {
        let Some(knots) = &self.knots else { return Ok(()) };
        let fours = self.packing.size / 4;
        self.launch(
            Queue::Main,
            Kernel::MixWeights,
            Shape::new(fours.div_ceil(256), 1, 256),
            &[
                knots.weights.address().into(),
                self.weights.address().into(),
                fours.into(),
                knots.count.into(),
                tables.schedule.address().into(),
                tables.progress.address().into(),
            ],
        )
    }

    /// Of each knot, or of the only weights.
    fn of_knots(&self) -> impl Iterator<Item = OfKnot> {
        let Packing { size, tensors, .. } = self.packing;
        (0..self.sets()).map(move |knot| {
            let of_knot = |buffer: &Buffer| buffer.address().plus(knot * size);
            OfKnot {
                weights: of_knot(self.trained()),
                first: of_knot(&self.first),
                second: of_knot(&self.second),
                average: self.average.as_ref().map_or(Address::NULL, of_knot),
                scales: match &self.knots {
                    None => self.scales.address(),
                    Some(knots) => knots.scales.address().plus(knot * tensors),
                },
            }
        })
    }

    /// Adam for these matrices, as in [`Self::measure`], once nothing needs the old weights any more; all of them at once, if there are
    /// several knots.
    pub(crate) fn change(&self, queue: Queue, matrices: &[Matrix], tables: &Tables) -> Result<()> {
        let Some(first) = matrices.first() else { return Ok(()) };
        if let Some(knots) = &self.knots {
            let tensors = self.packing.tensors;
            self.launch(
                queue,
                Kernel::ShareScales,
                Shape::new(tensors.div_ceil(256), knots.count, 256),
                &[
                    self.scales.address().into(),
                    knots.scales.address().into(),
                    tensors.into(),
                    tables.schedule.address().into(),
                    tables.progress.address().into(),
                ],
            )?;
        }
        let most = matrices.iter().map(Matrix::size).max().unwrap_or_default();
        self.of_knots().try_for_each(|changed| {
            self.launch(
                queue,
                Kernel::Adam,
                Shape {
                    grid: [(most / 4).div_ceil(256), 1, matrices.len()],
                    ..Shape::new(1, 1, 256)
                },
                &[
                    self.place(first).into(),
                    changed.weights.into(),
                    self.gradients.address().into(),
                    changed.first.into(),
                    changed.second.into(),
                    changed.average.into(),
                    changed.scales.into(),
                    tables.schedule.address().into(),
                    tables.progress.address().into(),
                    self.epsilon.into(),
                ],
            )
        })
    }

    /// Muon for the weights of all hidden layers, which Adam leaves as they are; nothing if it was not asked for.
    pub(crate) fn change_hidden(&self, tables: &Tables) -> Result<()> {
        let Some(muon) = &self.muon else { return Ok(()) };
        self.of_knots().try_for_each(|changed| {
            let buffers = Buffers {
                weights: changed.weights,
                gradients: self.gradients.address(),
                momentum: changed.first,
                average: changed.average,
                scales: changed.scales,
            };
            muon.change(&*self.device, &buffers, tables)
        })
    }

    /// Where the place of a matrix is, before those of the following ones.
    fn place(&self, matrix: &Matrix) -> Address {
        self.places.address().plus(matrix.number * PLACE)
    }

    /// Ends a step.
    pub(crate) fn finish(&self, tables: &Tables) -> Result<()> {
        self.launch(
            Queue::Main,
            Kernel::Finish,
            Shape::new(1, 1, 256),
            &[
                self.totals.address().into(),
                self.packing.tensors.into(),
                tables.progress.address().into(),
                tables.outcomes.address().into(),
            ],
        )
    }

    fn launch(
        &self,
        queue: Queue,
        kernel: Kernel,
        shape: Shape,
        arguments: &[Argument],
    ) -> Result<()> {
        // SAFETY: every call of this file passes the kernel's parameters in type and order, and places within buffers that
        // `new` has made for the matrices.
        unsafe { self.device.launch(queue, kernel, shape, arguments) }
    }
}
