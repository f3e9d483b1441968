//! Weights, their gradients, and Adam, which changes one matrix at a time or several; Muon for the hidden layers' weights.
//!
//! If there are weights for several stiffnesses ("knots"), the weights of a step are their weighted mean. The gradient of a knot's
//! weights is that of the step times the knot's share of the mean. Lists of tensors have the tensors of each knot one after the other.

#![expect(unsafe_code, reason = "launches on memory of the device")]

use std::{collections::BTreeMap, sync::Arc};

use eddy_inference::checkpoint::{Weights, tensors_of_knots};

use super::{
    Matrix, Packing, Settings, Tables,
    muon::{Buffers, Muon},
};
use crate::{
    device::{Buffer, Device, Kernel, List, Pointer, Queue, Shape, count},
    error::Result,
    kernels::training::{
        adam::{Adam, CHUNKS, Clip, Finish, Place, SquaresOfGradient},
        knots::{MixWeights, ShareScales},
    },
};

/// Weights on a device, with what their training needs.
pub struct Optimizer {
    device: Arc<dyn Device>,
    packing: Packing,
    /// Of each matrix.
    places: List<Place>,
    clip: f32,
    epsilon: f32,
    /// Of a step.
    pub(crate) weights: List<f32>,
    pub(crate) gradients: List<f32>,
    knots: Option<Knots>,
    /// Moments and averages of each knot, if there are several.
    first: List<f32>,
    second: List<f32>,
    average: Option<List<f32>>,
    /// Parts of the squares of each tensor's gradient.
    squares: List<f32>,
    /// What each is multiplied by.
    scales: List<f32>,
    /// Squares of their norms.
    totals: List<f32>,
    muon: Option<Muon>,
}

/// Weights for several stiffnesses.
struct Knots {
    count: usize,
    /// `[knots, size]`.
    weights: List<f32>,
    /// What gradients are multiplied by, `[knots, tensors]`.
    scales: List<f32>,
}

/// Where the weights of a knot, or the only ones, are, and what changes them.
struct OfKnot {
    weights: Pointer<f32>,
    first: Pointer<f32>,
    second: Pointer<f32>,
    average: Pointer<f32>,
    scales: Pointer<f32>,
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
        let numbers = |count: usize| List::new(&**device, count);
        let place = |matrix: &Matrix| Place {
            first: count(matrix.first),
            rows: count(matrix.rows),
            columns: count(matrix.columns),
            bias: count(matrix.bias),
            width: count(matrix.width),
            tensor: count(matrix.tensor),
            tensors: count(matrix.tensors()),
            // All parts of a matrix are hidden, or none.
            muon: (settings.muon && matrix.is_hidden(0)).into(),
        };
        let places: Vec<_> = packing.matrices().iter().map(place).collect();
        Ok(Self {
            places: List::of(&**device, &places)?,
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
    fn trained(&self) -> &List<f32> {
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
        let ordered = |buffer: Option<&List<f32>>| match buffer {
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
    pub(crate) fn averaged_weights(&self) -> &List<f32> {
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
    pub(crate) fn weight(&self, matrix: &Matrix) -> Pointer<f32> {
        self.weights.pointer().plus(matrix.first)
    }

    /// Where its gradient is.
    pub(crate) fn gradient(&self, matrix: &Matrix) -> Pointer<f32> {
        self.gradients.pointer().plus(matrix.first)
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
        self.launch(
            queue,
            Shape {
                grid: [chunks, most(Matrix::tensors), matrices.len()],
                ..Shape::new(1, 1, 256)
            },
            SquaresOfGradient {
                places: self.place(first),
                gradients: self.gradients.pointer(),
                squares: self.squares.pointer(),
            },
        )?;
        let tensors = last.tensor + last.tensors() - first.tensor;
        self.launch(
            queue,
            Shape::new(tensors, 1, 256),
            Clip {
                squares: self.squares.pointer().plus(first.tensor * CHUNKS),
                scales: self.scales.pointer().plus(first.tensor),
                totals: self.totals.pointer().plus(first.tensor),
                longest: self.clip,
            },
        )
    }

    /// Sets the weights of a step from those of the knots, if there are several.
    pub(crate) fn mix(&self, tables: &Tables) -> Result<()> {
        let Some(knots) = &self.knots else { return Ok(()) };
        let fours = self.packing.size / 4;
        self.launch(
            Queue::Main,
            Shape::new(fours.div_ceil(256), 1, 256),
            MixWeights {
                of_knots: knots.weights.pointer().cast(),
                weights: self.weights.pointer().cast(),
                n: count(fours),
                knots: count(knots.count),
                schedule: tables.schedule.pointer(),
                progress: tables.progress.pointer(),
            },
        )
    }

    /// Of each knot, or of the only weights.
    fn of_knots(&self) -> impl Iterator<Item = OfKnot> {
        let Packing { size, tensors, .. } = self.packing;
        (0..self.sets()).map(move |knot| {
            let of_knot = |list: &List<f32>| list.pointer().plus(knot * size);
            OfKnot {
                weights: of_knot(self.trained()),
                first: of_knot(&self.first),
                second: of_knot(&self.second),
                average: self.average.as_ref().map_or(Pointer::NULL, of_knot),
                scales: match &self.knots {
                    None => self.scales.pointer(),
                    Some(knots) => knots.scales.pointer().plus(knot * tensors),
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
                Shape::new(tensors.div_ceil(256), knots.count, 256),
                ShareScales {
                    scales: self.scales.pointer(),
                    shared: knots.scales.pointer(),
                    tensors: count(tensors),
                    schedule: tables.schedule.pointer(),
                    progress: tables.progress.pointer(),
                },
            )?;
        }
        let most = matrices.iter().map(Matrix::size).max().unwrap_or_default();
        self.of_knots().try_for_each(|changed| {
            self.launch(
                queue,
                Shape {
                    grid: [(most / 4).div_ceil(256), 1, matrices.len()],
                    ..Shape::new(1, 1, 256)
                },
                Adam {
                    places: self.place(first),
                    w: changed.weights.cast(),
                    g: self.gradients.pointer().cast(),
                    first: changed.first.cast(),
                    second: changed.second.cast(),
                    average: changed.average.cast(),
                    scales: changed.scales,
                    schedule: tables.schedule.pointer(),
                    progress: tables.progress.pointer(),
                    epsilon: self.epsilon,
                },
            )
        })
    }

    /// Muon for the weights of all hidden layers, which Adam leaves as they are; nothing if it was not asked for.
    pub(crate) fn change_hidden(&self, tables: &Tables) -> Result<()> {
        let Some(muon) = &self.muon else { return Ok(()) };
        self.of_knots().try_for_each(|changed| {
            let buffers = Buffers {
                weights: changed.weights,
                gradients: self.gradients.pointer(),
                momentum: changed.first,
                average: changed.average,
                scales: changed.scales,
            };
            muon.change(&*self.device, &buffers, tables)
        })
    }

    /// Where the place of a matrix is, before those of the following ones.
    fn place(&self, matrix: &Matrix) -> Pointer<Place> {
        self.places.pointer().plus(matrix.number)
    }

    /// Ends a step.
    pub(crate) fn finish(&self, tables: &Tables) -> Result<()> {
        self.launch(
            Queue::Main,
            Shape::new(1, 1, 256),
            Finish {
                totals: self.totals.pointer(),
                tensors: count(self.packing.tensors),
                progress: tables.progress.pointer(),
                outcomes: tables.outcomes.pointer(),
            },
        )
    }

    fn launch(&self, queue: Queue, shape: Shape, kernel: impl Kernel) -> Result<()> {
        // SAFETY: every call of this file passes places within buffers that `new` has made for the matrices.
        unsafe { self.device.launch(queue, shape, &kernel) }
    }
}
