//! The networks over tensors, operation by operation. This is their definition: all that computes them is tested against it. It
//! runs on every device of burn, and trains where [`recorded`](super::recorded) does not.

use burn::tensor::{Device, Gradients, Tensor, TensorData, activation::relu};

use super::{
    ballistic::BallisticTensors,
    core::{self, activate},
    described::{Inputs, Model, Outputs},
    features::Scaling,
    grid_context::GridContext,
    linear::Linear,
    sparse,
    state::{StaticInputs, pairs},
    strain,
};
use eddy_inference::checkpoint::{
    Architecture, FrameOutput,
    plan::{EXPECTED, Kind, Operation, POSITION, VELOCITY},
};

/// The weights and constants of a network as tensors.
#[derive(Clone, Debug)]
pub(crate) struct Definition {
    layers: Vec<Linear>,
    scaling: Scaling,
    ballistic: BallisticTensors,
}

impl Definition {
    /// With these weights, in the order of the plan's layers.
    pub(crate) fn new(model: &Model, weights: &[Vec<f32>], device: &Device) -> Self {
        let layers = model.plan.layers.iter().zip(weights.as_chunks().0);
        Self {
            layers: layers.map(|(layer, weights)| Linear::new(layer, weights, device)).collect(),
            scaling: Scaling::new(&model.description.normalization, device),
            ballistic: BallisticTensors::new(model.ballistic, device),
        }
    }

    /// The gradients by the weights, in their order; empty if the loss does not depend on them.
    pub(crate) fn gradients(&self, gradients: &mut Gradients) -> Vec<Vec<f32>> {
        self.layers.iter().flat_map(|layer| layer.gradients(gradients)).collect()
    }

    /// All operations.
    pub(crate) fn run(&self, model: &Model, inputs: Inputs) -> Outputs {
        let Inputs { frames, position, velocity, expected, states, fixed, masks } = inputs;
        let mut pass = self.pass(model, frames, &fixed, &masks, states);
        pass.grid = model.grid(&pairs(position.clone()), &fixed, frames);
        for (list, tensor) in [(POSITION, position), (VELOCITY, velocity), (EXPECTED, expected)] {
            pass.lists[list] = Some(tensor);
        }
        model.plan.operations.iter().for_each(|operation| pass.run(operation));
        let next = pass.list(model.plan.next());
        let expected = model.plan.expected_next().map(|list| pass.list(list));
        Outputs { next, expected, states: Tensor::cat(pass.after, 0) }
    }

    /// The core alone, from a zero state: `[T, R, I]` to `[T, R, H]`.
    pub(crate) fn core(&self, model: &Model, input: Tensor<3>) -> Tensor<3> {
        let [frames, rows, width] = input.dims();
        let [layers, columns] = model.state_shape(rows);
        let before = Tensor::zeros([layers, columns], &input.device());
        let fixed = StaticInputs::new(&[], &[], 1, None, None);
        let mut pass = self.pass(model, frames, &fixed, &[], before);
        let &[list] = model.plan.core_inputs() else { panic!("a core that reads one list") };
        pass.lists[list] = Some(input.reshape([frames * rows, width]));
        model.plan.operations[model.plan.core.clone()].iter().for_each(|one| pass.run(one));
        let output = pass.list(model.plan.core_output());
        output.reshape([frames, rows, model.description.sizes.hidden])
    }

    /// A pass before its first operation, without lists that are given and without nodes.
    fn pass<'a>(
        &'a self,
        model: &'a Model,
        frames: usize,
        fixed: &'a StaticInputs,
        masks: &'a [Vec<f32>],
        before: Tensor<2>,
    ) -> Pass<'a> {
        let lists = vec![None; model.plan.lists.len()];
        let definition = self;
        Pass {
            definition,
            model,
            frames,
            fixed,
            masks,
            grid: None,
            lists,
            before,
            after: Vec::new(),
        }
    }
}

/// Some frames on their way through the operations.
struct Pass<'a> {
    definition: &'a Definition,
    model: &'a Model,
    /// T.
    frames: usize,
    fixed: &'a StaticInputs,
    /// Factors of dropout of each layer of the core, `[T R, H]`, if there is dropout.
    masks: &'a [Vec<f32>],
    /// The nodes around the particles of all frames, of a particle model.
    grid: Option<GridContext>,
    /// The plan's lists of all frames, `[T .., width]`.
    lists: Vec<Option<Tensor<2>>>,
    /// The states of the core before the first frame, `[L R, S H]`.
    before: Tensor<2>,
    /// Those after the last frame, `[R, S H]` of each layer.
    after: Vec<Tensor<2>>,
}

impl Pass<'_> {
    fn list(&self, list: usize) -> Tensor<2> {
        self.lists[list].clone().expect("operations read lists that were written before")
    }

    fn grid(&self) -> &GridContext {
        self.grid.as_ref().expect("networks with operations on nodes have a grid")
    }

    fn run(&mut self, Operation { kind, reads, writes }: &Operation) {
        let mut read: Vec<_> = reads.iter().map(|&list| self.list(list)).collect();
        let Self { definition: Definition { layers, ballistic, .. }, .. } = *self;
        let particles = self.fixed.particles();
        let output = match kind {
            Kind::Expect => ballistic.step(read[0].clone(), read[1].clone()).velocity,
            Kind::ParticleFeatures => self.particle_features(tensors(read)),
            Kind::FrameFeatures => self.frame_features(tensors(read)),
            Kind::Linear { layer, activation } => {
                let sum = layers[*layer].forward(Tensor::cat(read, 1));
                activation.iter().fold(sum, |sum, &activation| activate(activation, sum))
            }
            Kind::MeanOfLinear { layer, activation } => {
                let points = activate(*activation, layers[*layer].forward(read.remove(0)));
                by_window(points, particles).mean_dim(1).squeeze_dim::<2>(1)
            }
            Kind::Max => by_window(read.remove(0), particles).max_dim(1).squeeze_dim::<2>(1),
            Kind::ToNodes => sparse::write(self.grid(), tensors(read)),
            Kind::ToParticles => sparse::read(self.grid(), tensors(read)),
            Kind::Convolution { layer, grid } => {
                let rows = read.remove(0);
                let sum = sparse::convolution(self.grid(), grid, rows, &layers[*layer]);
                let sum = read.into_iter().fold(sum, |sum, skip| skip + sum);
                if grid.rectified { relu(sum) } else { sum }
            }
            Kind::Cell { number, recurrent } => {
                let recurrent = recurrent.map(|layer| &layers[layer]);
                self.cell(*number, read, recurrent)
            }
            Kind::Advance => Tensor::cat(self.advance(tensors(read)).into(), 1),
        };
        self.lists[*writes] = Some(output);
    }

    fn particle_features(&self, [position, velocity, first, coming]: [Tensor<2>; 4]) -> Tensor<2> {
        let Definition { scaling, ballistic, .. } = self.definition;
        // Each frame's velocities are compared with those expected one frame earlier.
        let [rows, _] = first.dims();
        let expected = match self.frames {
            1 => first,
            frames => Tensor::cat(vec![first, coming.slice([0..(frames - 1) * rows, 0..2])], 0),
        };
        let shape = strain::shape(&position, &self.fixed.rest);
        let constants = self.constants(&position.device());
        scaling.particle([position, velocity, expected], ballistic, shape, constants)
    }

    fn frame_features(&self, [position, velocity]: [Tensor<2>; 2]) -> Tensor<2> {
        let constants = self.constants(&position.device());
        let options = &self.model.description.frame;
        self.definition.scaling.frame(options, [position, velocity], constants)
    }

    /// Features that do not change: materials, one-hot, then the stiffness, if the network is conditioned on it, `[T R, M]` or
    /// `[T R, M + 1]`.
    fn constants(&self, device: &Device) -> Tensor<2> {
        let StaticInputs { material, stiffness, .. } = self.fixed;
        let particles = self.fixed.particles();
        let row = |(row, &material): (usize, &u8)| {
            let kinds = 0..self.model.description.material_inputs;
            let one_hot = kinds.map(move |kind| f32::from(u8::from(kind == usize::from(material))));
            one_hot.chain(stiffness.iter().map(move |all| all[row / particles]))
        };
        let numbers: Vec<f32> = material.iter().enumerate().flat_map(row).collect();
        let width = numbers.len() / material.len();
        let frame =
            Tensor::<2>::from_data(TensorData::new(numbers, [material.len(), width]), device);
        frame.repeat(&[self.frames, 1])
    }

    fn cell(
        &mut self,
        number: usize,
        sums: Vec<Tensor<2>>,
        recurrent: Option<&Linear>,
    ) -> Tensor<2> {
        let frames = self.frames;
        let rows = sums[0].dims()[0] / frames;
        let cube = |sums: Tensor<2>| {
            let [_, width] = sums.dims();
            sums.reshape([frames, rows, width])
        };
        let [_, columns] = self.before.dims();
        let state = self.before.clone().slice([number * rows..(number + 1) * rows, 0..columns]);
        let sums = sums.into_iter().map(cube).collect();
        let (output, after) = core::cell(self.model.cell, sums, recurrent, state);
        self.after.push(after);
        let output: Tensor<2> = output.flatten(0, 1);
        let Some(mask) = self.masks.get(number) else { return output };
        let mask = TensorData::new(mask.clone(), output.dims());
        let device = output.device();
        output * Tensor::from_data(mask, &device)
    }

    /// Positions and velocities of the next frames, `[T R, 2]`, from the decoder's output, `[T R, 4]` or `[T B, 2 N]`.
    fn advance(&self, [position, velocity, output]: [Tensor<2>; 3]) -> [Tensor<2>; 2] {
        let Definition { scaling, ballistic, .. } = self.definition;
        let Model { description, step, .. } = self.model;
        let ([rows, _], dt) = (position.dims(), description.dt);
        if description.architecture == Architecture::Frame {
            let output: Tensor<2> = output.reshape([rows, 2]);
            return match description.frame.output {
                FrameOutput::Displacement => {
                    let velocity = velocity + output;
                    [position + velocity.clone().mul_scalar(dt), velocity]
                }
                FrameOutput::Residual => {
                    let motion = ballistic.step(position, velocity);
                    let farther = output.clone().mul_scalar(0.5 * dt);
                    [motion.position + farther, motion.velocity + output]
                }
                FrameOutput::Position => {
                    let next = scaling.position(output);
                    [next.clone(), (next - position).div_scalar(dt)]
                }
            };
        }
        let motion = ballistic.step(position, velocity);
        let output = output.mul_scalar(step.velocity_unit);
        let [faster, farther] = [0, 2].map(|k| output.clone().slice([0..rows, k..k + 2]));
        let device = output.device();
        let [slowest, fastest] = [step.slowest, step.fastest]
            .map(|limit| Tensor::<1>::from_floats(limit, &device).unsqueeze::<2>());
        let between =
            |x: Tensor<2>, low: Tensor<2>, high: Tensor<2>| x.max_pair(low).min_pair(high);
        let BallisticTensors { lower, upper, .. } = ballistic.clone();
        [
            between(motion.position + farther.mul_scalar(dt), lower, upper),
            between(motion.velocity + faster, slowest, fastest),
        ]
    }
}

/// As many tensors as an operation reads.
fn tensors<const N: usize>(read: Vec<Tensor<2>>) -> [Tensor<2>; N] {
    read.try_into().expect("`Kind` says how many lists an operation reads")
}

/// `[B N, W]` as `[B, N, W]`.
fn by_window(points: Tensor<2>, particles: usize) -> Tensor<3> {
    let [rows, width] = points.dims();
    points.reshape([rows / particles, particles, width])
}
