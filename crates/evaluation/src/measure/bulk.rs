//! Bulk quantities: kinetic energy, centre of mass, share outside the walls.

use super::Mean;
use crate::errors::square;
use eddy_frames::State;

/// Bulk quantities at one frame ahead, accumulated over windows.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Bulk {
    /// Kinetic energy per mass (domain lengths^2 per s^2).
    pub kinetic_energy: Mean,
    /// Squared distance of the centre of mass from the true one (domain lengths^2).
    pub centre: Mean,
    /// Share of the particles beyond an effective wall by more than half a spacing (0 to 1).
    pub outside: Mean,
}

impl Bulk {
    /// Adds a predicted state; `centre` is the true centre of mass.
    pub(super) fn add(
        &mut self,
        state: &State,
        centre: [f64; 2],
        walls: [[f32; 2]; 2],
        margin: f32,
    ) {
        self.kinetic_energy.add(kinetic_energy(&state.velocity), 1.0);
        let found = mean(state.position.iter());
        self.centre.add(square([found[0] - centre[0], found[1] - centre[1]]), 1.0);
        self.outside.add(share_outside(&state.position, walls, margin), 1.0);
    }

    /// Adds the sums of other windows.
    pub fn merge(&mut self, other: &Self) {
        self.kinetic_energy.merge(&other.kinetic_energy);
        self.centre.merge(&other.centre);
        self.outside.merge(&other.outside);
    }
}

/// Mean of |v|^2 / 2 (domain lengths^2 per s^2): kinetic energy per mass.
pub(crate) fn kinetic_energy(velocity: &[[f32; 2]]) -> f64 {
    let sum: f64 = velocity.iter().map(|v| square(v.map(f64::from))).sum();
    0.5 * sum / velocity.len() as f64
}

/// Mean of vectors `[N, 2]`: the centre of mass of positions, the momentum per mass of velocities.
pub(super) fn mean<'a>(vectors: impl Iterator<Item = &'a [f32; 2]>) -> [f64; 2] {
    let (mut sum, mut count) = ([0.0; 2], 0.0);
    for v in vectors {
        sum = [sum[0] + f64::from(v[0]), sum[1] + f64::from(v[1])];
        count += 1.0;
    }
    sum.map(|component| component / count)
}

/// Share of positions beyond a wall by more than `margin` (domain lengths), 0 to 1.
pub(super) fn share_outside(
    position: &[[f32; 2]],
    [lower, upper]: [[f32; 2]; 2],
    margin: f32,
) -> f64 {
    let outside = |x: &&[f32; 2]| {
        !(0..2).all(|axis| (lower[axis] - margin..=upper[axis] + margin).contains(&x[axis]))
    };
    position.iter().filter(outside).count() as f64 / position.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn energy_and_centre_are_means_over_particles() {
        assert_eq!(kinetic_energy(&[[3.0, 4.0], [0.0, 0.0]]), 6.25);
        assert_eq!(mean([[1.0, 2.0], [3.0, -2.0]].iter()), [2.0, 0.0]);
    }

    #[test]
    fn positions_beyond_a_wall_by_more_than_the_margin_are_outside() {
        let walls = [[0.25; 2], [0.75; 2]];
        let position = [[0.5, 0.5], [0.2, 0.5], [0.5, 0.9], [f32::NAN, 0.5]];
        assert_eq!(share_outside(&position, walls, 0.0), 0.75);
        assert_eq!(share_outside(&position, walls, 0.1), 0.5);
    }
}
