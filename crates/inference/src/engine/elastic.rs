//! The elastic impulse of jelly in a frame, after which the particle model sees it.

use super::{Ballistic, HiddenState};
use crate::kernels::lattice::{self, Walls};

/// Buffers of a frame, by rows of the hidden state.
#[derive(Debug, Default)]
pub(super) struct Scratch {
    lattice: lattice::Scratch,
    /// Domain lengths per second.
    velocity: Vec<[f32; 2]>,
    /// Domain lengths.
    displacement: Vec<[f32; 2]>,
}

/// What the network sees of a frame.
pub(super) struct Seen<'a> {
    /// Velocities with the impulse (domain lengths per second).
    pub(super) velocity: &'a [[f32; 2]],
    /// What to add to positions after the ballistic step (domain lengths); empty if no particle has an impulse.
    pub(super) displacement: &'a [[f32; 2]],
}

impl Scratch {
    /// The impulses of a frame's positions and velocities, by rows of the hidden state.
    pub(super) fn apply<'a>(
        &'a mut self,
        hidden: &HiddenState,
        &Ballistic { lower, upper, .. }: &Ballistic,
        (position, velocity): (&[[f32; 2]], &'a [[f32; 2]]),
    ) -> Seen<'a> {
        if hidden.lattice.is_empty() {
            return Seen { velocity, displacement: &[] };
        }
        let Self { lattice, velocity: changed, displacement } = self;
        velocity.clone_into(changed);
        displacement.clear();
        displacement.resize(velocity.len(), [0.0; 2]);
        let walls = Walls { lower, upper };
        let moved = (position, velocity);
        for (row, impulse) in hidden.lattice.impulses(&walls, moved, lattice) {
            let [x, y] = impulse.velocity_change;
            changed[row] = [changed[row][0] + x, changed[row][1] + y];
            displacement[row] = impulse.displacement;
        }
        Seen { velocity: changed, displacement }
    }
}
