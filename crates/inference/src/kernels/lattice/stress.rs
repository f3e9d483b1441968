//! The forces of the stress at a quadrature point on the nodes of its element.

use super::{Elasticity, Node, Point};

/// Stretch from which on a point has no stress: bodies that touched in the first frame, and so share a lattice, come apart.
const TORN: f32 = 1.6;

/// Adds the forces of a point's stress, in units of a particle's mass, to its nodes.
#[inline(always)]
pub(super) fn add_forces(elasticity: &Elasticity, point: &Point, nodes: &mut [Node]) {
    let Elasticity { lame: [mu, lambda], viscosity, .. } = *elasticity;
    let Point { nodes: corners, gradients, particles, width } = point;
    let (mut f, mut rate) = ([[0.0f32; 2]; 2], [[0.0f32; 2]; 2]);
    for corner in 0..4 {
        let Node { position: x, velocity: v, .. } = nodes[corners[corner] as usize];
        for row in 0..2 {
            for column in 0..2 {
                f[row][column] += x[row] * gradients[corner][column];
                rate[row][column] += v[row] * gradients[corner][column];
            }
        }
    }
    // The rotation R of the polar decomposition; the sum and the difference of the stretches.
    let (cos, sin) = (f[0][0] + f[1][1], f[1][0] - f[0][1]);
    let length = (cos * cos + sin * sin).sqrt().max(1e-12);
    let difference = (f[0][0] - f[1][1]).powi(2) + (f[1][0] + f[0][1]).powi(2);
    let apart = 2.0 * TORN - length;
    let is_torn = apart < 0.0 || difference > apart * apart;
    let area = if is_torn { 0.0 } else { *particles };
    let (cos, sin) = (cos / length, sin / length);
    let modulus = lambda + 2.0 * mu;
    let volumetric = lambda * (f[0][0] * f[1][1] - f[0][1] * f[1][0] - 1.0);
    let (twice, viscous) = (2.0 * mu, 0.5 * viscosity * modulus.sqrt() * width);
    // The rate of strain, 1/2 (F' R^T + R F'^T), times R: 1/2 (F' + R F'^T R).
    let turned = [
        [cos * rate[0][0] - sin * rate[0][1], cos * rate[1][0] - sin * rate[1][1]],
        [sin * rate[0][0] + cos * rate[0][1], sin * rate[1][0] + cos * rate[1][1]],
    ];
    let rate = [
        [
            rate[0][0] + turned[0][0] * cos + turned[0][1] * sin,
            rate[0][1] - turned[0][0] * sin + turned[0][1] * cos,
        ],
        [
            rate[1][0] + turned[1][0] * cos + turned[1][1] * sin,
            rate[1][1] - turned[1][0] * sin + turned[1][1] * cos,
        ],
    ];
    // First Piola-Kirchhoff stress, 2 mu (F - R) + lambda (J - 1) cof F, and the viscous one.
    let stress = [
        [
            twice * (f[0][0] - cos) + volumetric * f[1][1] + viscous * rate[0][0],
            twice * (f[0][1] + sin) - volumetric * f[1][0] + viscous * rate[0][1],
        ],
        [
            twice * (f[1][0] - sin) - volumetric * f[0][1] + viscous * rate[1][0],
            twice * (f[1][1] - cos) + volumetric * f[0][0] + viscous * rate[1][1],
        ],
    ];
    for corner in 0..4 {
        let force = &mut nodes[corners[corner] as usize].force;
        for axis in 0..2 {
            let [along_x, along_y] = gradients[corner];
            let elastic = stress[axis][0] * along_x + stress[axis][1] * along_y;
            force[axis] -= area * elastic;
        }
    }
}
