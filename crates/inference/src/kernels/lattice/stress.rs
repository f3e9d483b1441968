//! The stretch at a quadrature point, and the forces of its stress on the nodes of its element.

use super::{Elasticity, Node, Point, add_scaled};

/// The deformation gradient at a point.
#[inline(always)]
fn deformation(Point { nodes: corners, gradients, .. }: &Point, nodes: &[Node]) -> [[f32; 2]; 2] {
    let mut f = [[0.0; 2]; 2];
    for (&corner, gradient) in corners.iter().zip(gradients) {
        for (row, x) in f.iter_mut().zip(nodes[corner as usize].position) {
            add_scaled(row, x, *gradient);
        }
    }
    f
}

/// The larger stretch at a point.
pub(super) fn stretch(point: &Point, nodes: &[Node]) -> f32 {
    let f = deformation(point, nodes);
    let sum = (f[0][0] + f[1][1]).hypot(f[1][0] - f[0][1]);
    0.5 * (sum + (f[0][0] - f[1][1]).hypot(f[1][0] + f[0][1]))
}

/// Adds the forces of a point's stress, in units of a particle's mass, to its nodes.
#[inline(always)]
pub(super) fn add_forces(elasticity: &Elasticity, point: &Point, nodes: &mut [Node]) {
    let Elasticity { lame: [mu, lambda], viscosity, .. } = *elasticity;
    let Point { nodes: corners, gradients, particles, width } = point;
    let (f, mut rate) = (deformation(point, nodes), [[0.0f32; 2]; 2]);
    for corner in 0..4 {
        let v = nodes[corners[corner] as usize].velocity;
        for row in 0..2 {
            for column in 0..2 {
                rate[row][column] += v[row] * gradients[corner][column];
            }
        }
    }
    // The rotation R of the polar decomposition.
    let (cos, sin) = (f[0][0] + f[1][1], f[1][0] - f[0][1]);
    let length = (cos * cos + sin * sin).sqrt().max(1e-12);
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
            force[axis] -= particles * elastic;
        }
    }
}
