//! The kernels' text, their arguments, and the constants they are compiled for.

use eddy_frames::Material;
use eddy_inference::{
    checkpoint::{
        Activation, Core, Description, FeatureScaling, Form, FrameOutput, MaterialInput, Pooling,
    },
    engine::Ballistic,
    ops::{
        cell,
        decoder::{self, Decoded},
        features, linear, node_inputs, transfer,
    },
};

use crate::error::{CudaError, Result};

pub(crate) use generated::*;

use frame::{encoder::Scaling, motion::Motion};

/// The arguments of every kernel of this crate, and the structs and whole numbers that they are made of: `build.rs` has read them
/// from the `.cu` files. The arguments of `frame/loss.cu` are those in `kernels::frame::loss`. The kernels of rules, which
/// `eddy-inference` has, all have the arguments of `elastic`.
#[expect(unsafe_code, reason = "structs that the device reads")]
mod generated {
    #![allow(dead_code, reason = "the kernels read what the host does not")]
    #![allow(unused_parens, unused_qualifications, clippy::all, reason = "generated")]
    include!(concat!(env!("OUT_DIR"), "/kernels.rs"));
}

/// All kernels of the frame model, in parts.
const SOURCE: &[&str] = &[
    include_str!("base.cu"),
    include_str!("common.cu"),
    include_str!("training/observed.cu"),
    include_str!("frame/windows.cu"),
    include_str!("frame/motion.cu"),
    include_str!("frame/encoder.cu"),
    cell::DEVICE,
    include_str!("frame/cells.cu"),
    include_str!("frame/loss.cu"),
    include_str!("training/batch_loss.cu"),
    include_str!("training/adam.cu"),
    include_str!("frame/inference.cu"),
    include_str!("frame/maximum.cu"),
];

/// The kernels of the particle model but for those of its rules, in parts.
pub(crate) const PARTICLE_SOURCE: &[&str] = &[
    include_str!("base.cu"),
    include_str!("common.cu"),
    cell::DEVICE,
    include_str!("particle/nodes.cu"),
    transfer::DEVICE,
    linear::DEVICE,
    decoder::DEVICE,
    features::DEVICE,
    node_inputs::DEVICE,
    include_str!("particle/products.cu"),
    include_str!("particle/node_layers.cu"),
    include_str!("particle/layers.cu"),
];

/// What its training needs beside them.
pub(crate) const PARTICLE_TRAINING_SOURCE: &[&str] = &[
    include_str!("training/observed.cu"),
    include_str!("training/batch_loss.cu"),
    include_str!("training/adam.cu"),
    include_str!("training/muon.cu"),
    include_str!("training/knots.cu"),
    include_str!("particle/training/plan.cu"),
    include_str!("particle/training/grid.cu"),
    include_str!("particle/training/node_layers.cu"),
    include_str!("particle/training/weights.cu"),
    include_str!("particle/training/particles.cu"),
    include_str!("particle/training/gradients.cu"),
];

/// A text of kernels and the constants it is compiled for.
pub trait Program {
    /// The text.
    fn source(&self) -> String;

    /// Names and values for the compiler.
    fn definitions(&self) -> Vec<(&'static str, usize)>;

    /// The text, which is not compiled unless the structs in it have the sizes that they have in Rust.
    fn checked_source(&self) -> String {
        let mut source = self.source();
        for (name, size) in LAYOUTS {
            if source.contains(&format!(" {name} {{")) {
                source +=
                    &format!("static_assert(sizeof({name}) == {size}, \"{name} in Rust\");\n");
            }
        }
        source
    }

    /// The names of the kernels in the text.
    fn kernels(&self) -> Vec<String> {
        let source = self.source();
        source.split("extern \"C\" __global__ void ").skip(1).map(name_of).collect()
    }
}

/// The name in the declaration of a kernel, behind `void`.
fn name_of(declared: &str) -> String {
    let bounded = declared.strip_prefix("__launch_bounds__(");
    let name = bounded.map_or(Some(declared), |rest| Some(rest.split_once(") ")?.1));
    let name = name.and_then(|rest| Some(rest.split_once('(')?.0));
    name.unwrap_or_else(|| panic!("a kernel without a name: {declared:.80}")).to_owned()
}

/// Materials that the kernels know.
pub const MATERIALS: usize = Material::COUNT;
/// Axes of space.
pub const AXES: usize = 2;

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
    /// Materials that the network has inputs for.
    pub material_inputs: usize,
}

impl Constants {
    /// Of a described frame model.
    ///
    /// # Errors
    /// [`CudaError::Unsupported`] for the particle model, and for inputs for materials that the kernels do not know.
    pub fn of(description: &Description) -> Result<Self> {
        let Some(particles) = description.sizes.particles else {
            let setting = "architecture particle".to_owned();
            return Err(CudaError::Unsupported { setting, expected: "architecture frame" });
        };
        if description.material_inputs > MATERIALS {
            let setting = format!("material_inputs = {}", description.material_inputs);
            return Err(CudaError::Unsupported {
                setting,
                expected: "at most 5 for the frame model",
            });
        }
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
            material_inputs: description.material_inputs,
        })
    }

    /// Numbers of a particle beside its material, and one for each material that the network has inputs for.
    pub fn encoder_inputs(&self) -> usize {
        2 * AXES + self.material_inputs
    }

    /// Sums over the particles of a window for each unit of the encoder: slopes for each of these, and values.
    pub fn encoder_sums(&self) -> usize {
        self.encoder_inputs() + 1
    }

    /// Rows of the encoder's first matrix without the bias.
    pub fn inputs(&self) -> usize {
        2 * AXES + if self.one_hot { self.material_inputs } else { 1 }
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
            ("MATERIAL_INPUTS", self.material_inputs),
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
pub(crate) fn scaling(description: &Description) -> Scaling {
    let scale = &description.normalization;
    match description.frame.scaling {
        FeatureScaling::MinMax => Scaling {
            least: scale.minimum,
            inverse_range: std::array::from_fn(|k| 1.0 / (scale.maximum[k] - scale.minimum[k])),
        },
        FeatureScaling::ZScore => Scaling {
            least: scale.mean,
            inverse_range: scale.standard_deviation.map(|deviation| 1.0 / deviation),
        },
    }
}

/// The step from the decoder's output to the next frame.
pub(crate) fn motion(description: &Description) -> Motion {
    let Decoded { ballistic, mean, deviation, .. } = Decoded::new(description);
    let Ballistic { gravity, dt, lower, upper } = ballistic;
    Motion { dt: [dt; AXES], fall: gravity.map(|g| g * dt), lower, upper, mean, deviation }
}
