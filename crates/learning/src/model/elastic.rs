//! The elastic impulse of jelly ([`lattice`](eddy_inference::kernels::lattice)) over tensors. It is a constant: no gradient passes
//! from it to the state that it depends on.

use burn::tensor::{Tensor, TensorData};
use rayon::prelude::*;

use super::state::{ParticleState, StaticInputs, pairs};
use eddy_inference::{
    checkpoint::Description,
    engine::{Ballistic, scales::velocity_unit},
    kernels::lattice::{Scratch, Walls},
};

/// The constants of a described network.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Elastic {
    walls: Walls,
    /// Unit of the decoder's positions (domain lengths).
    unit: f32,
}

/// What the network sees of particles, and what follows for its output.
pub(crate) struct Seen {
    /// The state with the impulse, `[T R, 2]`.
    pub(crate) state: ParticleState,
    /// What to add to the decoder's output, `[T R, 4]`; none if nothing has an impulse.
    pub(crate) offset: Option<Tensor<2>>,
}

impl Elastic {
    /// None if the network sees matter as it is.
    pub(crate) fn new(description: &Description) -> Option<Self> {
        description.elastic?;
        let Ballistic { lower, upper, dt, .. } = Ballistic::new(description);
        Some(Self {
            walls: Walls { lower, upper },
            unit: velocity_unit(&description.normalization) * dt,
        })
    }

    /// The particles of T frames, `[T R, 2]`, with their impulses.
    pub(crate) fn apply(&self, state: &ParticleState, fixed: &StaticInputs) -> Seen {
        if fixed.lattices.iter().all(|lattice| lattice.is_empty()) {
            return Seen { state: state.clone(), offset: None };
        }
        let particles = fixed.particles();
        let [position, velocity] =
            [&state.position, &state.velocity].map(|tensor| pairs(tensor.clone().detach()));
        let mut change = vec![[0.0; 2]; position.len()];
        let mut offset = vec![[0.0; 4]; position.len()];
        let own = position.par_chunks(particles).zip(velocity.par_chunks(particles));
        let to = change.par_chunks_mut(particles).zip(offset.par_chunks_mut(particles));
        own.zip(to).enumerate().for_each(|(window, ((position, velocity), (change, offset)))| {
            let lattice = &fixed.lattices[window % fixed.windows];
            let (moved, mut scratch) = ((position, velocity), Scratch::default());
            let impulses = lattice.impulses(&self.walls, moved, &mut scratch);
            for (row, impulse) in impulses {
                change[row] = impulse.velocity_change;
                let [x, y] = impulse.displacement.map(|x| x / self.unit);
                offset[row] = [0.0, 0.0, x, y];
            }
        });
        let (rows, device) = (position.len(), state.velocity.device());
        let change = TensorData::new(change.into_flattened(), [rows, 2]);
        let offset = TensorData::new(offset.into_flattened(), [rows, 4]);
        let velocity = state.velocity.clone() + Tensor::from_data(change, &device);
        Seen {
            state: ParticleState { position: state.position.clone(), velocity },
            offset: Some(Tensor::from_data(offset, &device)),
        }
    }
}
