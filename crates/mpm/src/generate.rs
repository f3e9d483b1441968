//! Random scenes: bodies with random sizes, positions and velocities, from a seed and a scene id.

use rand::{RngExt, SeedableRng, seq::SliceRandom};
use rand_chacha::ChaCha8Rng;

use super::{
    attractor::Attractor, body::Body, extent::Extent, manipulation, placement::Placement,
    preset::Preset, scene::Scene, shape::Shape,
};
use eddy_frames::Material;

use Material::{Jelly, Liquid, Rope, Sand, Snow};

/// Materials of the bodies of a multi-material scene, by `id % 6`. These six scenes contain all ten pairs of four
/// materials, including each with itself. So do any six consecutive scenes: the test part (54..59) and the
/// validation part of 60 scenes, and the training part many times. Any three consecutive scenes contain every material.
const MIXES: [&[Material]; 6] = [
    &[Liquid, Liquid, Snow],
    &[Jelly, Jelly, Rope],
    &[Liquid, Rope, Rope],
    &[Snow, Snow, Jelly],
    &[Liquid, Jelly],
    &[Snow, Rope],
];

/// Materials of the scenes of one material, and those that sand is mixed with in scenes of its own.
const KINDS_ALONE: [Material; 4] = [Liquid, Snow, Jelly, Rope];
/// Numbers of bodies of a scene of one material, by `id / 5 % 3`, and number of kinds of scenes: each material alone,
/// then a mix.
const ALONE: [usize; 3] = [2, 3, 1];
const KINDS: usize = KINDS_ALONE.len() + 1;

/// Range of the first material's share of the particles.
const SHARE: [f32; 2] = [0.3, 0.7];
/// Range of the share of one of two bodies of the same material.
const SPLIT: [f32; 2] = [0.35, 0.65];
/// Range of the aspect ratio of rectangles.
const ASPECT: [f32; 2] = [1.0, 3.0];
/// Range of particles across a rope: four are two cells.
const ROPE_ROWS: [usize; 2] = [5, 8];
/// Minimum aspect ratio of a rope.
const ROPE_ASPECT: usize = 3;
/// Minimum number of particles of a body: that of the shortest rope. Below it there are fewer bodies.
const MIN_BODY_PARTICLES: usize = ROPE_ROWS[0] * ROPE_ROWS[0] * ROPE_ASPECT;
/// Maximum number of particles of a rope that still fits: longer ropes are cut.
const ROPE_PARTICLES: usize = 640;
/// Maximum velocity of a body along x and y (domain lengths per second).
const SPEED: f32 = 1.5;
/// Range of an attractor's strength (domain lengths per s^2).
const PULL: [f32; 2] = [5.0, 20.0];
/// Range of an attractor's duration (frame intervals).
const PULL_FRAMES: [u32; 2] = [3, 12];
/// Attempts to place a body before all bodies are redrawn.
const TRIES: usize = 200;

impl Scene {
    /// The scene `id` of a preset, with 2,500 particles in the unit square. The same arguments give
    /// the same scene, bit by bit.
    pub fn generate(preset: Preset, seed: u64, id: u64) -> Self {
        Self::generate_in(&Extent::usual(preset), seed, id)
    }

    /// As [`Scene::generate`], with the number of particles of `extent`.
    pub fn generate_in(extent: &Extent, seed: u64, id: u64) -> Self {
        let random = |id: u64| {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            rng.set_stream(id);
            rng
        };
        let mut rng = random(id);
        if extent.preset().has_tools() {
            let mut scene = manipulation::generate(extent, id, &mut rng);
            stiffen(&mut scene, extent, &mut rng);
            return scene;
        }
        let bodies = if extent.same_bodies() {
            let bodies = arrange_all(extent, 0, &mut random(0));
            bodies.into_iter().map(|body| Body { velocity: velocity(&mut rng), ..body }).collect()
        } else {
            arrange_all(extent, id, &mut rng)
        };
        let width = extent.width_of_a_set();
        let attractor = rng.random_bool(0.5).then(|| Attractor {
            centre: [width * rng.random_range(0.2..0.8), rng.random_range(0.2..0.8)],
            strength: rng.random_range(PULL[0]..PULL[1]),
            frames: rng.random_range(PULL_FRAMES[0]..=PULL_FRAMES[1]),
            period: (extent.sets() > 1).then_some(width),
        });
        let domain = extent.grid().size();
        let mut scene = Self { id, domain, bodies, attractor, ..extent.preset().empty_scene() };
        stiffen(&mut scene, extent, &mut rng);
        scene
    }
}

/// Draws the scene's stiffness, if it is random.
fn stiffen(scene: &mut Scene, extent: &Extent, rng: &mut ChaCha8Rng) {
    if let Some([low, high]) = extent.stiffness() {
        let [low, high] = [low, high].map(f64::from);
        let stiffness = low * (high / low).powf(rng.random_range(0.0..1.0));
        scene.materials.stiffness = stiffness.clamp(low, high) as f32;
    }
}

/// Draws the bodies of all sets.
fn arrange_all(extent: &Extent, id: u64, rng: &mut ChaCha8Rng) -> Vec<Body> {
    let mut placement = Placement::new(extent.grid());
    (0..extent.sets())
        .flat_map(|set| {
            // Bodies fill at most a fifth of the region between the walls, so this terminates: none of the first thousand
            // scenes needs more than a few draws. A random fill, which is drawn again with the bodies, begins at about that.
            loop {
                if let Some(found) = arrange(extent, set, id, &mut placement, rng) {
                    break found;
                }
            }
        })
        .collect()
}

/// A random velocity of a body.
fn velocity(rng: &mut ChaCha8Rng) -> [f32; 2] {
    [rng.random_range(-SPEED..SPEED), rng.random_range(-SPEED..SPEED)]
}

/// Draws the bodies of a set and places them, with their centres in the set's part of the domain. If they do not fit,
/// returns `None` and leaves `placement` unchanged.
fn arrange(
    extent: &Extent,
    set: usize,
    id: u64,
    placement: &mut Placement,
    rng: &mut ChaCha8Rng,
) -> Option<Vec<Body>> {
    let spacing = extent.preset().spacing();
    let mut bodies = set_of_bodies(extent, set, id, rng);
    let [left, right] = [set, set + 1].map(|set| set as f32 * extent.width_of_a_set());
    let before = placement.clone();
    for body in &mut bodies {
        let lattice = body.lattice(spacing);
        let placed = (0..TRIES).any(|_| {
            body.position = [rng.random_range(left..right), rng.random_range(0.0..1.0)];
            body.angle_degrees = rng.random_range(0.0..180.0);
            placement.take(&body.placed(&lattice))
        });
        if !placed {
            *placement = before;
            return None;
        }
    }
    Some(bodies)
}

/// The bodies of a set, not yet placed. The sets of a wide scene correspond to the next scenes of the same kind.
fn set_of_bodies(extent: &Extent, set: usize, id: u64, rng: &mut ChaCha8Rng) -> Vec<Body> {
    let preset = extent.preset();
    let (id, spacing) = (id as usize, preset.spacing());
    let particles = match extent.fill() {
        Some([low, high]) => (rng.random_range(low..high) / (spacing * spacing)) as usize,
        None => extent.particles_of(set),
    };
    match preset {
        Preset::MultiMaterial | Preset::Stiff => {
            mixed_bodies(MIXES[(id + set) % MIXES.len()], particles, spacing, rng)
        }
        Preset::Fluid => {
            let parts = rng.random_range(1..=3);
            bodies_of(Liquid, particles, parts, spacing, rng)
        }
        Preset::Sand => {
            let (round, kind) = (id / 2 + set, id % 2);
            match kind {
                0 => bodies_of(Sand, particles, ALONE[round % ALONE.len()], spacing, rng),
                _ => {
                    let other = KINDS_ALONE[round % KINDS_ALONE.len()];
                    mixed_bodies(&[Sand, other], particles, spacing, rng)
                }
            }
        }
        // Scenes with tools have bodies of their own.
        Preset::Kinds | Preset::Push | Preset::Pour | Preset::Scoop => {
            let (round, kind) = (id / KINDS + set, id % KINDS);
            match KINDS_ALONE.get(kind) {
                Some(&alone) => {
                    bodies_of(alone, particles, ALONE[round % ALONE.len()], spacing, rng)
                }
                None => mixed_bodies(MIXES[round % MIXES.len()], particles, spacing, rng),
            }
        }
    }
}

/// The bodies of one or two materials (more if ropes are cut), in random order.
fn mixed_bodies(
    mix: &[Material],
    particles: usize,
    spacing: f32,
    rng: &mut ChaCha8Rng,
) -> Vec<Body> {
    let (first, second) = (mix[0], mix[mix.len() - 1]);
    let share = part_of(particles, SHARE, rng);
    let bodies = |material: Material| mix.iter().filter(|&&m| m == material).count();
    let mut all = bodies_of(first, share, bodies(first), spacing, rng);
    all.extend(bodies_of(second, particles - share, bodies(second), spacing, rng));
    all.shuffle(rng);
    all
}

/// `parts` bodies of one material with `particles` in total, not yet placed: fewer bodies if they would be too small, and
/// more ropes if they would be too long.
fn bodies_of(
    material: Material,
    particles: usize,
    parts: usize,
    spacing: f32,
    rng: &mut ChaCha8Rng,
) -> Vec<Body> {
    let parts = parts.min(particles / MIN_BODY_PARTICLES).max(1);
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
                velocity: velocity(rng),
                particles: Some(particles),
            }
        })
        .collect()
}

/// A shape for slightly more than this number of particles.
fn shape_of(material: Material, particles: usize, spacing: f32, rng: &mut ChaCha8Rng) -> Shape {
    let rows = if material == Rope {
        let thickest = ROPE_ROWS[1].min((particles / ROPE_ASPECT).isqrt());
        rng.random_range(ROPE_ROWS[0]..=thickest.max(ROPE_ROWS[0]))
    } else if rng.random_bool(0.5) {
        // One spacing more than the area requires, so that no lattice has too few points.
        let radius = (particles as f32 / std::f32::consts::PI).sqrt() + 1.0;
        return Shape::Disc { radius: radius * spacing };
    } else {
        (particles as f32 / rng.random_range(ASPECT[0]..ASPECT[1])).sqrt() as usize
    };
    let columns = particles.div_ceil(rows);
    Shape::Rectangle { size: [columns as f32 * spacing, rows as f32 * spacing] }
}

/// A random share of `whole`.
fn part_of(whole: usize, [smallest, largest]: [f32; 2], rng: &mut ChaCha8Rng) -> usize {
    (whole as f32 * rng.random_range(smallest..largest)) as usize
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use sha2::{Digest, Sha256};

    use super::{super::preset::PARTICLES, *};

    const PRESETS: [Preset; 4] =
        [Preset::MultiMaterial, Preset::Fluid, Preset::Kinds, Preset::Sand];

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
    fn the_scenes_of_2500_particles_have_not_changed() {
        // Digests of bodies and attractors in the manifests of `eddy simulate --preset .. --scenes 10`
        // (seed 1) before scenes could have other numbers of particles.
        let multi_material = "179655deff5684195fb375394a2e3dc34f5a999e23f230a2092878de657d0238";
        let before = [
            (Preset::MultiMaterial, multi_material),
            (Preset::Stiff, multi_material),
            (Preset::Fluid, "3b59b9fe0ad7c80a5258f3bcbc840c9dc5faf67559d9e59e7c5ad7da521624a9"),
            (Preset::Kinds, "52909a90f809ec5a27e1e879ec00df4dd870ddb79d2767371d5af02b4ceb7fdc"),
        ];
        for (preset, digest) in before {
            let mut found = Sha256::new();
            for id in 0..10 {
                let scene = Scene::generate(preset, 1, id);
                found.update(serde_json::to_string(&scene.bodies).unwrap());
                found.update(serde_json::to_string(&scene.attractor).unwrap());
            }
            assert_eq!(format!("{:x}", found.finalize()), digest, "{preset}");
        }
    }

    #[test]
    fn scenes_with_the_same_bodies_differ_in_their_velocities_only() {
        let extent = Extent::usual(Preset::Fluid).with_same_bodies();
        let scenes: Vec<Scene> = (0..4).map(|id| Scene::generate_in(&extent, 1, id)).collect();
        let still = |scene: &Scene| -> Vec<Body> {
            let bodies = scene.bodies.iter();
            bodies.map(|body| Body { velocity: [0.0; 2], ..body.clone() }).collect()
        };
        assert!(scenes.iter().all(|scene| still(scene) == still(&scenes[0])));
        assert!(scenes.windows(2).all(|pair| pair[0].bodies != pair[1].bodies));
        assert_eq!(still(&scenes[0]), still(&Scene::generate(Preset::Fluid, 1, 0)));
    }

    /// Checks the number of particles, their distances, the walls of a domain of this width, and that bodies do not
    /// overlap.
    fn assert_sound(scene: &Scene, particles: usize, width: f32) {
        let (id, dx, domain) = (scene.id, scene.cell_width, scene.domain);
        assert_eq!(domain, [width, 1.0], "{particles}: {id}");
        // Rejects overlapping bodies.
        let found = scene.particles().unwrap();
        assert_eq!(found.len(), particles, "{id}");
        let positions: Vec<[f32; 2]> = found.iter().map(|p| p.position).collect();
        let free = |x: f32, side: f32| (3.0 * dx..=side - 3.0 * dx).contains(&x);
        assert!(positions.iter().all(|p| free(p[0], width) && free(p[1], 1.0)), "{id}");
        let nearest = nearest_neighbours(&positions);
        assert!(nearest > 0.999 * scene.spacing(), "{particles}: {id}: {nearest}");
    }

    #[test]
    fn every_scene_has_2500_particles_a_spacing_apart_inside_the_walls() {
        for (preset, id) in PRESETS.into_iter().flat_map(|p| (0..100).map(move |id| (p, id))) {
            assert_sound(&Scene::generate(preset, 1, id), PARTICLES, 1.0);
        }
    }

    #[test]
    fn scenes_of_other_sizes_have_their_particles_a_spacing_apart_in_a_wider_domain() {
        for (particles, width, scenes) in
            [(250, 1.0, 40), (1000, 1.0, 40), (10_000, 4.0, 10), (100_000, 40.0, 5)]
        {
            for preset in PRESETS {
                let extent = Extent::of(preset, particles).unwrap();
                for id in 0..scenes {
                    let scene = Scene::generate_in(&extent, 1, id);
                    assert_eq!(scene, Scene::generate_in(&extent, 1, id));
                    assert_sound(&scene, particles, width);
                }
            }
        }
    }

    #[test]
    fn scenes_of_a_random_fill_have_it_in_the_usual_domain() {
        for preset in PRESETS {
            let [low, high] = [0.05, 0.4];
            let of = |range| Extent::usual(preset).with_fill(range).unwrap();
            // The fullest that is allowed ends, too.
            (0..20).for_each(|id| drop(Scene::generate_in(&of([0.15, high]), 1, id)));
            let extent = of([low, high]);
            let fills: Vec<f32> = (0..60)
                .map(|id| {
                    let scene = Scene::generate_in(&extent, 1, id);
                    assert_eq!(scene, Scene::generate_in(&extent, 1, id));
                    let particles = scene.bodies.iter().filter_map(|body| body.particles).sum();
                    assert_sound(&scene, particles, 1.0);
                    particles as f32 * scene.spacing().powi(2)
                })
                .collect();
            assert!(fills.iter().all(|fill| (0.99 * low..high).contains(fill)), "{fills:?}");
            // Twenty each if the fill of every scene fitted.
            for part in [0.05..0.165, 0.165..0.28, 0.28..0.4] {
                let count = fills.iter().filter(|fill| part.contains(*fill)).count();
                assert!(count >= 3, "{preset}: {count} in {part:?}");
            }
        }
    }

    #[test]
    fn bodies_of_wide_scenes_have_the_usual_sizes_and_fill_the_width() {
        let of = |particles| Extent::of(Preset::Kinds, particles).unwrap();
        let largest = |scenes: &[Scene]| {
            scenes.iter().flat_map(|scene| &scene.bodies).filter_map(|body| body.particles).max()
        };
        let usual: Vec<Scene> = (0..40).map(|id| Scene::generate(Preset::Kinds, 1, id)).collect();
        let wide: Vec<Scene> = (0..5).map(|id| Scene::generate_in(&of(100_000), 1, id)).collect();
        assert_eq!(largest(&wide), largest(&usual));
        for scene in &wide {
            let mut middles: Vec<f32> = scene.bodies.iter().map(|body| body.position[0]).collect();
            middles.sort_by(f32::total_cmp);
            assert!(middles.windows(2).all(|pair| pair[1] - pair[0] < 2.0), "{middles:?}");
            assert!(middles[0] < 1.0 && middles[middles.len() - 1] > 39.0, "{middles:?}");
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

    /// The pairs of materials in a scene, including a material with itself.
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
        assert!(scenes.windows(3).all(|neighbours| fewest(neighbours) == KINDS_ALONE.len()));
    }

    #[test]
    fn kinds_are_each_material_alone_and_then_a_mix_in_turn() {
        for id in 0..40 {
            let found = Scene::generate(Preset::Kinds, 1, id).materials();
            match KINDS_ALONE.get(id as usize % KINDS) {
                Some(&alone) => assert_eq!(found, [alone], "{id}"),
                None => assert_eq!(found.len(), 2, "{id}: {found:?}"),
            }
        }
    }

    #[test]
    fn scenes_of_sand_have_it_alone_and_beside_each_other_material_in_turn() {
        let found: Vec<_> =
            (0..8).map(|id| Scene::generate(Preset::Sand, 1, id).materials()).collect();
        for (id, materials) in found.iter().enumerate() {
            let other = KINDS_ALONE[id / 2];
            let expected = if id % 2 == 0 { vec![Sand] } else { vec![other, Sand] };
            assert_eq!(*materials, expected, "{id}");
        }
    }

    #[test]
    fn the_logarithm_of_a_random_stiffness_is_uniform_and_changes_nothing_else() {
        let extent = Extent::usual(Preset::Kinds);
        let [plain, varied] = [extent, extent.with_stiffness([1e2, 1e6]).unwrap()].map(|extent| {
            (0..200).map(|id| Scene::generate_in(&extent, 7, id)).collect::<Vec<_>>()
        });
        let mut quarters = [0; 4];
        for (mut varied, plain) in varied.into_iter().zip(plain) {
            let decade = varied.materials.stiffness.log10();
            assert!((2.0..=6.0).contains(&decade), "{decade}");
            quarters[((decade - 2.0) as usize).min(3)] += 1;
            varied.materials.stiffness = plain.materials.stiffness;
            assert_eq!(varied, plain);
        }
        // Each has 50 of 200 with a standard deviation of 6.
        assert!(quarters.iter().all(|count| (25..=75).contains(count)), "{quarters:?}");
    }

    #[test]
    fn a_range_of_stiffness_is_positive_and_increases() {
        for range in [[0.0, 1.0], [-1.0, 1.0], [2.0, 2.0], [2.0, 1.0], [1.0, 2e9], [f32::NAN, 1.0]]
        {
            let error = Extent::usual(Preset::Kinds).with_stiffness(range).unwrap_err();
            assert!(error.to_string().starts_with("stiffness: found "), "{error}");
        }
    }

    #[test]
    fn stiff_scenes_are_the_multi_material_ones_with_another_stiffness() {
        let [soft, stiff] =
            [Preset::MultiMaterial, Preset::Stiff].map(|preset| Scene::generate(preset, 1, 7));
        assert_eq!(stiff.bodies, soft.bodies);
        assert_eq!((soft.materials.stiffness, stiff.materials.stiffness), (1e3, 1e5));
    }

    #[test]
    fn ropes_are_at_least_two_cells_thick_and_longer_than_thick() {
        for (particles, id) in
            [250, 1000, 2500].into_iter().flat_map(|n| (0..40).map(move |id| (n, id)))
        {
            let extent = Extent::of(Preset::MultiMaterial, particles).unwrap();
            for body in Scene::generate_in(&extent, 1, id).bodies {
                if let (Rope, shape) = (body.material, body.shape) {
                    let Shape::Rectangle { size } = shape else { panic!("a rope is a {shape:?}") };
                    let [length, thickness] = size.map(|side| side * 64.0);
                    assert!(thickness >= 2.0 && length >= 3.0 * thickness, "{size:?}");
                }
            }
        }
    }

    #[test]
    fn about_half_of_the_scenes_have_an_attractor() {
        let pulled = (0..100)
            .filter(|&id| Scene::generate(Preset::Fluid, 1, id).attractor.is_some())
            .count();
        assert!((30..=70).contains(&pulled), "{pulled} of 100");
    }
}
