//! Training through a pooling by the maximum.

use crate::{
    device::{Device, List, MOST_BLOCKS, Queue, Shape, count},
    error::Result,
    frame::maximum::Points,
    kernels::{
        Constants,
        frame::maximum::{
            EncodePoints, Largest, MaximumGradient, MaximumPointsGradient, MaximumSlopes,
            MaximumSum, MeanPart,
        },
    },
    streams::Body,
    training::Settings,
};

use super::Training;

/// Memory for the outputs of particles (bytes).
const POINTS: usize = 256 << 20;

/// What a pooling by the maximum needs.
pub(super) struct Maximum {
    points: Points,
    /// Windows whose particles' outputs are in memory at the same time.
    group: usize,
    /// The particles that have the maxima, `[T, B, H]`.
    which: List<u32>,
    /// Gradient by the means' part of the core's input, `[T, B, HP]`, where there are means.
    pub(super) d_mean: Option<List<f32>>,
    /// Gradients by the first Linear, for each unit of the second, `[H, features + materials, E]`.
    parts: List<f32>,
    /// Gradients by the particles that have the maxima, `[B, H]`, where frames are predicted freely.
    slopes: Option<List<Body>>,
}

impl Maximum {
    /// For so many frames of all windows.
    pub(super) fn new(
        device: &dyn Device,
        constants: &Constants,
        settings: &Settings,
        rows: usize,
    ) -> Result<Self> {
        let Constants { hidden, encoder, .. } = *constants;
        let numbers = |count: usize| List::new(device, count);
        let group = Points::rows_within(constants, POINTS).min(rows).min(MOST_BLOCKS);
        Ok(Self {
            points: Points::new(device, constants, group, 1)?,
            group,
            which: List::new(device, rows * hidden)?,
            d_mean: constants
                .mean()
                .then(|| numbers(rows * constants.hidden_columns()))
                .transpose()?,
            parts: numbers(hidden * constants.encoder_inputs() * encoder)?,
            slopes: (settings.unroll > 1)
                .then(|| List::new(device, settings.batch * hidden))
                .transpose()?,
        })
    }
}

impl Training {
    /// The maxima of frames `first..first + frames` into the core's input, behind the means.
    pub(super) fn maxima(&self, maximum: &Maximum, first: usize, frames: usize) -> Result<()> {
        let (batch, particles) = (self.settings.batch, self.constants.particles);
        let (columns, hidden) = (self.constants.input_columns(), self.constants.hidden);
        let all = first * batch..(first + frames) * batch;
        for from in all.clone().step_by(maximum.group) {
            let rows = maximum.group.min(all.end - from);
            let points = &maximum.points;
            self.launch(
                points.shape(particles, rows),
                EncodePoints {
                    states: self.states.pointer().plus(from * particles),
                    material: self.store.material.pointer(),
                    windows: self.tables.windows.pointer(),
                    progress: self.tables.progress.pointer(),
                    w: self.weight(&self.layout.points),
                    scaling: self.scaling.pointer(),
                    points: points.inputs.pointer(),
                    first: count(from),
                    batch: count(batch),
                },
            )?;
            let product =
                points.product(&self.layout.pooled, 0, rows * particles, &self.optimizer.weights);
            // SAFETY: buffers are those that `new` has made for these sizes.
            unsafe { self.device.multiply(Queue::Main, &product) }?;
            self.launch(
                Points::largest(&self.constants, rows),
                Largest {
                    outputs: points.outputs.pointer(),
                    stride: count(points.strides[1]),
                    input: self.input.pointer().plus(from * columns),
                    which: maximum.which.pointer().plus(from * hidden),
                },
            )?;
        }
        Ok(())
    }

    /// The gradient by the means' part of the core's input, of frames `first..first + frames`.
    pub(super) fn mean_part(&self, d_mean: &List<f32>, first: usize, frames: usize) -> Result<()> {
        self.launch(
            self.units(frames),
            MeanPart {
                input: self.at(&self.d_input, first, self.constants.input_columns()),
                mean: self.at(d_mean, first, self.constants.hidden_columns()),
            },
        )
    }

    /// The gradients by both Linears through the maxima of `rows` rows, added to those through the means, in the side queue.
    pub(super) fn learn_maxima(&self, maximum: &Maximum, rows: usize) -> Result<()> {
        self.launch_in(
            Queue::Side,
            Shape::new(self.constants.hidden, 1, 256),
            MaximumGradient {
                states: self.states.pointer(),
                material: self.store.material.pointer(),
                windows: self.tables.windows.pointer(),
                progress: self.tables.progress.pointer(),
                w: self.weight(&self.layout.points),
                scaling: self.scaling.pointer(),
                second: self.weight(&self.layout.pooled),
                d_input: self.d_input.pointer(),
                which: maximum.which.pointer(),
                d_second: self.optimizer.gradient(&self.layout.pooled),
                parts: maximum.parts.pointer(),
                rows: count(rows),
                batch: count(self.settings.batch),
            },
        )
    }

    /// Their part of the gradient by the first Linear, in the side queue.
    pub(super) fn sum_maxima(&self, maximum: &Maximum) -> Result<()> {
        let matrix = &self.layout.points;
        self.launch_in(
            Queue::Side,
            Shape {
                grid: [self.constants.encoder.div_ceil(32), matrix.rows, 1],
                block: [32, 32],
                shared: 0,
            },
            MaximumSum { parts: maximum.parts.pointer(), dw: self.optimizer.gradient(matrix) },
        )
    }

    /// The gradient by the particles of frame `frame` through its maxima.
    pub(super) fn maxima_by_points(&self, maximum: &Maximum, frame: usize) -> Result<()> {
        let Some(slopes) = &maximum.slopes else { return Ok(()) };
        let Constants { hidden, particles, .. } = self.constants;
        let batch = self.settings.batch;
        let which = self.at(&maximum.which, frame, hidden);
        self.launch(
            Shape::new(hidden, batch, 32),
            MaximumSlopes {
                states: self.at(&self.states, frame, particles),
                material: self.store.material.pointer(),
                windows: self.tables.windows.pointer(),
                progress: self.tables.progress.pointer(),
                w: self.weight(&self.layout.points),
                scaling: self.scaling.pointer(),
                second: self.weight(&self.layout.pooled),
                d_input: self.at(&self.d_input, frame, self.constants.input_columns()),
                which,
                slopes: slopes.pointer(),
            },
        )?;
        let (slopes, carried) = (slopes.pointer(), self.carried.pointer());
        self.launch(self.particles(1), MaximumPointsGradient { which, slopes, carried })
    }
}
