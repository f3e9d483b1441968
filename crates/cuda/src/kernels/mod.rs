//! The kernels' text, their names, and the constants they are compiled for.

use eddy_inference::{
    checkpoint::{
        Activation, Core, Description, FeatureScaling, Form, FrameOutput, MaterialInput, Pooling,
    },
    engine::Decoded,
    ops::cell,
};

use crate::error::{CudaError, Result};

/// All kernels of the frame model, in parts.
const SOURCE: &[&str] = &[
    include_str!("base.cu"),
    include_str!("common.cu"),
    include_str!("observed.cu"),
    include_str!("windows.cu"),
    include_str!("motion.cu"),
    include_str!("encoder.cu"),
    cell::DEVICE,
    include_str!("cells.cu"),
    include_str!("frame_loss.cu"),
    include_str!("batch_loss.cu"),
    include_str!("adam.cu"),
    include_str!("inference.cu"),
    include_str!("maximum.cu"),
];

/// The kernels of the particle model, in parts.
pub(crate) const PARTICLE_SOURCE: &[&str] = &[
    include_str!("base.cu"),
    include_str!("common.cu"),
    cell::DEVICE,
    include_str!("particle_nodes.cu"),
    include_str!("particle_layers.cu"),
    include_str!("particle_rules.cu"),
    include_str!("particle_elastic.cu"),
];

/// What its training needs beside them.
pub(crate) const PARTICLE_TRAINING_SOURCE: &[&str] = &[
    include_str!("observed.cu"),
    include_str!("batch_loss.cu"),
    include_str!("adam.cu"),
    include_str!("particle_training/muon.cu"),
    include_str!("particle_training/knots.cu"),
    include_str!("particle_training/products.cu"),
    include_str!("particle_training/plan.cu"),
    include_str!("particle_training/cells.cu"),
    include_str!("particle_training/layers.cu"),
    include_str!("particle_training/particles.cu"),
    include_str!("particle_training/gradients.cu"),
];

/// A text of kernels and the constants it is compiled for.
pub trait Program {
    /// The text.
    fn source(&self) -> String;

    /// Names and values for the compiler.
    fn definitions(&self) -> Vec<(&'static str, usize)>;

    /// The kernels in the text.
    fn kernels(&self) -> Vec<Kernel> {
        let source = self.source();
        let defined = |kernel: &Kernel| source.contains(&format!(" {}(", kernel.name()));
        Kernel::ALL.iter().copied().filter(defined).collect()
    }
}

/// Materials that the kernels know, `Material::COUNT` of eddy-frames.
pub const MATERIALS: usize = 4;
/// Axes of space.
pub const AXES: usize = 2;

macro_rules! kernels {
    ($($(#[$doc:meta])* $variant:ident = $name:literal),* $(,)?) => {
        /// A kernel by its name in the text.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
        pub enum Kernel { $($(#[$doc])* $variant),* }

        impl Kernel {
            /// Every kernel.
            pub const ALL: &[Self] = &[$(Self::$variant),*];

            /// Its name in the text.
            pub fn name(self) -> &'static str {
                match self { $(Self::$variant => $name),* }
            }
        }
    };
}

kernels! {
    /// Windows of a later step out of the memory of the host.
    Fetch = "fetch",
    /// Observed frames out of the trajectories.
    Observe = "observe",
    /// Noise on the last of them.
    Disturb = "disturb",
    /// Pointwise encoder with the sums for its gradient.
    Encode = "encode",
    /// The same on tensor cores.
    EncodeTensor = "encode_tensor",
    /// Means over the particles.
    Pool = "pool",
    /// Gradient of the encoder's weights.
    EncoderGradient = "encoder_gradient",
    /// Gradient of the encoder's input.
    EncoderPointsGradient = "encoder_points_gradient",
    /// A layer of the core over frames, or over one if it has recurrent weights.
    CellsForward = "cells_forward",
    /// Its gradient.
    CellsBackward = "cells_backward",
    /// The activation in place.
    ActivationForward = "activation_forward",
    /// Its gradient.
    ActivationBackward = "activation_backward",
    /// Zeros in the padding of gradients.
    ClearPadding = "clear_padding",
    /// Dropout, both ways.
    Dropout = "dropout",
    /// Predicted frames and their squared errors.
    Advance = "advance",
    /// The loss of a batch.
    Loss = "loss",
    /// Gradient by the decoder's output.
    LossGradient = "loss_gradient",
    /// Density maps and their gradient.
    Density = "density",
    /// Sums of squares of gradients.
    SquaresOfGradient = "squares_of_gradient",
    /// What shortens gradients.
    Clip = "clip",
    /// Adam.
    Adam = "adam",
    /// Muon: the momentum, and its product with its transpose.
    MuonGram = "muon_gram",
    /// The polynomial of that product.
    MuonPolynomial = "muon_polynomial",
    /// The change of the weights.
    Muon = "muon",
    /// Weights between those for several stiffnesses.
    MixWeights = "mix_weights",
    /// What shortens the gradients by these.
    ShareScales = "share_scales",
    /// The end of a step.
    Finish = "finish",
    /// A batch of streams, from the memory of the host.
    LoadStreams = "load_streams",
    /// Pointwise encoder of streams.
    EncodeStreams = "encode_streams",
    /// Means over their particles.
    PoolStreams = "pool_streams",
    /// A product of one row with a matrix.
    ProductOfRow = "product_of_row",
    /// A product of few rows with a matrix.
    ProductOfRows = "product_of_rows",
    /// A linear layer's outputs.
    LinearStreams = "linear_streams",
    /// A frame of a layer of the core.
    CellsStreams = "cells_streams",
    /// Predicted frames, to the memory of the host.
    PredictStreams = "predict_streams",
    /// Activations of the first Linear, for a pooling by the maximum.
    EncodePoints = "encode_points",
    /// The same of streams.
    EncodePointsOfStreams = "encode_points_of_streams",
    /// The largest outputs of the second Linear over the particles.
    Largest = "largest",
    /// Gradient of the means beside the maxima.
    MeanPart = "mean_part",
    /// Gradients of both Linears through the maxima.
    MaximumGradient = "maximum_gradient",
    /// Their sums over the units of the second one.
    MaximumSum = "maximum_sum",
    /// Gradients by the particles that have the maxima.
    MaximumSlopes = "maximum_slopes",
    /// Their sums for each particle.
    MaximumPointsGradient = "maximum_points_gradient",
    /// Dense layers: the activation in place.
    DenseForward = "dense_forward",
    /// Its gradient.
    DenseBackward = "dense_backward",
    /// Squared errors and their gradient.
    DenseError = "dense_error",
    /// Adam over one matrix.
    DenseAdam = "dense_adam",
    /// Particle model: frames from the memory of the host, and the particles of each cell.
    ParticleLoad = "particle_load",
    /// Sums of parts of maps.
    ParticleChunks = "particle_chunks",
    /// Slots of cells, numbers of nodes.
    ParticleScan = "particle_scan",
    /// Particles by cells.
    ParticleScatter = "particle_scatter",
    /// The same, in the order of their number.
    ParticleRank = "particle_rank",
    /// Features and encoder.
    ParticleEncode = "particle_encode",
    /// Sums of particles on nodes.
    ParticleToNodes = "particle_to_nodes",
    /// A layer on nodes.
    ParticleGridLayer = "particle_grid_layer",
    /// Gather from nodes, core, decoder.
    ParticleDecode = "particle_decode",
    /// Area rule: the fill of nodes.
    ParticleAreaFill = "particle_area_fill",
    /// The pressure, within shared memory.
    ParticleAreaSolve = "particle_area_solve",
    /// The excess of nodes.
    ParticleAreaMark = "particle_area_mark",
    /// Half a sweep of the pressure.
    ParticleAreaSweep = "particle_area_sweep",
    /// Liquid moves.
    ParticleAreaShift = "particle_area_shift",
    /// Shape rule: limited deformations.
    ParticleShapeLimit = "particle_shape_limit",
    /// A sweep of the positions.
    ParticleShapeRelax = "particle_shape_relax",
    /// Bodies: nodes that are connected.
    ParticleBodiesJoin = "particle_bodies_join",
    /// Places for their sums.
    ParticleBodiesNumber = "particle_bodies_number",
    /// Sums over their particles.
    ParticleBodiesSum = "particle_bodies_sum",
    /// Flight rule.
    ParticleBodiesFlight = "particle_bodies_flight",
    /// Rest rule.
    ParticleBodiesRest = "particle_bodies_rest",
    /// The motion of bodies of jelly.
    ParticleElastic = "particle_elastic",
    /// Predictions, to the memory of the host.
    ParticleStore = "particle_store",
    /// Training of the particle model: observed frames out of the trajectories, with noise.
    TrainObserve = "train_observe",
    /// Cells and nodes.
    TrainCells = "train_cells",
    /// Features and encoder.
    TrainEncode = "train_encode",
    /// Sums of particles on nodes.
    TrainToNodes = "train_to_nodes",
    /// A layer on nodes, in either direction.
    TrainLayer = "train_layer",
    /// Gather from nodes, core, decoder.
    TrainDecode = "train_decode",
    /// Predicted frames and their squared errors.
    TrainAdvance = "train_advance",
    /// Transposed matrices for the forward pass.
    TrainTranspose = "train_transpose",
    /// Gradient by the decoder's output.
    TrainOutputGradient = "train_output_gradient",
    /// Through decoder and core.
    TrainDecodeGradient = "train_decode_gradient",
    /// By the nodes that particles gather from.
    TrainGatherGradient = "train_gather_gradient",
    /// By the sums of particles on nodes.
    TrainMeansGradient = "train_means_gradient",
    /// Through encoder and features.
    TrainEncodeGradient = "train_encode_gradient",
    /// Through strain and bend.
    TrainShapeGradient = "train_shape_gradient",
    /// Gradient by a matrix, for each window.
    TrainOuter = "train_outer",
    /// Windows whose gradient is not finite.
    TrainFinite = "train_finite",
    /// Gradients by all weights.
    TrainSum = "train_sum",
    /// Solver: particles from the memory of the host.
    SolverLoad = "solver_load",
    /// The same way back.
    SolverStore = "solver_store",
    /// Particles of each cell.
    SolverCount = "solver_count",
    /// Places for the particles of each tile.
    SolverTiles = "solver_tiles",
    /// Tiles whose nodes particles touch.
    SolverTouch = "solver_touch",
    /// Particles by tiles.
    SolverMove = "solver_move",
    /// Gather, motion, law and scatter of particles.
    SolverParticles = "solver_particles",
    /// Velocities of the nodes.
    SolverNodes = "solver_nodes",
}

/// Rounds up to a multiple.
pub(crate) fn round_up(number: usize, multiple: usize) -> usize {
    number.div_ceil(multiple) * multiple
}

/// What the kernels are compiled for: the widths and choices of a frame model.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Constants {
    /// N.
    pub particles: usize,
    /// Whether materials enter as one number each.
    pub one_hot: bool,
    /// E.
    pub encoder: usize,
    /// H.
    pub hidden: usize,
    /// The core.
    pub core: Core,
    /// Of the encoder, the MLP core and the mixer.
    pub activation: Activation,
    /// How the particles are pooled.
    pub pooling: Pooling,
    /// What the decoder predicts.
    pub output: FrameOutput,
    /// Form of the minimal recurrences.
    pub form: Form,
    /// Whether minLSTM's gates are divided by their sum.
    pub normalized: bool,
}

impl Constants {
    /// Of a described frame model.
    ///
    /// # Errors
    /// [`CudaError::Unsupported`] for the particle model.
    pub fn of(description: &Description) -> Result<Self> {
        let Some(particles) = description.sizes.particles else {
            let setting = "architecture particle".to_owned();
            return Err(CudaError::Unsupported { setting, expected: "architecture frame" });
        };
        Ok(Self {
            particles,
            one_hot: description.frame.material == MaterialInput::OneHot,
            encoder: description.sizes.encoder,
            hidden: description.sizes.hidden,
            core: description.core,
            activation: description.frame.activation,
            pooling: description.frame.pooling,
            output: description.frame.output,
            form: description.form,
            normalized: description.normalize_gates,
        })
    }

    /// Rows of the encoder's first matrix without the bias.
    pub fn inputs(&self) -> usize {
        2 * AXES + if self.one_hot { MATERIALS } else { 1 }
    }

    /// E rounded up: columns of the encoder's first matrix.
    pub fn encoder_columns(&self) -> usize {
        round_up(self.encoder, 4)
    }

    /// E with the ones, rounded up.
    pub fn pooled_columns(&self) -> usize {
        round_up(self.encoder + 1, 8)
    }

    /// H with the ones, rounded up.
    pub fn hidden_columns(&self) -> usize {
        round_up(self.hidden + 1, 8)
    }

    /// Whether particles are pooled by their mean.
    pub fn mean(&self) -> bool {
        self.pooling != Pooling::Max
    }

    /// Whether particles are pooled by their maximum.
    pub fn maximum(&self) -> bool {
        self.pooling != Pooling::Mean
    }

    /// Inputs of the core without the ones.
    pub fn core_inputs(&self) -> usize {
        self.hidden * (usize::from(self.mean()) + usize::from(self.maximum()))
    }

    /// Those with the ones, rounded up.
    pub fn input_columns(&self) -> usize {
        round_up(self.core_inputs() + 1, 8)
    }

    /// Columns of the decoder.
    pub fn output_columns(&self) -> usize {
        round_up(AXES * self.particles, 8)
    }
}

impl Program for Constants {
    fn source(&self) -> String {
        SOURCE.concat()
    }

    fn definitions(&self) -> Vec<(&'static str, usize)> {
        let activation = Activation::ALL.iter().position(|&kind| kind == self.activation);
        let output = FrameOutput::ALL.iter().position(|&kind| kind == self.output);
        let own = [
            ("DIM", AXES),
            ("MATERIALS", MATERIALS),
            ("N", self.particles),
            ("ONE_HOT", usize::from(self.one_hot)),
            ("E", self.encoder),
            ("EL", self.encoder_columns()),
            ("EP", self.pooled_columns()),
            ("H", self.hidden),
            ("HP", self.hidden_columns()),
            ("MEAN", self.mean().into()),
            ("MAXIMUM", self.maximum().into()),
            ("IP", self.input_columns()),
            ("OP", self.output_columns()),
            ("ACTIVATION", activation.unwrap_or_default()),
            ("OUTPUT", output.unwrap_or_default()),
            ("LOG_FORM", usize::from(self.form == Form::Log)),
            ("NORMALIZED", usize::from(self.normalized)),
        ];
        own.into_iter().chain(self.core.definitions()).collect()
    }
}

/// What features are divided by: `x' = (x - least) inverse_range`, x, y, vx, vy.
pub(crate) fn scaling(description: &Description) -> [[f32; 4]; 2] {
    let scale = &description.normalization;
    match description.frame.scaling {
        FeatureScaling::MinMax => {
            [scale.minimum, std::array::from_fn(|k| 1.0 / (scale.maximum[k] - scale.minimum[k]))]
        }
        FeatureScaling::ZScore => [scale.mean, scale.standard_deviation.map(|d| 1.0 / d)],
    }
}

/// `struct Motion` of the kernels.
pub(crate) fn motion(description: &Description) -> [[f32; AXES]; 6] {
    let Decoded { ballistic, mean, deviation, .. } = Decoded::new(description);
    let fall = ballistic.gravity.map(|gravity| gravity * ballistic.dt);
    [[ballistic.dt; AXES], fall, ballistic.lower, ballistic.upper, mean, deviation]
}
