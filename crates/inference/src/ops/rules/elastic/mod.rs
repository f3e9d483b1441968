//! A body of jelly that nothing else is close to moves by its elasticity, gravity and the walls ([`lattice`]), whatever
//! was predicted: its positions and velocities tell that motion far better than a network learns it. A lattice whose nodes did not come where it
//! expected them leaves its body as predicted. Later rules apply to the result. Walls have turned its velocity within the frame; it is not
//! stopped there as in a ballistic step.

mod constants;

use std::ops::Range;

use super::{
    Ballistic, InFrame, Launch, Most, Network, Observed, Predicted, RuleOperation, WrongConstant,
    bodies::Bodies,
};
use crate::{
    checkpoint::Description,
    kernels::{
        lattice::{self, Elasticity, Expected, Lattices, Walls},
        rest_shape::RestShape,
    },
};
pub use constants::{ElasticRule, JELLY_MODULUS};
use eddy_frames::Material;
use eddy_threads::DisjointSlice;

/// Threads of a block on a GPU, which moves a body.
pub(super) const THREADS: usize = 512;

/// The lattices of jelly among particles at `position` (domain lengths), with the rows `rows` of a rest shape, in a stream of this
/// stiffness (density x velocity^2), if the network is conditioned on it; empty if the rule `elastic` is off.
pub fn lattices(
    description: &Description,
    (rest, rows): (&RestShape, Range<usize>),
    position: &[[f32; 2]],
    material: &[Material],
    stiffness: Option<f32>,
) -> Lattices {
    let (Some(mut rule), Some(grid)) = (description.rules.elastic, &description.grid) else {
        return Lattices::default();
    };
    let spacing = grid.spacing;
    if let Some(stiffness) = stiffness {
        rule = rule.with_modulus(rule.modulus * stiffness, spacing, description.dt);
    }
    let elasticity = elasticity(&rule, &Ballistic::new(description), spacing);
    Lattices::new((rest, rows), position, material, spacing, (rule.cell_width, elasticity))
}

/// The law for frames with this ballistic step, with particles at this distance (domain lengths).
fn elasticity(rule: &ElasticRule, ballistic: &Ballistic, spacing: f32) -> Elasticity {
    // 1 / the time that a pressure wave takes to cross it.
    let rate = rule.wave_speed() / (ElasticRule::SURFACE_WIDTH * spacing);
    Elasticity {
        lame: rule.lame(),
        viscosity: rule.viscosity,
        wall_distance: rule.wall_distance * spacing,
        wall_stiffness: rule.wall_stiffness * rate * rate,
        rebound: rule.rebound,
        clear_distance: rule.clear_distance * spacing,
        most_stretch: rule.most_stretch,
        most_error: rule.most_error.unwrap_or(f32::INFINITY),
        small_error: rule.small_error * spacing,
        steps: rule.steps,
        dt: ballistic.dt,
        gravity: ballistic.gravity,
    }
}

impl RuleOperation for ElasticRule {
    /// The modulus is that of the jelly in the data.
    const STANDARD: Option<Self> = None;
    /// `elastic.cu` of `eddy-cuda`, beside the tables of lattices that it reads.
    const DEVICE: &'static str = "";

    /// Of each body.
    type Scratch = Vec<lattice::Scratch>;
    type InFrame<'a> = Elastic<'a>;

    fn check(&self, network: &Network) -> Result<(), WrongConstant> {
        self.check_constants(network)
    }

    fn steps(&self) -> usize {
        1
    }

    fn begin<'a>(&self, scratch: &'a mut Self::Scratch, observed: &Observed<'a>) -> Elastic<'a> {
        let bodies = observed.lattices.bodies().len();
        scratch.resize_with(bodies.max(scratch.len()), Default::default);
        Elastic { scratch: DisjointSlice::new(scratch) }
    }

    /// They are those of each lattice.
    fn device_constants(&self, _: &Network) -> Vec<(&'static str, f32)> {
        Vec::new()
    }

    fn launches(&self, most: &Most) -> Vec<Launch> {
        let threads = most.lattices * THREADS;
        vec![Launch { block: THREADS, ..Launch::new("elastic", threads) }]
    }
}

/// Where the lattices of a stream expect their nodes.
#[derive(Clone, Copy)]
pub(crate) struct ExpectedNodes<'a> {
    positions: DisjointSlice<'a, [f32; 2]>,
    most_errors: DisjointSlice<'a, f32>,
}

impl<'a> ExpectedNodes<'a> {
    pub(crate) fn new(Expected { positions, most_errors }: &'a mut Expected) -> Self {
        let (positions, most_errors) =
            (DisjointSlice::new(positions), DisjointSlice::new(most_errors));
        Self { positions, most_errors }
    }
}

/// The motion of a stream's bodies in a frame; an item is a body.
pub(crate) struct Elastic<'a> {
    scratch: DisjointSlice<'a, lattice::Scratch>,
}

impl InFrame for Elastic<'_> {
    fn items(&self, _: usize, observed: &Observed<'_>) -> usize {
        observed.lattices.bodies().len()
    }

    /// Replaces what was predicted for a body.
    fn run(
        &self,
        _: usize,
        body: usize,
        observed: &Observed<'_>,
        _: &Bodies,
        predicted: &Predicted<'_>,
    ) {
        let &Observed { position, velocity, ref ballistic, order, lattices, expected, .. } =
            observed;
        let walls = Walls { lower: ballistic.lower, upper: ballistic.upper };
        let nodes = lattices.nodes(body);
        // SAFETY: only this item has this body, and bodies share no nodes.
        let (scratch, expected) = unsafe {
            let most_error = &mut expected.most_errors.part(body..body + 1)[0];
            let expected = (expected.positions.part(nodes), most_error);
            (&mut self.scratch.part(body..body + 1)[0], expected)
        };
        let motion = (position, velocity);
        for (row, impulse) in lattices.impulses(body, &walls, motion, expected, scratch) {
            // SAFETY: a particle is in one body, and this stage only reads and writes its own.
            let (to, speed) = unsafe { predicted.one(order[row] as usize) };
            for axis in 0..2 {
                let fallen = ballistic.gravity[axis] * ballistic.dt;
                let v = velocity[row][axis] + impulse.velocity_change[axis];
                let x = position[row][axis] + (v + 0.5 * fallen) * ballistic.dt;
                to[axis] = ballistic.clamp_axis(axis, x + impulse.displacement[axis]);
                speed[axis] = v + fallen;
            }
        }
    }
}
