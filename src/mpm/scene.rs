//! Scenes: which bodies, how large, where and how fast, all from a seed and a scene id.

use rand::{RngExt, SeedableRng, seq::SliceRandom};
use rand_chacha::ChaCha8Rng;

use super::{
    attractor::Attractor,
    body::{Body, Shape},
    particle::Particle,
    placement::Placement,
    preset::{PARTICLES, Preset},
};
use crate::frame::Material;

use Material::{Jelly, Liquid, Rope, Snow};

/// The materials of a multi-material scene, by `id % 10`: all ten pairs, so ordered that any six
/// neighbours hold every material.
const PAIRS: [[Material; 2]; 10] = [
    [Liquid, Snow],
    [Jelly, Rope],
    [Liquid, Liquid],
    [Snow, Jelly],
    [Liquid, Rope],
    [Snow, Snow],
    [Liquid, Jelly],
    [Snow, Rope],
    [Jelly, Jelly],
    [Rope, Rope],
];

/// Part of the particles that the first of two materials gets, smallest and largest.
const SHARE: [f32; 2] = [0.3, 0.7];
/// Bodies of one material are split no more unevenly than this.
const SPLIT: [f32; 2] = [0.35, 0.65];
/// Long side of a rectangle by its short side, smallest and largest.
const ASPECT: [f32; 2] = [1.0, 3.0];
/// Particles across a rope: four are two cells.
const ROPE_ROWS: [usize; 2] = [5, 8];
/// Particles of the longest rope that still finds a place: more are cut into several ropes.
const ROPE_PARTICLES: usize = 640;
/// Largest velocity of a body along x and y (domain lengths per second).
const SPEED: f32 = 1.5;
/// Pull of an attractor, smallest and largest (domain lengths per s^2).
const PULL: [f32; 2] = [5.0, 20.0];
/// How long an attractor acts, shortest and longest, in frame intervals.
const PULL_FRAMES: [u32; 2] = [3, 12];
/// Tries to find a place for a body before all bodies are drawn anew.
const TRIES: usize = 200;

/// Everything that a simulation starts from.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// The kind of scene.
    pub preset: Preset,
    /// Number of the scene; the stream of its frames.
    pub id: u64,
    /// The bodies, in the order of their particles.
    pub bodies: Vec<Body>,
    /// What pulls before the recording starts, in about half of the scenes.
    pub attractor: Option<Attractor>,
    /// All particles: [`PARTICLES`] of them.
    pub particles: Vec<Particle>,
}

impl Scene {
    /// The scene `id` of a preset. The same arguments give the same scene, bit by bit.
    pub fn generate(preset: Preset, seed: u64, id: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(id);
        // Bodies fill at most a fifth of the room between the walls, so this ends: of the first
        // thousand scenes none needs more than a few draws.
        let (bodies, particles) = loop {
            if let Some(found) = arrange(preset, id, &mut rng) {
                break found;
            }
        };
        let attractor = rng.random_bool(0.5).then(|| Attractor {
            centre: [rng.random_range(0.2..0.8), rng.random_range(0.2..0.8)],
            strength: rng.random_range(PULL[0]..PULL[1]),
            frames: rng.random_range(PULL_FRAMES[0]..=PULL_FRAMES[1]),
        });
        Self { preset, id, bodies, attractor, particles }
    }

    /// The materials that occur, in the order of their numbers.
    pub fn materials(&self) -> Vec<Material> {
        let occurs = |material: &Material| self.bodies.iter().any(|b| b.material == *material);
        Material::ALL.into_iter().filter(occurs).collect()
    }

    /// The speed of the fastest body: the start, the pull of the attractor, and a fall through the
    /// whole domain added up (domain lengths per second). Jets of a splash were seen to be 3.2 times
    /// as fast.
    pub fn fastest(&self, gravity: f32, interval: f32) -> f32 {
        let start =
            self.particles.iter().map(|p| p.velocity[0].hypot(p.velocity[1])).fold(0.0, f32::max);
        let pulled = self.attractor.map_or(0.0, |a| a.strength * a.frames as f32 * interval);
        start + pulled + (2.0 * gravity).sqrt()
    }
}

/// Draws bodies and places for them; `None` if they found no place.
fn arrange(preset: Preset, id: u64, rng: &mut ChaCha8Rng) -> Option<(Vec<Body>, Vec<Particle>)> {
    let mut bodies = match preset {
        Preset::MultiMaterial => mixed_bodies(PAIRS[(id % PAIRS.len() as u64) as usize], rng),
        Preset::Fluid => {
            let parts = rng.random_range(1..=3);
            bodies_of(Liquid, PARTICLES, parts, rng)
        }
    };
    let mut placement = Placement::new(preset);
    let mut particles = Vec::with_capacity(PARTICLES);
    for body in &mut bodies {
        let placed = (0..TRIES).any(|_| {
            body.centre = [rng.random_range(0.0..1.0), rng.random_range(0.0..1.0)];
            body.angle = rng.random_range(0.0..std::f32::consts::PI);
            placement.take(&body.positions(preset.spacing()))
        });
        if !placed {
            return None;
        }
        particles.extend(body.positions(preset.spacing()).into_iter().map(|position| Particle {
            velocity: body.velocity,
            ..Particle::at_rest(position, body.material)
        }));
    }
    Some((bodies, particles))
}

/// One to three bodies of one or two materials (more where ropes are cut).
fn mixed_bodies([first, second]: [Material; 2], rng: &mut ChaCha8Rng) -> Vec<Body> {
    if first == second {
        let parts = rng.random_range(1..=3);
        return bodies_of(first, PARTICLES, parts, rng);
    }
    let share = part_of(PARTICLES, SHARE, rng);
    let parts = *[[1, 1], [1, 2], [2, 1]].get(rng.random_range(0..3)).unwrap_or(&[1, 1]);
    let mut bodies = bodies_of(first, share, parts[0], rng);
    bodies.extend(bodies_of(second, PARTICLES - share, parts[1], rng));
    bodies.shuffle(rng);
    bodies
}

/// `parts` bodies of one material with `particles` in all, not yet placed.
fn bodies_of(
    material: Material,
    particles: usize,
    parts: usize,
    rng: &mut ChaCha8Rng,
) -> Vec<Body> {
    let parts =
        if material == Rope { parts.max(particles.div_ceil(ROPE_PARTICLES)) } else { parts };
    let mut left = particles;
    (0..parts)
        .rev()
        .map(|others| {
            let particles = match others {
                0 => left,
                1 if material != Rope => part_of(left, SPLIT, rng),
                _ => left / (others + 1),
            };
            left -= particles;
            Body {
                material,
                shape: shape_of(material, particles, rng),
                particles,
                centre: [0.5; 2],
                angle: 0.0,
                velocity: [rng.random_range(-SPEED..SPEED), rng.random_range(-SPEED..SPEED)],
            }
        })
        .collect()
}

fn shape_of(material: Material, particles: usize, rng: &mut ChaCha8Rng) -> Shape {
    if material == Rope {
        return Shape::Rectangle { rows: rng.random_range(ROPE_ROWS[0]..=ROPE_ROWS[1]) };
    }
    if rng.random_bool(0.5) {
        return Shape::Disc;
    }
    let aspect = rng.random_range(ASPECT[0]..ASPECT[1]);
    Shape::Rectangle { rows: (particles as f32 / aspect).sqrt() as usize }
}

/// A random part of `whole`.
fn part_of(whole: usize, [smallest, largest]: [f32; 2], rng: &mut ChaCha8Rng) -> usize {
    (whole as f32 * rng.random_range(smallest..largest)) as usize
}

#[cfg(test)]
mod tests {
    use super::*;

    const PRESETS: [Preset; 2] = [Preset::MultiMaterial, Preset::Fluid];

    #[test]
    fn the_same_seed_and_id_give_the_same_scene_and_others_another() {
        for preset in PRESETS {
            let scene = Scene::generate(preset, 1, 3);
            assert_eq!(scene, Scene::generate(preset, 1, 3));
            assert_ne!(scene.bodies, Scene::generate(preset, 1, 13).bodies);
            assert_ne!(scene.bodies, Scene::generate(preset, 2, 3).bodies);
        }
    }

    #[test]
    fn every_scene_has_2500_particles_a_spacing_apart_inside_the_walls() {
        for (preset, id) in PRESETS.into_iter().flat_map(|p| (0..100).map(move |id| (p, id))) {
            let scene = Scene::generate(preset, 1, id);
            assert_eq!(scene.particles.len(), PARTICLES);
            assert_eq!(scene.bodies.iter().map(|b| b.particles).sum::<usize>(), PARTICLES);
            let positions: Vec<[f32; 2]> = scene.particles.iter().map(|p| p.position).collect();
            let wall = 3.0 * preset.dx();
            assert!(positions.as_flattened().iter().all(|x| (wall..=1.0 - wall).contains(x)));
            let nearest = nearest_neighbours(&positions);
            assert!(nearest > 0.999 * preset.spacing(), "{preset} {id}: {nearest}");
        }
    }

    /// The smallest distance between two points.
    fn nearest_neighbours(points: &[[f32; 2]]) -> f32 {
        let mut sorted = points.to_vec();
        sorted.sort_by(|a, b| a[0].total_cmp(&b[0]));
        let mut nearest = f32::INFINITY;
        for (k, a) in sorted.iter().enumerate() {
            for b in &sorted[k + 1..] {
                if b[0] - a[0] > nearest {
                    break;
                }
                nearest = nearest.min((b[0] - a[0]).hypot(b[1] - a[1]));
            }
        }
        nearest
    }

    #[test]
    fn ten_scenes_hold_every_pair_of_materials() {
        let mut found: Vec<Vec<Material>> =
            (0..10).map(|id| Scene::generate(Preset::MultiMaterial, 1, id).materials()).collect();
        found.sort();
        found.dedup();
        assert_eq!(found.len(), 10);
        assert_eq!(found.iter().filter(|materials| materials.len() == 1).count(), 4);
    }

    #[test]
    fn ropes_are_at_least_two_cells_thick_and_longer_than_thick() {
        for id in 0..40 {
            for body in Scene::generate(Preset::MultiMaterial, 1, id).bodies {
                if let (Rope, shape) = (body.material, body.shape) {
                    let Shape::Rectangle { rows } = shape else { panic!("a rope is a {shape:?}") };
                    assert!(rows >= 4 && body.particles >= 3 * rows * rows);
                }
            }
        }
    }

    #[test]
    fn some_scenes_are_pulled_and_some_are_not() {
        let pulled = (0..100)
            .filter(|&id| Scene::generate(Preset::Fluid, 1, id).attractor.is_some())
            .count();
        assert!((30..=70).contains(&pulled), "{pulled} of 100");
    }
}
