//! Random scenes: which bodies, how large, where and how fast, all from a seed and a scene id.

use rand::{RngExt, SeedableRng, seq::SliceRandom};
use rand_chacha::ChaCha8Rng;

use super::{
    attractor::Attractor,
    body::Body,
    grid::GridShape,
    placement::Placement,
    preset::{PARTICLES, Preset},
    scene::Scene,
    shape::Shape,
};
use crate::frame::Material;

use Material::{Jelly, Liquid, Rope, Snow};

/// The bodies of a multi-material scene, by `id % 6`. A pair occurs where two bodies of a scene
/// have its materials: all ten pairs of the four materials, a material with itself among them, are
/// in these six scenes. So they are in any six neighbours: in the test part of 60 scenes (54..59),
/// in its validation part, and many times in its training part. Any three neighbours hold every
/// material.
const MIXES: [&[Material]; 6] = [
    &[Liquid, Liquid, Snow],
    &[Jelly, Jelly, Rope],
    &[Liquid, Rope, Rope],
    &[Snow, Snow, Jelly],
    &[Liquid, Jelly],
    &[Snow, Rope],
];

/// The bodies of a scene of one material, by `id / 5 % 3`, and how many kinds of scenes come in turn:
/// each material alone, then a mix.
const ALONE: [usize; 3] = [2, 3, 1];
const KINDS: usize = Material::COUNT + 1;

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

impl Scene {
    /// The scene `id` of a preset. The same arguments give the same scene, bit by bit.
    pub fn generate(preset: Preset, seed: u64, id: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(id);
        // Bodies fill at most a fifth of the room between the walls, so this ends: of the first
        // thousand scenes none needs more than a few draws.
        let bodies = loop {
            if let Some(found) = arrange(preset, id, &mut rng) {
                break found;
            }
        };
        let attractor = rng.random_bool(0.5).then(|| Attractor {
            centre: [rng.random_range(0.2..0.8), rng.random_range(0.2..0.8)],
            strength: rng.random_range(PULL[0]..PULL[1]),
            frames: rng.random_range(PULL_FRAMES[0]..=PULL_FRAMES[1]),
        });
        Self { id, bodies, attractor, ..preset.empty_scene() }
    }
}

/// Draws bodies and places for them; `None` if they found no place.
fn arrange(preset: Preset, id: u64, rng: &mut ChaCha8Rng) -> Option<Vec<Body>> {
    let spacing = preset.spacing();
    let mut bodies = match preset {
        Preset::MultiMaterial | Preset::Stiff => {
            mixed_bodies(MIXES[(id % MIXES.len() as u64) as usize], spacing, rng)
        }
        Preset::Fluid => {
            let parts = rng.random_range(1..=3);
            bodies_of(Liquid, PARTICLES, parts, spacing, rng)
        }
        Preset::Kinds => {
            let (round, kind) = (id as usize / KINDS, id as usize % KINDS);
            match Material::ALL.get(kind) {
                Some(&alone) => {
                    bodies_of(alone, PARTICLES, ALONE[round % ALONE.len()], spacing, rng)
                }
                None => mixed_bodies(MIXES[round % MIXES.len()], spacing, rng),
            }
        }
    };
    let mut placement = Placement::new(GridShape::unit(preset.cells()));
    for body in &mut bodies {
        let lattice = body.lattice(spacing);
        let placed = (0..TRIES).any(|_| {
            body.position = [rng.random_range(0.0..1.0), rng.random_range(0.0..1.0)];
            body.angle_degrees = rng.random_range(0.0..180.0);
            placement.take(&body.placed(&lattice))
        });
        if !placed {
            return None;
        }
    }
    Some(bodies)
}

/// The bodies of one or two materials (more where ropes are cut), in any order.
fn mixed_bodies(mix: &[Material], spacing: f32, rng: &mut ChaCha8Rng) -> Vec<Body> {
    let (first, second) = (mix[0], mix[mix.len() - 1]);
    let share = part_of(PARTICLES, SHARE, rng);
    let bodies = |material: Material| mix.iter().filter(|&&m| m == material).count();
    let mut all = bodies_of(first, share, bodies(first), spacing, rng);
    all.extend(bodies_of(second, PARTICLES - share, bodies(second), spacing, rng));
    all.shuffle(rng);
    all
}

/// `parts` bodies of one material with `particles` in all, not yet placed.
fn bodies_of(
    material: Material,
    particles: usize,
    parts: usize,
    spacing: f32,
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
                shape: shape_of(material, particles, spacing, rng),
                position: [0.5; 2],
                angle_degrees: 0.0,
                velocity: [rng.random_range(-SPEED..SPEED), rng.random_range(-SPEED..SPEED)],
                particles: Some(particles),
            }
        })
        .collect()
}

/// A shape with room for so many particles, and hardly more.
fn shape_of(material: Material, particles: usize, spacing: f32, rng: &mut ChaCha8Rng) -> Shape {
    let rows = if material == Rope {
        rng.random_range(ROPE_ROWS[0]..=ROPE_ROWS[1])
    } else if rng.random_bool(0.5) {
        // One spacing more than the area asks for, so that no lattice has too few points.
        let radius = (particles as f32 / std::f32::consts::PI).sqrt() + 1.0;
        return Shape::Disc { radius: radius * spacing };
    } else {
        (particles as f32 / rng.random_range(ASPECT[0]..ASPECT[1])).sqrt() as usize
    };
    let columns = particles.div_ceil(rows);
    Shape::Rectangle { size: [columns as f32 * spacing, rows as f32 * spacing] }
}

/// A random part of `whole`.
fn part_of(whole: usize, [smallest, largest]: [f32; 2], rng: &mut ChaCha8Rng) -> usize {
    (whole as f32 * rng.random_range(smallest..largest)) as usize
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    const PRESETS: [Preset; 3] = [Preset::MultiMaterial, Preset::Fluid, Preset::Kinds];

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
            let particles = scene.particles().unwrap();
            assert_eq!(particles.len(), PARTICLES);
            let positions: Vec<[f32; 2]> = particles.iter().map(|p| p.position).collect();
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

    /// The pairs of materials that are neighbours in a scene, a material with itself included.
    fn pairs(scene: &Scene) -> BTreeSet<[Material; 2]> {
        let materials: Vec<Material> = scene.bodies.iter().map(|body| body.material).collect();
        let mut pairs = BTreeSet::new();
        for (k, &first) in materials.iter().enumerate() {
            for &second in &materials[k + 1..] {
                pairs.insert([first.min(second), first.max(second)]);
            }
        }
        pairs
    }

    #[test]
    fn all_ten_pairs_of_materials_are_in_every_part_of_the_papers_sixty_scenes() {
        let scenes: Vec<Scene> =
            (0..60).map(|id| Scene::generate(Preset::MultiMaterial, 1, id)).collect();
        for part in [0..48, 48..54, 54..60] {
            let found: BTreeSet<[Material; 2]> =
                scenes[part.clone()].iter().flat_map(pairs).collect();
            assert_eq!(found.len(), 10, "{part:?}: {found:?}");
        }
        assert!(scenes.iter().all(|scene| !pairs(scene).is_empty()));
        let fewest = |materials: &[Scene]| {
            materials.iter().flat_map(Scene::materials).collect::<BTreeSet<_>>().len()
        };
        assert!(scenes.windows(3).all(|neighbours| fewest(neighbours) == Material::COUNT));
    }

    #[test]
    fn kinds_are_each_material_alone_and_then_a_mix_in_turn() {
        for id in 0..40 {
            let found = Scene::generate(Preset::Kinds, 1, id).materials();
            match Material::ALL.get(id as usize % KINDS) {
                Some(&alone) => assert_eq!(found, [alone], "{id}"),
                None => assert_eq!(found.len(), 2, "{id}: {found:?}"),
            }
        }
    }

    #[test]
    fn stiff_scenes_are_the_multi_material_ones_of_another_stiffness() {
        let [soft, stiff] =
            [Preset::MultiMaterial, Preset::Stiff].map(|preset| Scene::generate(preset, 1, 7));
        assert_eq!(stiff.bodies, soft.bodies);
        assert_eq!((soft.materials.stiffness, stiff.materials.stiffness), (1e3, 1e5));
    }

    #[test]
    fn ropes_are_at_least_two_cells_thick_and_longer_than_thick() {
        for id in 0..40 {
            for body in Scene::generate(Preset::MultiMaterial, 1, id).bodies {
                if let (Rope, shape) = (body.material, body.shape) {
                    let Shape::Rectangle { size } = shape else { panic!("a rope is a {shape:?}") };
                    let [length, thickness] = size.map(|side| side * 64.0);
                    assert!(thickness >= 2.0 && length >= 3.0 * thickness, "{size:?}");
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
