//! Density maps: the distribution of particles regardless of their identity.

use burn::tensor::{Tensor, activation::relu};

use eddy_frames::Domain;

/// Distributes each particle bilinearly over the four nearest nodes of a `grid` x `grid` lattice over the domain, whose
/// outermost nodes are on the boundary. Positions are `[T, R, 2]`; returns `[T B, G, G]`, y first, relative to a uniform
/// distribution.
///
/// The weight of node i is hat(x - i) along each axis, so that the map of a window is the product of two matrices,
/// sum_p hat(y_p - j) hat(x_p - i).
pub(super) fn density_maps(
    position: Tensor<3>,
    windows: usize,
    grid: usize,
    domain: Domain,
) -> Tensor<3> {
    let [frames, rows, _] = position.dims();
    let particles = rows / windows;
    let device = position.device();
    let nodes: Vec<f32> = (0..grid).map(|node| node as f32).collect();
    let nodes = Tensor::<1>::from_floats(nodes.as_slice(), &device).reshape([1, 1, grid]);
    let hats = |axis: usize| {
        let cell = (domain.upper[axis] - domain.lower[axis]) / (grid - 1) as f32;
        let along = position
            .clone()
            .slice([0..frames, 0..rows, axis..axis + 1])
            .sub_scalar(domain.lower[axis])
            .div_scalar(cell)
            .clamp(0.0, (grid - 1) as f32)
            .reshape([frames * windows, particles, 1]);
        relu((along - nodes.clone()).abs().neg().add_scalar(1.0)) // [T B, N, G]
    };
    let even = particles as f32 / (grid * grid) as f32;
    hats(1).swap_dims(1, 2).matmul(hats(0)).div_scalar(even)
}

#[cfg(test)]
mod tests {
    use burn::tensor::{Device, TensorData};

    use super::*;

    const GRID: usize = 8;
    const POSITIONS: [f32; 12] =
        [0.31, 0.42, 0.5, 0.77, 0.9, 0.13, 0.05, 0.05, 0.66, 0.61, 0.28, 0.97];

    fn positions(values: &[f32], device: &Device) -> Tensor<3> {
        Tensor::from_data(TensorData::new(values.to_vec(), [1, 6, 2]), device)
    }

    /// A sum with a different weight for each node.
    fn weighted(maps: Tensor<3>) -> Tensor<1> {
        let device = maps.device();
        let weights: Vec<f32> =
            (0..2 * GRID * GRID).map(|i| ((i * 7919) % 101) as f32 / 101.0).collect();
        let weights = TensorData::new(weights, [2, GRID, GRID]);
        (maps.square() * Tensor::<3>::from_data(weights, &device)).sum()
    }

    #[test]
    fn the_mass_of_a_map_is_the_number_of_particles() {
        let maps = density_maps(positions(&POSITIONS, &Device::flex()), 2, GRID, Domain::UNIT);
        let masses: Vec<f32> = maps.sum_dim(2).sum_dim(1).into_data().try_to_vec().unwrap();
        for mass in masses {
            assert!((mass - (GRID * GRID) as f32).abs() < 1e-4, "{mass}");
        }
    }

    #[test]
    fn the_gradient_equals_finite_differences() {
        let device = Device::flex().autodiff();
        let leaf = positions(&POSITIONS, &device).require_grad();
        let gradients = weighted(density_maps(leaf.clone(), 2, GRID, Domain::UNIT)).backward();
        let gradient: Vec<f32> = leaf.grad(&gradients).unwrap().into_data().try_to_vec().unwrap();
        let step = 2e-3;
        for (index, gradient) in gradient.iter().enumerate() {
            let moved = |by: f32| {
                let mut values = POSITIONS;
                values[index] += by;
                let maps = density_maps(positions(&values, &Device::flex()), 2, GRID, Domain::UNIT);
                weighted(maps).into_scalar::<f32>()
            };
            let difference = (moved(step) - moved(-step)) / (2.0 * step);
            let scale = 1.0 + gradient.abs();
            assert!((gradient - difference).abs() < 0.02 * scale, "{gradient} {difference}");
        }
    }
}
