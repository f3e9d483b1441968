//! Training steps of the frame model: windows out of the store, forward, loss, backward, Adam.
//!
//! The warm-up's W frames go through the network together. Each further frame goes alone, from the prediction
//! before; the backward pass takes these frames in the reverse order. Gradients by the weights are products over the
//! rows of all frames, made once the first frames' gradients are there.

#![expect(unsafe_code, reason = "launches and products on memory of the device")]

mod maximum;

use std::{cell::Cell, sync::Arc};

use eddy_inference::checkpoint::{Core, Description, Weights};
use std::collections::BTreeMap;

use super::{
    data::{Bodies, Store, Window, key},
    layout::{Layout, Matrix},
};
use crate::{
    device::{Address, Argument, Buffer, Device, Factor, Product, Queue, Recording, Shape},
    error::{CudaError, Result},
    kernels::{AXES, Constants, Kernel, MATERIALS, gates, scaling},
};
use maximum::Maximum;

/// Steps whose tables fit on the device at once.
pub const GROUP: usize = 64;
/// Numbers of a body.
const BODY: usize = 2 * AXES;
/// Sums of the encoder for each of its units, `SUMS` of the kernels.
const SUMS: usize = BODY + MATERIALS + 1;
/// Blocks that fetch windows: enough to keep the bus busy, few, since they wait beside those of the step.
const FETCHING: usize = 32;
/// Parts of a sum of squares.
const CHUNKS: usize = 256;
/// Nodes an axis of a density map that fit into shared memory.
const MOST_NODES: usize = 110;

/// What a training step is made of.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// B, windows of a batch, of those on this device where several train together.
    pub batch: usize,
    /// W, observed frames of a window.
    pub warm_up: usize,
    /// K, frames predicted freely after them.
    pub unroll: usize,
    /// Whether the loss is the root of each window's sum.
    pub relative: bool,
    /// Weight of the predictions made during the warm-up.
    pub observed_weight: f32,
    /// Weight of the density maps' mean squared error.
    pub density_weight: f32,
    /// Nodes of a density map along an axis.
    pub density_nodes: usize,
    /// Share of the core's outputs dropped after each layer.
    pub dropout: f32,
    /// Standard deviations of the noise on positions (domain lengths) and velocities (domain lengths per second).
    pub noise: [f32; 2],
    /// Largest norm of a tensor's gradient.
    pub clip: f32,
    /// Keeps a step finite where gradients vanish.
    pub epsilon: f32,
    /// Whether a running average of the weights is kept.
    pub average: bool,
}

impl Settings {
    /// The mean squared error of all frames, and nothing beside it, for windows of `warm_up` observed frames and the next.
    pub fn plain(batch: usize, warm_up: usize) -> Self {
        Self {
            batch,
            warm_up,
            unroll: 1,
            relative: false,
            observed_weight: 1.0,
            density_weight: 0.0,
            density_nodes: 32,
            dropout: 0.0,
            noise: [0.0, 0.0],
            clip: f32::INFINITY,
            epsilon: 1e-8,
            average: false,
        }
    }
}

/// One step, as the host prepares it.
#[derive(Clone, Debug, PartialEq)]
pub struct Batch {
    /// B windows.
    pub windows: Vec<Window>,
    /// Learning rate, corrected for the first moment's start from zero.
    pub rate: f32,
    /// 1 / sqrt(1 - beta_2^t).
    pub correction: f32,
    /// Share of the running average that stays.
    pub kept: f32,
    /// Seed of ChaCha8 for dropout masks.
    pub dropout: [u8; 32],
    /// Weights of squared errors of x, y, vx, vy, `[K, B, MATERIALS]`, where they differ from batch to batch.
    pub weights: Option<Vec<[f32; 4]>>,
}

/// What came of a step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Outcome {
    /// The loss before the step.
    pub loss: f32,
    /// Norm of the gradient by all tensors, before any was shortened.
    pub gradient_norm: f32,
    /// Whether that was not finite; then tensors without a finite gradient stayed as they were.
    pub not_finite: bool,
}

/// A layer of the core in the memory of the device; `T` frames of `B` windows.
struct LayerMemory {
    /// Gates, later gradients by them, `[T, B, gates * HP]`.
    sums: Buffer,
    /// States, the one before the first frame first, `[T + 1, B, HP]`; of the MLP unused.
    states: Buffer,
    /// LSTM: cells, like states.
    cells: Option<Buffer>,
    /// GRU: gates from the last output, `[T, B, 3 HP]`.
    recurrent: Option<Buffer>,
    /// Outputs after dropout, `[T, B, HP]`; without dropout the states.
    dropped: Option<Buffer>,
    /// Gradient by the outputs, `[T, B, HP]`.
    gradient: Buffer,
    /// Gradient by the last state from later frames, `[B, HP]`.
    carried: Buffer,
    /// LSTM: the same by the cell.
    carried_cell: Option<Buffer>,
}

/// Windows that are fetched out of the memory of the host.
struct Staging {
    /// `sources` of the kernel.
    sources: Buffer,
    /// Windows of two steps, in turn, `[2, B, W + K, N]`.
    bodies: Buffer,
}

/// Training of a frame model on a device.
pub struct Training {
    device: Arc<dyn Device>,
    store: Arc<Store>,
    /// Where the store is in the memory of the host.
    staging: Option<Staging>,
    settings: Settings,
    constants: Constants,
    core: Core,
    layout: Layout,
    dt: f32,
    /// Left plus right wall (domain lengths).
    sides: f32,
    /// The density grid's first node and nodes per domain length, for each axis.
    grid: [[f32; AXES]; 2],
    /// Blocks that share the particles of a window.
    chunks: usize,

    weights: Buffer,
    gradients: Buffer,
    first: Buffer,
    second: Buffer,
    average: Option<Buffer>,

    windows: Buffer,
    schedule: Buffer,
    progress: Buffer,
    outcomes: Buffer,
    /// Losses to be averaged over the devices.
    losses: Buffer,
    error_weights: Buffer,
    scaling: Buffer,

    states: Buffer,
    sums: Buffer,
    pooled: Buffer,
    maximum: Option<Maximum>,
    input: Buffer,
    layers: Vec<LayerMemory>,
    mixed: Buffer,
    output: Buffer,

    squares: Buffer,
    densities: Buffer,
    density_gradient: Option<Buffer>,
    scales: Buffer,
    carried: Buffer,
    d_mixed: Buffer,
    d_input: Buffer,
    d_pooled: Buffer,
    tensor_squares: Buffer,
    tensor_scales: Buffer,
    tensor_totals: Buffer,

    recording: Option<Box<dyn Recording + Send>>,
    /// Whether a step has run, so that one can be recorded.
    ran: Cell<bool>,
}

impl Training {
    /// Memory for steps of these settings, weights all zero.
    ///
    /// # Errors
    /// [`CudaError::Unsupported`], [`CudaError::Memory`], [`CudaError::Call`].
    pub fn new(
        device: Arc<dyn Device>,
        store: Arc<Store>,
        description: &Description,
        settings: &Settings,
    ) -> Result<Self> {
        let constants = Constants::of(description)?;
        let density = settings.density_weight > 0.0;
        if density && settings.density_nodes > MOST_NODES {
            let setting = format!("loss.density_grid = {}", settings.density_nodes);
            return Err(CudaError::Unsupported { setting, expected: "at most 110" });
        }
        // Blocks of a grid along y.
        if settings.warm_up * settings.batch > 65_535 {
            let setting =
                format!("windows.warm_up x windows.batch = {}", settings.warm_up * settings.batch);
            return Err(CudaError::Unsupported { setting, expected: "at most 65535" });
        }
        assert_eq!(store.particles(), constants.particles, "particles of the store");
        let layout = Layout::new(description, &constants);
        let Settings { batch, warm_up, unroll, .. } = *settings;
        let frames = warm_up + unroll - 1;
        let decoded = first_decoded(settings);
        let (rows, decoded_rows) = (frames * batch, (frames - decoded) * batch);
        let (wide, particles) = (constants.hidden_columns(), constants.particles);
        let chunks = (512usize.div_ceil(batch)).clamp(1, particles.div_ceil(128));
        let core = description.core;

        let numbers = |count: usize| device.allocate(4 * count);
        let optional = |is: bool, count: usize| is.then(|| numbers(count)).transpose();
        let recurrent = matches!(core, Core::Gru | Core::Lstm);
        let layer = || -> Result<LayerMemory> {
            let memory = LayerMemory {
                sums: numbers(rows * gates(core) * wide)?,
                states: numbers((frames + 1) * batch * wide)?,
                cells: optional(core == Core::Lstm, (frames + 1) * batch * wide)?,
                recurrent: optional(core == Core::Gru, rows * gates(core) * wide)?,
                dropped: optional(settings.dropout > 0.0, rows * wide)?,
                gradient: numbers(rows * wide)?,
                carried: numbers(batch * wide)?,
                carried_cell: optional(core == Core::Lstm, batch * wide)?,
            };
            if recurrent {
                // The ones that the bias of W_hh is multiplied by.
                let mut before = vec![0f32; batch * wide];
                before.iter_mut().skip(constants.hidden).step_by(wide).for_each(|one| *one = 1.0);
                device.write(&memory.states, 0, bytemuck::cast_slice(&before))?;
            }
            Ok(memory)
        };
        let layers = (0..description.sizes.layers).map(|_| layer()).collect::<Result<Vec<_>>>()?;
        let cell = |axis: usize| {
            let width = description.domain.upper[axis] - description.domain.lower[axis];
            (settings.density_nodes as f32 - 1.0) / width
        };
        let staging = match &store.bodies {
            Bodies::Device(_) => None,
            Bodies::Host(_) => Some(Staging {
                sources: device.allocate(8 * (1 + GROUP * batch))?,
                bodies: numbers(2 * batch * (warm_up + unroll) * particles * BODY)?,
            }),
        };
        let training = Self {
            staging,
            weights: numbers(layout.size)?,
            gradients: numbers(layout.size)?,
            first: numbers(layout.size)?,
            second: numbers(layout.size)?,
            average: optional(settings.average, layout.size)?,
            windows: numbers(GROUP * batch * 14)?,
            schedule: numbers(GROUP * 12)?,
            progress: numbers(1)?,
            outcomes: numbers(GROUP * 4)?,
            losses: numbers(GROUP)?,
            error_weights: numbers(
                if settings.relative { GROUP } else { 1 } * unroll * batch * MATERIALS * BODY,
            )?,
            scaling: numbers(2 * BODY)?,
            states: numbers(rows * particles * BODY)?,
            sums: numbers(if constants.mean() {
                rows * chunks * SUMS * constants.encoder
            } else {
                0
            })?,
            pooled: numbers(rows * constants.pooled_columns())?,
            maximum: constants
                .maximum()
                .then(|| Maximum::new(&*device, &constants, settings, rows))
                .transpose()?,
            input: numbers(rows * constants.input_columns())?,
            layers,
            mixed: numbers(decoded_rows * wide)?,
            output: numbers(decoded_rows * constants.output_columns())?,
            squares: numbers(rows * particles.div_ceil(256))?,
            densities: numbers(unroll * batch)?,
            density_gradient: optional(density, unroll * batch * particles * AXES)?,
            scales: numbers(2 * batch)?,
            carried: numbers(batch * particles * BODY)?,
            d_mixed: numbers(decoded_rows * wide)?,
            d_input: numbers(rows * constants.input_columns())?,
            d_pooled: numbers(rows * constants.pooled_columns())?,
            tensor_squares: numbers(layout.tensors * CHUNKS)?,
            tensor_scales: numbers(layout.tensors)?,
            tensor_totals: numbers(layout.tensors)?,
            recording: None,
            ran: Cell::new(false),
            dt: description.dt,
            sides: description.domain.lower[0] + description.domain.upper[0],
            grid: [description.domain.lower, [cell(0), cell(1)]],
            chunks,
            settings: settings.clone(),
            core,
            layout,
            constants,
            store,
            device,
        };
        training.device.write(&training.scaling, 0, bytemuck::cast_slice(&scaling(description)))?;
        Ok(training)
    }

    /// Puts the weights of a checkpoint onto the device.
    ///
    /// # Errors
    /// [`CudaError::Call`].
    pub fn set_weights(&self, tensors: &BTreeMap<String, Weights>) -> Result<()> {
        self.device.write(&self.weights, 0, bytemuck::cast_slice(&self.layout.pack(tensors)))
    }

    /// Puts what Adam remembers of each tensor onto the device: first and second moments and the weights' running
    /// average, in the order of checkpoints' layers, matrices as `[in, out]`; empty before a tensor's first step.
    ///
    /// # Errors
    /// [`CudaError::Call`].
    pub fn set_moments<'a>(&self, moments: impl IntoIterator<Item = [&'a [f32]; 3]>) -> Result<()> {
        let moments: Vec<_> = moments.into_iter().collect();
        let buffers = [Some(&self.first), Some(&self.second), self.average.as_ref()];
        for (number, buffer) in buffers.into_iter().enumerate() {
            if let Some(buffer) = buffer {
                let all = self.layout.pack_ordered(moments.iter().map(|tensor| tensor[number]));
                self.device.write(buffer, 0, bytemuck::cast_slice(&all))?;
            }
        }
        Ok(())
    }

    /// The weights in the order of checkpoints' layers, matrices as `[in, out]`, and the same of the first and second
    /// moments and the running average; that is empty where none is kept.
    ///
    /// # Errors
    /// [`CudaError::Call`].
    pub fn state(&self) -> Result<[Vec<Vec<f32>>; 4]> {
        let ordered = |buffer: Option<&Buffer>| match buffer {
            Some(buffer) => Ok(self.layout.unpack_ordered(&self.numbers(buffer)?)),
            None => Ok(vec![Vec::new(); self.layout.tensors]),
        };
        let [weights, first, second] = [&self.weights, &self.first, &self.second];
        Ok([
            ordered(Some(weights))?,
            ordered(Some(first))?,
            ordered(Some(second))?,
            ordered(self.average.as_ref())?,
        ])
    }

    /// Sets weights of squared errors of x, y, vx, vy that hold for all batches, the same for every frame, window and
    /// material.
    ///
    /// # Errors
    /// [`CudaError::Call`].
    pub fn set_error_weights(&self, weights: [f32; 4]) -> Result<()> {
        let all = vec![weights; self.settings.unroll * self.settings.batch * MATERIALS];
        self.device.write(&self.error_weights, 0, bytemuck::cast_slice(&all))
    }

    /// The weights as a checkpoint has them.
    ///
    /// # Errors
    /// [`CudaError::Call`].
    pub fn weights(&self) -> Result<BTreeMap<String, Weights>> {
        self.read(&self.weights)
    }

    /// The running average of the weights; the weights themselves where none is kept.
    ///
    /// # Errors
    /// [`CudaError::Call`].
    pub fn average(&self) -> Result<BTreeMap<String, Weights>> {
        self.read(self.averaged_weights())
    }

    /// The gradient of the last step, before any tensor of it was shortened.
    ///
    /// # Errors
    /// [`CudaError::Call`].
    pub fn gradients(&self) -> Result<BTreeMap<String, Weights>> {
        self.read(&self.gradients)
    }

    /// The running average where it lies on the device; the weights themselves where none is kept.
    pub(super) fn averaged_weights(&self) -> &Buffer {
        self.average.as_ref().unwrap_or(&self.weights)
    }

    fn read(&self, buffer: &Buffer) -> Result<BTreeMap<String, Weights>> {
        Ok(self.layout.unpack(&self.numbers(buffer)?))
    }

    fn numbers(&self, buffer: &Buffer) -> Result<Vec<f32>> {
        let mut all = vec![0f32; self.layout.size];
        self.device.read(buffer, 0, bytemuck::cast_slice_mut(&mut all))?;
        Ok(all)
    }

    /// Starts up to [`GROUP`] steps; [`Self::outcomes`] waits for them.
    ///
    /// # Errors
    /// [`CudaError::Call`].
    ///
    /// # Panics
    /// With more steps, or with batches of another size than the settings say.
    pub fn start(&mut self, batches: &[Batch]) -> Result<()> {
        assert!(batches.len() <= GROUP, "{} steps, at most {GROUP}", batches.len());
        let (mut windows, mut schedule) = (Vec::new(), Vec::new());
        let mut sources = vec![batches.len() as u64];
        let frames = self.settings.warm_up + self.settings.unroll;
        for (step, batch) in batches.iter().enumerate() {
            assert_eq!(batch.windows.len(), self.settings.batch, "windows of a batch");
            assert!(
                batch.windows.iter().all(|window| self.store.contains(window, frames)),
                "windows within their streams"
            );
            let weights = batch.weights.as_ref().map(Vec::len);
            let expected = self
                .settings
                .relative
                .then_some(self.settings.unroll * self.settings.batch * MATERIALS);
            assert_eq!(weights, expected, "weights of a batch");
            for (number, window) in batch.windows.iter().enumerate() {
                let first = self.store.first(window);
                let place = step % 2 * self.settings.batch + number;
                let staged = (place * frames * self.constants.particles) as u64;
                windows.extend(window.words(self.staging.as_ref().map_or(first, |_| staged)));
                sources.push(first);
            }
            schedule.extend([batch.rate, batch.correction, batch.kept].map(f32::to_bits));
            schedule.push(0);
            schedule.extend(key(batch.dropout));
        }
        self.device.write(&self.windows, 0, bytemuck::cast_slice(&windows))?;
        self.device.write(&self.schedule, 0, bytemuck::cast_slice(&schedule))?;
        self.device.write(&self.progress, 0, bytemuck::cast_slice(&[0u32]))?;
        if batches.iter().any(|batch| batch.weights.is_some()) {
            let all: Vec<_> = batches
                .iter()
                .filter_map(|batch| batch.weights.as_deref())
                .flatten()
                .copied()
                .collect();
            self.device.write(&self.error_weights, 0, bytemuck::cast_slice(&all))?;
        }
        if let Some(staging) = &self.staging {
            self.device.write(&staging.sources, 0, bytemuck::cast_slice(&sources))?;
            self.fetch(Queue::Main, 0)?;
        }
        for _ in batches {
            match &self.recording {
                Some(recording) => recording.repeat()?,
                None if self.ran.get() => {
                    let device = self.device.clone();
                    self.recording = device.record(&mut || self.step())?;
                    match &self.recording {
                        Some(recording) => recording.repeat()?,
                        None => self.step()?,
                    }
                }
                None => {
                    self.step()?;
                    self.ran.set(true);
                }
            }
        }
        Ok(())
    }

    /// Means over the devices that train together, which all call this with as many numbers, at most [`GROUP`].
    ///
    /// # Errors
    /// [`CudaError::Call`].
    pub fn average_over_devices(&self, numbers: &mut [f32]) -> Result<()> {
        if self.device.rank().count == 1 {
            return Ok(());
        }
        self.device.write(&self.losses, 0, bytemuck::cast_slice(numbers))?;
        // SAFETY: `write` has checked the length.
        unsafe { self.device.average(Queue::Main, self.losses.address(), numbers.len()) }?;
        self.device.read(&self.losses, 0, bytemuck::cast_slice_mut(numbers))
    }

    /// What came of the steps started last, for the whole batch.
    ///
    /// # Errors
    /// [`CudaError::Call`].
    pub fn outcomes(&self, steps: usize) -> Result<Vec<Outcome>> {
        assert!(steps <= GROUP, "{steps} steps, at most {GROUP}");
        let mut words = vec![[0u32; 4]; steps];
        self.device.read(&self.outcomes, 0, bytemuck::cast_slice_mut(&mut words))?;
        let mut losses: Vec<_> = words.iter().map(|&[loss, ..]| f32::from_bits(loss)).collect();
        self.average_over_devices(&mut losses)?;
        let outcome = |(&[_, norm, not_finite, _], loss): (&[u32; 4], f32)| Outcome {
            loss,
            gradient_norm: f32::from_bits(norm),
            not_finite: not_finite != 0,
        };
        Ok(words.iter().zip(losses).map(outcome).collect())
    }
}

/// The first frame that the decoder runs on: earlier predictions count only where the loss asks for them.
fn first_decoded(settings: &Settings) -> usize {
    if settings.observed_weight > 0.0 { 0 } else { settings.warm_up - 1 }
}

/// The frames of a segment that the decoder runs on.
struct Decoded {
    /// The first of them.
    from: usize,
    /// Their windows.
    rows: usize,
    /// Where they start in the memory of the mixer's outputs, the gradient by these, and the decoder's outputs.
    mixed: Address,
    d_mixed: Address,
    output: Address,
}

/// The step itself.
impl Training {
    fn frames(&self) -> usize {
        self.settings.warm_up + self.settings.unroll - 1
    }

    /// The place of frame `t` in a buffer of so many numbers a window.
    fn at(&self, buffer: &Buffer, t: usize, numbers: usize) -> Address {
        buffer.address().plus(t * self.settings.batch * numbers)
    }

    /// `struct Frames` of the kernels.
    fn frames_argument(&self) -> Argument {
        let Settings { batch, warm_up, unroll, relative, .. } = self.settings;
        let even = if warm_up > 1 { unroll as f32 / (warm_up - 1) as f32 } else { 0.0 };
        let step = if relative { unroll * batch * MATERIALS } else { 0 };
        let counts =
            [batch, warm_up, unroll, first_decoded(&self.settings), step].map(|count| count as u32);
        let numbers = [self.dt, self.sides, even].map(f32::to_bits);
        let words: Vec<u32> = counts.into_iter().chain(numbers).collect();
        Argument::from_bytes(bytemuck::cast_slice(&words))
    }

    fn launch(&self, kernel: Kernel, shape: Shape, arguments: &[Argument]) -> Result<()> {
        self.launch_in(Queue::Main, kernel, shape, arguments)
    }

    fn launch_in(
        &self,
        queue: Queue,
        kernel: Kernel,
        shape: Shape,
        arguments: &[Argument],
    ) -> Result<()> {
        // SAFETY: every call of this file passes the kernel's parameters in type and order, and buffers that
        // `new` has made for these shapes.
        unsafe { self.device.launch(queue, kernel, shape, arguments) }
    }

    /// `output = input W` for `rows` rows; W has rows for the input's columns.
    fn forward_product(
        &self,
        matrix: &Matrix,
        input: Address,
        output: Address,
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
    fn backward_product(
        &self,
        matrix: &Matrix,
        slopes: Address,
        gradient: Address,
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
    fn weight_product(
        &self,
        matrix: &Matrix,
        input: Address,
        slopes: Address,
        rows: usize,
    ) -> Result<()> {
        let gradient = self.gradients.address().plus(matrix.first);
        self.product(
            Queue::Side,
            [input, slopes, gradient],
            [true, false],
            [matrix.rows, matrix.columns, matrix.columns],
            [matrix.rows, rows, matrix.columns],
            false,
        )
    }

    fn product(
        &self,
        queue: Queue,
        [left, right, result]: [Address; 3],
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

    fn weight(&self, matrix: &Matrix) -> Address {
        self.weights.address().plus(matrix.first)
    }

    /// Blocks over the hidden units of rows.
    fn units(&self, rows: usize) -> Shape {
        Shape::new(self.constants.hidden_columns().div_ceil(128), rows, 128)
    }

    /// Blocks over the particles of rows.
    fn particles(&self, rows: usize) -> Shape {
        Shape::new(self.constants.particles.div_ceil(256), rows, 256)
    }

    /// Where the bodies of the step's windows lie in the memory of the device.
    fn bodies(&self) -> Address {
        match (&self.store.bodies, &self.staging) {
            (Bodies::Device(buffer), _) | (_, Some(Staging { bodies: buffer, .. })) => {
                buffer.address()
            }
            (Bodies::Host(_), None) => Address::NULL,
        }
    }

    /// Fetches the windows of the step `ahead` steps from now, if they lie in the memory of the host.
    fn fetch(&self, queue: Queue, ahead: usize) -> Result<()> {
        let (Bodies::Host(host), Some(staging)) = (&self.store.bodies, &self.staging) else {
            return Ok(());
        };
        let frames = self.settings.warm_up + self.settings.unroll;
        self.launch_in(
            queue,
            Kernel::Fetch,
            Shape::new(self.settings.batch.min(FETCHING), 1, 256),
            &[
                host.address().into(),
                staging.sources.address().into(),
                self.progress.address().into(),
                staging.bodies.address().into(),
                ahead.into(),
                (frames * self.constants.particles).into(),
                self.settings.batch.into(),
            ],
        )
    }

    /// Puts a whole step into the queues.
    fn step(&self) -> Result<()> {
        let Settings { batch, warm_up, .. } = self.settings;
        if self.staging.is_some() {
            self.device.wait(Queue::Fetch, Queue::Main)?;
            self.fetch(Queue::Fetch, 1)?;
        }
        self.launch(
            Kernel::Observe,
            self.particles(warm_up * batch),
            &[
                self.bodies().into(),
                self.windows.address().into(),
                self.progress.address().into(),
                self.states.address().into(),
                batch.into(),
                self.sides.into(),
            ],
        )?;
        let [positions, velocities] = self.settings.noise;
        if positions > 0.0 || velocities > 0.0 {
            self.launch(
                Kernel::Disturb,
                self.particles(batch),
                &[
                    self.windows.address().into(),
                    self.progress.address().into(),
                    self.at(&self.states, warm_up - 1, self.constants.particles * BODY).into(),
                    positions.into(),
                    velocities.into(),
                ],
            )?;
        }
        let segments: Vec<(usize, usize)> =
            std::iter::once((0, warm_up)).chain((warm_up..self.frames()).map(|t| (t, 1))).collect();
        segments.iter().try_for_each(|&(first, frames)| self.forward(first, frames))?;
        self.loss()?;
        for layer in &self.layers {
            for carried in std::iter::once(&layer.carried).chain(&layer.carried_cell) {
                self.device.clear(Queue::Main, carried)?;
            }
        }
        segments.iter().rev().try_for_each(|&(first, frames)| self.backward(first, frames))?;
        self.device.wait(Queue::Main, Queue::Side)?;
        if self.staging.is_some() {
            self.device.wait(Queue::Main, Queue::Fetch)?;
        }
        self.launch(
            Kernel::Finish,
            Shape::new(1, 1, 256),
            &[
                self.tensor_totals.address().into(),
                self.layout.tensors.into(),
                self.progress.address().into(),
                self.outcomes.address().into(),
            ],
        )
    }

    /// The means of frames `first..first + frames` over their particles, through the second Linear.
    fn means(&self, first: usize, frames: usize) -> Result<()> {
        let (batch, rows) = (self.settings.batch, frames * self.settings.batch);
        let Constants { encoder, particles, .. } = self.constants;
        let sums = self.at(&self.sums, first, self.chunks * SUMS * encoder);
        let pooled = self.at(&self.pooled, first, self.constants.pooled_columns());
        let states: Argument = self.at(&self.states, first, particles * BODY).into();
        let rest: [Argument; 6] = [
            self.windows.address().into(),
            self.progress.address().into(),
            self.weight(&self.layout.points).into(),
            self.scaling.address().into(),
            sums.into(),
            batch.into(),
        ];
        let shape =
            Shape { grid: [self.chunks, rows, encoder.div_ceil(256)], block: [256, 1], shared: 0 };
        if self.device.rounds_to_tf32() {
            let material = self.store.material.address().into();
            let arguments: Vec<_> = [states, material].into_iter().chain(rest).collect();
            self.launch(Kernel::EncodeTensor, shape, &arguments)?;
        } else {
            let order =
                [&self.store.order, &self.store.segments].map(|buffer| buffer.address().into());
            let arguments: Vec<_> = [states].into_iter().chain(order).chain(rest).collect();
            self.launch(Kernel::Encode, shape, &arguments)?;
        }
        self.launch(
            Kernel::Pool,
            Shape::new(rows, 1, 256),
            &[sums.into(), pooled.into(), self.chunks.into()],
        )?;
        let (matrix, columns) = (&self.layout.pooled, self.constants.input_columns());
        self.product(
            Queue::Main,
            [pooled, self.weight(matrix), self.at(&self.input, first, columns)],
            [false, false],
            [matrix.rows, matrix.columns, columns],
            [rows, matrix.rows, matrix.columns],
            false,
        )
    }

    /// Frames `first..first + frames` through the network.
    fn forward(&self, first: usize, frames: usize) -> Result<()> {
        let (batch, wide) = (self.settings.batch, self.constants.hidden_columns());
        if self.constants.mean() {
            self.means(first, frames)?;
        }
        if let Some(maximum) = &self.maximum {
            self.maxima(maximum, first, frames)?;
        }
        let mut signal = self.at(&self.input, first, self.constants.input_columns());
        for number in 0..self.layers.len() {
            signal = self.core_forward(number, signal, first, frames)?;
        }

        let Decoded { from, rows, mixed, output, .. } = self.decoded(first, frames);
        let signal = signal.plus((from - first) * batch * wide);
        self.forward_product(&self.layout.mixer, signal, mixed, rows)?;
        self.launch(Kernel::ActivationForward, self.units(rows), &[mixed.into()])?;
        self.forward_product(&self.layout.decoder, mixed, output, rows)?;
        self.launch(
            Kernel::Advance,
            self.particles(rows),
            &[
                self.states.address().into(),
                self.output.address().into(),
                self.bodies().into(),
                self.windows.address().into(),
                self.progress.address().into(),
                self.store.material.address().into(),
                self.error_weights.address().into(),
                self.squares.address().into(),
                self.frames_argument(),
                from.into(),
            ],
        )
    }

    /// What the decoder sees of frames `first..first + frames`.
    fn decoded(&self, first: usize, frames: usize) -> Decoded {
        let decoded = first_decoded(&self.settings);
        let (from, wide) = (first.max(decoded), self.constants.hidden_columns());
        Decoded {
            from,
            rows: (first + frames - from) * self.settings.batch,
            mixed: self.at(&self.mixed, from - decoded, wide),
            d_mixed: self.at(&self.d_mixed, from - decoded, wide),
            output: self.at(&self.output, from - decoded, self.constants.output_columns()),
        }
    }

    /// A layer of the core; gives where its outputs for these frames are.
    fn core_forward(
        &self,
        number: usize,
        input: Address,
        first: usize,
        frames: usize,
    ) -> Result<Address> {
        let (batch, rows, wide) =
            (self.settings.batch, frames * self.settings.batch, self.constants.hidden_columns());
        let (layer, (matrix, recurrent)) = (&self.layers[number], &self.layout.core[number]);
        let gates = matrix.columns;
        let sums = self.at(&layer.sums, first, gates);
        let states = self.at(&layer.states, first, wide);
        self.forward_product(matrix, input, sums, rows)?;
        let output = match (self.core, recurrent) {
            (Core::Mlp, _) => {
                self.launch(Kernel::ActivationForward, self.units(rows), &[sums.into()])?;
                sums
            }
            (Core::MinGru | Core::MinLstm, _) | (_, None) => {
                let kernel = if self.core == Core::MinGru {
                    Kernel::MinGruForward
                } else {
                    Kernel::MinLstmForward
                };
                self.launch(
                    kernel,
                    self.units(batch),
                    &[sums.into(), states.into(), frames.into()],
                )?;
                states.plus(batch * wide)
            }
            (core, Some(recurrent)) => {
                for t in first..first + frames {
                    let (sums, states) =
                        (self.at(&layer.sums, t, gates), self.at(&layer.states, t, wide));
                    if let (Core::Lstm, Some(cells)) = (core, &layer.cells) {
                        self.product(
                            Queue::Main,
                            [states, self.weight(recurrent), sums],
                            [false, false],
                            [wide, gates, gates],
                            [batch, recurrent.rows, gates],
                            true,
                        )?;
                        let cells = self.at(cells, t, wide);
                        self.launch(
                            Kernel::LstmForward,
                            self.units(batch),
                            &[sums.into(), states.into(), cells.into()],
                        )?;
                    } else if let Some(from_state) = &layer.recurrent {
                        let from_state = self.at(from_state, t, gates);
                        self.forward_product(recurrent, states, from_state, batch)?;
                        self.launch(
                            Kernel::GruForward,
                            self.units(batch),
                            &[sums.into(), from_state.into(), states.into()],
                        )?;
                    }
                }
                states.plus(batch * wide)
            }
        };
        let Some(dropped) = &layer.dropped else { return Ok(output) };
        let to = self.at(dropped, first, wide);
        self.dropout(number, output, to, first, frames, 1.0)?;
        Ok(to)
    }

    /// Dropout of a layer's outputs, or of their gradients.
    fn dropout(
        &self,
        layer: usize,
        from: Address,
        to: Address,
        first: usize,
        frames: usize,
        ones: f32,
    ) -> Result<()> {
        let (batch, hidden, rank) =
            (self.settings.batch, self.constants.hidden, self.device.rank());
        // Words are drawn in the order of the forward pass: the warm-up's frames layer by layer, then frame by frame; in a
        // frame for the whole batch, of which this device has the windows from `rank.number * batch` on.
        let before = first * self.layers.len() + layer * frames;
        let together = if rank.count == 1 { frames } else { 1 };
        for frame in (0..frames).step_by(together) {
            let window = (before + frame) * batch * rank.count + rank.number * batch;
            let rows = together * batch;
            // Blocks of 16 words need not begin with the numbers.
            let blocks = (rows * hidden).div_ceil(16) + 1;
            let skipped = frame * batch * self.constants.hidden_columns();
            self.launch(
                Kernel::Dropout,
                Shape::new(blocks.div_ceil(128), 1, 128),
                &[
                    from.plus(skipped).into(),
                    to.plus(skipped).into(),
                    self.schedule.address().into(),
                    self.progress.address().into(),
                    ((window * hidden) as u64).into(),
                    rows.into(),
                    self.settings.dropout.into(),
                    ones.into(),
                ],
            )?;
        }
        Ok(())
    }

    /// Density maps and the loss, once all frames are predicted.
    fn loss(&self) -> Result<()> {
        let Settings {
            batch,
            unroll,
            density_weight,
            density_nodes,
            observed_weight,
            relative,
            ..
        } = self.settings;
        let nodes = density_nodes.pow(AXES as u32);
        let factor = if self.density_gradient.is_some() {
            density_weight / (unroll * batch * nodes) as f32
        } else {
            0.0
        };
        if let Some(gradient) = &self.density_gradient {
            let mut grid: Vec<u32> =
                self.grid.iter().flatten().map(|number| number.to_bits()).collect();
            grid.push(density_nodes as u32);
            self.launch(
                Kernel::Density,
                Shape { grid: [unroll, batch, 1], block: [256, 1], shared: 8 * nodes },
                &[
                    self.states.address().into(),
                    self.output.address().into(),
                    self.bodies().into(),
                    self.windows.address().into(),
                    self.progress.address().into(),
                    self.densities.address().into(),
                    gradient.address().into(),
                    self.frames_argument(),
                    Argument::from_bytes(bytemuck::cast_slice(&grid)),
                    factor.into(),
                ],
            )?;
        }
        self.launch(
            Kernel::Loss,
            Shape::new(1, 1, 256),
            &[
                self.squares.address().into(),
                self.constants.particles.div_ceil(256).into(),
                self.densities.address().into(),
                factor.into(),
                self.frames_argument(),
                usize::from(relative).into(),
                observed_weight.into(),
                self.scales.address().into(),
                self.progress.address().into(),
                self.outcomes.address().into(),
            ],
        )
    }

    /// The gradients of frames `first..first + frames`, and with the first ones the weights' and their change.
    fn backward(&self, first: usize, frames: usize) -> Result<()> {
        let batch = self.settings.batch;
        let wide = self.constants.hidden_columns();
        let decoded = first_decoded(&self.settings);
        let Decoded { from, rows, mixed, d_mixed, output } = self.decoded(first, frames);
        let last = first == 0;
        let density =
            self.density_gradient.as_ref().map_or(Address::NULL, |buffer| buffer.address());
        self.launch(
            Kernel::LossGradient,
            self.particles(rows),
            &[
                self.states.address().into(),
                self.output.address().into(),
                self.bodies().into(),
                self.windows.address().into(),
                self.progress.address().into(),
                self.store.material.address().into(),
                self.error_weights.address().into(),
                self.scales.address().into(),
                density.into(),
                self.carried.address().into(),
                self.frames_argument(),
                from.into(),
            ],
        )?;
        let all_decoded = (self.frames() - decoded) * batch;
        self.learn(
            last,
            &self.layout.decoder,
            self.mixed.address(),
            self.output.address(),
            all_decoded,
        )?;
        self.backward_product(&self.layout.decoder, output, d_mixed, rows, false)?;
        self.launch(Kernel::ActivationBackward, self.units(rows), &[d_mixed.into(), mixed.into()])?;
        self.change(last, &self.layout.decoder)?;

        let top = self.layers.len() - 1;
        let signal = self.outputs(top).plus(decoded * batch * wide);
        self.learn(last, &self.layout.mixer, signal, self.d_mixed.address(), all_decoded)?;
        self.backward_product(
            &self.layout.mixer,
            d_mixed,
            self.at(&self.layers[top].gradient, from, wide),
            rows,
            false,
        )?;
        self.change(last, &self.layout.mixer)?;

        for number in (0..self.layers.len()).rev() {
            self.core_backward(number, first, frames)?;
        }

        self.encoder_backward(first, frames)
    }

    /// The gradients of both Linears before the core, and those by the particles of frames that were predicted.
    fn encoder_backward(&self, first: usize, frames: usize) -> Result<()> {
        let (batch, wide) = (self.settings.batch, self.constants.hidden_columns());
        let (rows, all, last) = (frames * batch, self.frames() * batch, first == 0);
        // The gradient by the second Linear's outputs for the means; that of a pooling by the mean alone is there already.
        let mean = match &self.maximum {
            None => {
                let d_input = self.at(&self.d_input, first, wide);
                self.launch(
                    Kernel::ClearPadding,
                    Shape::new(rows.div_ceil(128), 1, 128),
                    &[d_input.into(), rows.into()],
                )?;
                Some(&self.d_input)
            }
            Some(Maximum { d_mean: Some(d_mean), .. }) => {
                self.mean_part(d_mean, first * batch, rows)?;
                Some(d_mean)
            }
            Some(_) => None,
        };
        if last {
            self.device.wait(Queue::Side, Queue::Main)?;
            if let Some(mean) = mean {
                let pooled = self.pooled.address();
                self.weight_product(&self.layout.pooled, pooled, mean.address(), all)?;
            }
            if let Some(maximum) = &self.maximum {
                self.learn_maxima(maximum, all)?;
            }
            self.measure(&self.layout.pooled)?;
        }
        if let Some(mean) = mean {
            let d_pooled = self.at(&self.d_pooled, first, self.constants.pooled_columns());
            let slopes = self.at(mean, first, wide);
            self.backward_product(&self.layout.pooled, slopes, d_pooled, rows, false)?;
        }
        if last {
            self.change(last, &self.layout.pooled)?;
            return self.learn_points(all);
        }
        if let Some(maximum) = &self.maximum {
            self.maxima_by_points(maximum, first)?;
        }
        if mean.is_none() {
            return Ok(());
        }
        self.launch(
            Kernel::EncoderPointsGradient,
            self.particles(batch),
            &[
                self.at(&self.states, first, self.constants.particles * BODY).into(),
                self.store.material.address().into(),
                self.windows.address().into(),
                self.progress.address().into(),
                self.weight(&self.layout.points).into(),
                self.scaling.address().into(),
                self.at(&self.d_pooled, first, self.constants.pooled_columns()).into(),
                self.carried.address().into(),
            ],
        )
    }

    /// Where the outputs of a layer of the core start.
    fn outputs(&self, number: usize) -> Address {
        let layer = &self.layers[number];
        match (&layer.dropped, self.core) {
            (Some(dropped), _) => dropped.address(),
            (None, Core::Mlp) => layer.sums.address(),
            (None, _) => self.at(&layer.states, 1, self.constants.hidden_columns()),
        }
    }

    fn core_backward(&self, number: usize, first: usize, frames: usize) -> Result<()> {
        let (batch, rows, wide) =
            (self.settings.batch, frames * self.settings.batch, self.constants.hidden_columns());
        let (layer, (matrix, recurrent)) = (&self.layers[number], &self.layout.core[number]);
        let gates = matrix.columns;
        let gradient = self.at(&layer.gradient, first, wide);
        let (sums, states) =
            (self.at(&layer.sums, first, gates), self.at(&layer.states, first, wide));
        if layer.dropped.is_some() {
            self.dropout(number, gradient, gradient, first, frames, 0.0)?;
        }
        let carried = layer.carried.address();
        // The MLP's outputs are where other cores have their sums, its gradients by the sums where others have those
        // by the outputs.
        let (slopes, all_slopes) = match self.core {
            Core::Mlp => (gradient, layer.gradient.address()),
            _ => (sums, layer.sums.address()),
        };
        match (self.core, recurrent) {
            (Core::Mlp, _) => {
                self.launch(
                    Kernel::ActivationBackward,
                    self.units(rows),
                    &[gradient.into(), sums.into()],
                )?;
            }
            (Core::MinGru | Core::MinLstm, _) | (_, None) => {
                let kernel = if self.core == Core::MinGru {
                    Kernel::MinGruBackward
                } else {
                    Kernel::MinLstmBackward
                };
                self.launch(
                    kernel,
                    self.units(batch),
                    &[sums.into(), states.into(), gradient.into(), carried.into(), frames.into()],
                )?;
            }
            (core, Some(recurrent)) => {
                for t in (first..first + frames).rev() {
                    let (sums, gradient) =
                        (self.at(&layer.sums, t, gates), self.at(&layer.gradient, t, wide));
                    if let (Core::Lstm, Some(cells), Some(carried_cell)) =
                        (core, &layer.cells, &layer.carried_cell)
                    {
                        let cells = self.at(cells, t, wide);
                        self.launch(
                            Kernel::LstmBackward,
                            self.units(batch),
                            &[
                                sums.into(),
                                cells.into(),
                                gradient.into(),
                                carried.into(),
                                carried_cell.address().into(),
                            ],
                        )?;
                        self.backward_product(recurrent, sums, carried, batch, false)?;
                    } else if let Some(from_state) = &layer.recurrent {
                        let (from_state, states) =
                            (self.at(from_state, t, gates), self.at(&layer.states, t, wide));
                        self.launch(
                            Kernel::GruBackward,
                            self.units(batch),
                            &[
                                sums.into(),
                                from_state.into(),
                                states.into(),
                                gradient.into(),
                                carried.into(),
                            ],
                        )?;
                        self.backward_product(recurrent, from_state, carried, batch, true)?;
                    }
                }
            }
        }
        let (last, all) = (first == 0, self.frames() * batch);
        let (input, d_input) = match number {
            0 => (self.input.address(), self.at(&self.d_input, first, matrix.rows)),
            _ => {
                let gradient = &self.layers[number - 1].gradient;
                (self.outputs(number - 1), self.at(gradient, first, wide))
            }
        };
        self.learn(last, matrix, input, all_slopes, all)?;
        self.backward_product(matrix, slopes, d_input, rows, false)?;
        self.change(last, matrix)?;
        if let Some(recurrent) = recurrent {
            let slopes =
                layer.recurrent.as_ref().map_or(layer.sums.address(), |buffer| buffer.address());
            self.learn(last, recurrent, layer.states.address(), slopes, all)?;
            self.change(last, recurrent)?;
        }
        Ok(())
    }

    /// The gradient by a matrix, in the side queue, once all slopes are there.
    fn learn(
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
    fn learn_points(&self, rows: usize) -> Result<()> {
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

    /// The gradient by a matrix averaged over the devices, its norms, and what shortens it.
    fn measure(&self, matrix: &Matrix) -> Result<()> {
        let gradient = self.gradients.address().plus(matrix.first);
        // SAFETY: the matrix lies within the gradients.
        unsafe { self.device.average(Queue::Side, gradient, matrix.size()) }?;
        let tensors = matrix.tensors();
        let squares = self.tensor_squares.address().plus(matrix.tensor * CHUNKS);
        self.launch_in(
            Queue::Side,
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
            Queue::Side,
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

    /// Adam for a matrix, in the side queue, once nothing needs the old weights any more.
    fn change(&self, last: bool, matrix: &Matrix) -> Result<()> {
        if !last {
            return Ok(());
        }
        self.device.wait(Queue::Side, Queue::Main)?;
        let at = |buffer: &Buffer| buffer.address().plus(matrix.first);
        let average = self.average.as_ref().map_or(Address::NULL, at);
        let quads = matrix.size() / 4;
        self.launch_in(
            Queue::Side,
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

impl Drop for Training {
    /// Waits for all work, before memory that it uses is given back, and before the device leaves its group, which recorded
    /// steps know.
    fn drop(&mut self) {
        if let Err(reason) = self.device.finish() {
            tracing::debug!("a GPU was lost: {reason}");
        }
        self.recording = None;
    }
}
