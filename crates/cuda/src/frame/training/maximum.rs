//! Training through a pooling by the maximum.

use crate::{
    device::{Buffer, Device, MOST_BLOCKS, Queue, Shape},
    error::Result,
    frame::maximum::Points,
    kernels::{AXES, Constants, Kernel, MATERIALS},
    training::Settings,
};

use super::{BODY, Training};

/// Memory for the outputs of particles (bytes).
const POINTS: usize = 256 << 20;

/// What a pooling by the maximum needs.
pub(super) struct Maximum {
    points: Points,
    /// Windows whose particles' outputs are in memory at the same time.
    group: usize,
    /// The particles that have the maxima, `[T, B, H]`.
    which: Buffer,
    /// Gradient by the means' part of the core's input, `[T, B, HP]`, where there are means.
    pub(super) d_mean: Option<Buffer>,
    /// Gradients by the first Linear, for each unit of the second, `[H, features + materials, E]`.
    parts: Buffer,
    /// Gradients by the particles that have the maxima, `[B, H]`, where frames are predicted freely.
    slopes: Option<Buffer>,
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
        let numbers = |count: usize| device.allocate(4 * count);
        let optional = |is: bool, count: usize| is.then(|| numbers(count)).transpose();
        let group = Points::rows_within(constants, POINTS).min(rows).min(MOST_BLOCKS);
        Ok(Self {
            points: Points::new(device, constants, group, 1)?,
            group,
            which: numbers(rows * hidden)?,
            d_mean: optional(constants.mean(), rows * constants.hidden_columns())?,
            parts: numbers(hidden * (2 * AXES + MATERIALS) * encoder)?,
            slopes: optional(settings.unroll > 1, settings.batch * hidden * BODY)?,
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
                Kernel::EncodePoints,
                points.shape(particles, rows),
                &[
                    self.states.address().plus(from * particles * BODY).into(),
                    self.store.material.address().into(),
                    self.tables.windows.address().into(),
                    self.tables.progress.address().into(),
                    self.weight(&self.layout.points).into(),
                    self.scaling.address().into(),
                    points.inputs.address().into(),
                    from.into(),
                    batch.into(),
                ],
            )?;
            let product =
                points.product(&self.layout.pooled, 0, rows * particles, &self.optimizer.weights);
            // SAFETY: buffers are those that `new` has made for these sizes.
            unsafe { self.device.multiply(Queue::Main, &product) }?;
            self.launch(
                Kernel::Largest,
                Points::largest(&self.constants, rows),
                &[
                    points.outputs.address().into(),
                    (points.strides[1] as u64).into(),
                    self.input.address().plus(from * columns).into(),
                    maximum.which.address().plus(from * hidden).into(),
                ],
            )?;
        }
        Ok(())
    }

    /// The gradient by the means' part of the core's input, of frames `first..first + frames`.
    pub(super) fn mean_part(&self, d_mean: &Buffer, first: usize, frames: usize) -> Result<()> {
        self.launch(
            Kernel::MeanPart,
            self.units(frames),
            &[
                self.at(&self.d_input, first, self.constants.input_columns()).into(),
                self.at(d_mean, first, self.constants.hidden_columns()).into(),
            ],
        )
    }

    /// The gradients by both Linears through the maxima of `rows` rows, added to those through the means, in the side queue.
    pub(super) fn learn_maxima(&self, maximum: &Maximum, rows: usize) -> Result<()> {
        self.launch_in(
            Queue::Side,
            Kernel::MaximumGradient,
            Shape::new(self.constants.hidden, 1, 256),
            &[
                self.states.address().into(),
                self.store.material.address().into(),
                self.tables.windows.address().into(),
                self.tables.progress.address().into(),
                self.weight(&self.layout.points).into(),
                self.scaling.address().into(),
                self.weight(&self.layout.pooled).into(),
                self.d_input.address().into(),
                maximum.which.address().into(),
                self.optimizer.gradients.address().plus(self.layout.pooled.first).into(),
                maximum.parts.address().into(),
                rows.into(),
                self.settings.batch.into(),
            ],
        )
    }

    /// Their part of the gradient by the first Linear, in the side queue.
    pub(super) fn sum_maxima(&self, maximum: &Maximum) -> Result<()> {
        let matrix = &self.layout.points;
        self.launch_in(
            Queue::Side,
            Kernel::MaximumSum,
            Shape {
                grid: [self.constants.encoder.div_ceil(32), matrix.rows, 1],
                block: [32, 32],
                shared: 0,
            },
            &[
                maximum.parts.address().into(),
                self.optimizer.gradients.address().plus(matrix.first).into(),
            ],
        )
    }

    /// The gradient by the particles of frame `frame` through its maxima.
    pub(super) fn maxima_by_points(&self, maximum: &Maximum, frame: usize) -> Result<()> {
        let Some(slopes) = &maximum.slopes else { return Ok(()) };
        let Constants { hidden, particles, .. } = self.constants;
        let batch = self.settings.batch;
        let which = self.at(&maximum.which, frame, hidden);
        self.launch(
            Kernel::MaximumSlopes,
            Shape::new(hidden, batch, 32),
            &[
                self.at(&self.states, frame, particles * BODY).into(),
                self.store.material.address().into(),
                self.tables.windows.address().into(),
                self.tables.progress.address().into(),
                self.weight(&self.layout.points).into(),
                self.scaling.address().into(),
                self.weight(&self.layout.pooled).into(),
                self.at(&self.d_input, frame, self.constants.input_columns()).into(),
                which.into(),
                slopes.address().into(),
            ],
        )?;
        self.launch(
            Kernel::MaximumPointsGradient,
            self.particles(1),
            &[which.into(), slopes.address().into(), self.carried.address().into()],
        )
    }
}
