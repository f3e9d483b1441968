//! Particles for benchmarks.

use eddy_frames::{Domain, Frame, Material, Stamp};
use eddy_inference::checkpoint::Description;

/// Distance between particles of a body, for networks that have none (domain lengths).
const SPACING: f32 = 1.0 / 128.0;

/// Particles spread over the unit square.
pub(super) fn frame(particles: usize) -> Frame {
    spread(Domain::UNIT, &Material::ALL, 0.016, particles)
}

/// Particles spread over the network's domain, of its materials.
pub(super) fn frame_for(description: &Description, particles: usize) -> Frame {
    let Description { domain, materials, dt, .. } = description;
    spread(*domain, materials, *dt, particles)
}

/// A square body at rest in the network's domain, of its first material and with the spacing of its training: the time of a
/// prediction depends on the area that the particles cover.
pub(super) fn body_for(description: &Description, particles: usize) -> Frame {
    let mut frame = frame_for(description, particles);
    let Domain { lower, upper } = frame.domain;
    let side = (particles as f64).sqrt().ceil() as usize;
    let spacing =
        description.grid.as_ref().map_or(SPACING, |grid| grid.spacing).min(0.8 / side as f32);
    let place = |n: usize, axis: usize| {
        lower[axis] + (upper[axis] - lower[axis]) * (0.1 + spacing * n as f32)
    };
    frame.position = (0..particles).map(|n| [place(n % side, 0), place(n / side, 1)]).collect();
    frame.velocity.fill([0.0; 2]);
    frame.material.fill(description.materials[0]);
    frame
}

fn spread(domain: Domain, materials: &[Material], dt: f32, particles: usize) -> Frame {
    // Multiples of irrational numbers fill the box evenly.
    let place = |n: usize, axis: usize| {
        let part = (n as f64 * [0.618_033_988_7, 0.754_877_666_2][axis]).fract() as f32;
        domain.lower[axis] + (0.1 + 0.8 * part) * (domain.upper[axis] - domain.lower[axis])
    };
    let pace = |n: usize| [(n as f32 * 0.7).sin(), (n as f32 * 1.3).cos()];
    Frame {
        stream: 0,
        sequence: 0,
        stamp: Stamp(0),
        dt,
        domain,
        position: (0..particles).map(|n| [place(n, 0), place(n, 1)]).collect(),
        velocity: (0..particles).map(pace).collect(),
        material: (0..particles).map(|n| materials[n % materials.len()]).collect(),
    }
}
