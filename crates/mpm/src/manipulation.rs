//! Random scenes in which a tool moves matter: a blade pushes it, a cup pours it, a bucket scoops it.
//!
//! Tools are where matter cannot be squeezed beyond its laws: the way of a blade ends before the far wall, a cup turns where its whole
//! outline stays in the domain, a bucket stays above the floor.

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::{
    body::Body,
    extent::Extent,
    grid::WALL_CELLS,
    preset::{PARTICLES, Preset},
    scene::Scene,
    shape::Shape,
    tool::{Contact, Keyframe, Outline, Tool},
};
use eddy_frames::Material;

/// Materials of the scenes with tools, by `id`; a bucket does not cut jelly.
const MATTER: [Material; 4] = [Material::Sand, Material::Liquid, Material::Snow, Material::Jelly];
/// Friction of sand at the walls of the domain, without which every heap slides apart.
const WALL_FRICTION: f32 = 0.6;
/// Range of the thickness of blades and of the walls of cups and buckets (cells).
const THICKNESS: [f32; 2] = [0.47, 2.0];
/// Range of the coefficients of friction of tools.
const FRICTION: [f32; 2] = [0.1, 0.7];
/// Room between matter and tools at the start (spacings).
const ROOM: f32 = 1.5;
/// Range of the time before a tool moves (s).
const WAIT: [f64; 2] = [0.1, 0.4];

/// The scene `id` of a preset with tools, of random numbers of its own.
///
/// Nearly every draw is possible; one that is not is drawn again.
pub(super) fn generate(extent: &Extent, id: u64, rng: &mut ChaCha8Rng) -> Scene {
    loop {
        let scene = draw(extent, id, rng);
        if scene.particles().is_ok() {
            return scene;
        }
    }
}

fn draw(extent: &Extent, id: u64, rng: &mut ChaCha8Rng) -> Scene {
    let preset = extent.preset();
    let materials = if preset == Preset::Scoop { &MATTER[..3] } else { &MATTER[..] };
    let material = materials[id as usize % materials.len()];
    let stage = Stage {
        material,
        particles: extent.particles(),
        spacing: preset.spacing(),
        floor: WALL_CELLS as f32 * preset.dx(),
        thickness: preset.dx() * within(THICKNESS, rng),
    };
    let (bodies, name, shape, path) = match preset {
        Preset::Push => stage.push(rng),
        Preset::Pour => stage.pour(rng),
        _ => stage.scoop(rng),
    };
    let contact = match rng.random_range(0..4) {
        0 => Contact::Slip,
        1 if preset == Preset::Push => Contact::Sticky,
        _ => Contact::Friction(within(FRICTION, rng)),
    };
    let mirrored = rng.random_bool(0.5);
    let tool = Tool { name: name.into(), shape, contact, keyframes: path.0 };
    let mut scene = Scene { id, bodies, tools: vec![tool], ..preset.empty_scene() };
    if material == Material::Sand {
        scene.materials.wall_friction = WALL_FRICTION;
    }
    if mirrored { mirror(scene) } else { scene }
}

/// The scene seen from the other side. Bodies and outlines are symmetric.
fn mirror(mut scene: Scene) -> Scene {
    let width = scene.domain[0];
    for body in &mut scene.bodies {
        body.position[0] = width - body.position[0];
    }
    for keyframe in scene.tools.iter_mut().flat_map(|tool| &mut tool.keyframes) {
        keyframe.position[0] = width - keyframe.position[0];
        keyframe.angle_degrees = 0.0 - keyframe.angle_degrees;
    }
    scene
}

/// Bodies, a tool's name, its outline and its path.
type Draw = (Vec<Body>, &'static str, Outline, Path);

/// What a scene is drawn for.
struct Stage {
    material: Material,
    particles: usize,
    /// Particle spacing (domain lengths, like the others).
    spacing: f32,
    /// Height of the floor.
    floor: f32,
    /// Thickness of blade or walls.
    thickness: f32,
}

impl Stage {
    /// A heap, and a blade that pushes it once or twice and is lifted.
    fn push(&self, rng: &mut ChaCha8Rng) -> Draw {
        let is_solid = matches!(self.material, Material::Snow | Material::Jelly);
        let aspect = within(if is_solid { [0.8, 1.4] } else { [1.2, 3.5] }, rng);
        let heap = self.block(self.particles, aspect);
        let [width, height] = size(&heap);
        let blade = [self.thickness, self.scale() * within([0.2, 0.4], rng)];
        let tilt: f32 = within([-20.0, 20.0], rng);
        // Beside the blade, and not further than the far wall.
        let beside = self.floor + 0.5 * width + 2.0 * ROOM * self.spacing;
        let left = self.floor + 0.25 * blade[1] + blade[0] + 4.0 * self.spacing;
        let latest = 1.0 - beside;
        let heap_x = within([left + beside, latest.min(left + beside + 0.1)], rng);
        let heap = self.on_floor(heap, heap_x);
        let lean = 0.5 * blade[1] * libm::sinf(tilt.to_radians().abs());
        let start_x = heap_x - 0.5 * width - lean - 0.5 * blade[0] - 2.0 * ROOM * self.spacing;
        let low = self.floor + 0.5 * blade[1] + self.spacing * within([1.0, 5.0], rng);
        let high = low.max(self.floor + height + 0.5 * blade[1]) + within([0.0, 0.1], rng);
        // What flows may rise to twice its height.
        let room = if is_solid { 0.95 * width } else { (0.5 * width).max(0.3) };
        let end_x = 1.0 - self.floor - room - within([0.0, 0.15], rng);
        let mut path = Path::at([start_x, high], tilt, rng);
        path.line([start_x, low], tilt, within([0.5, 1.5], rng));
        path.line([end_x.max(start_x + 0.1), low], tilt, within([0.2, 0.8], rng));
        if rng.random_bool(0.5) {
            path.line([end_x.max(start_x + 0.1) - 0.05, high], within([-40.0, 40.0], rng), 0.6);
        } else {
            let back = within([start_x, 0.5 * (start_x + end_x)], rng);
            path.line([back, low], tilt, within([0.2, 0.8], rng));
            path.line([back, high], tilt, 0.6);
        }
        (vec![heap], "blade", Outline::Rectangle { size: blade }, path)
    }

    /// A full cup that is carried over a bed and tipped.
    fn pour(&self, rng: &mut ChaCha8Rng) -> Draw {
        let held = (within([0.3, 0.45], rng) * self.particles as f32) as usize;
        let mut load = self.block(held, within([0.7, 1.2], rng));
        let bed = self.block(self.particles - held, within([2.5, 6.0], rng));
        let [_, top] = size(&bed);
        let [width, height] = size(&load);
        let inside = [width + 2.0 * ROOM * self.spacing, height / within([0.6, 0.85], rng)];
        let reach = 0.5 * libm::hypotf(inside[0], inside[1]) + 2.0 * self.thickness;
        let [lowest, highest] = [self.floor + top + reach, 1.0 - self.floor - reach];
        let [leftmost, rightmost] = [self.floor + reach, 1.0 - self.floor - reach];
        let start = [within([leftmost, 0.5], rng), within([lowest.min(highest), highest], rng)];
        let bottom = start[1] - 0.5 * inside[1];
        load.position = [start[0], bottom + 0.5 * height + ROOM * self.spacing];
        let end = [within([start[0], rightmost], rng), within([lowest.min(highest), highest], rng)];
        let tipped = within([-150.0, -95.0], rng);
        let mut path = Path::at(start, 0.0, rng);
        path.line(end, 0.0, within([0.3, 0.8], rng));
        path.turn(tipped, within([90.0, 250.0], rng));
        path.rest(within([0.2, 0.8], rng));
        path.turn(within([-90.0, 0.0], rng), within([90.0, 250.0], rng));
        let bed_x = within([0.5 * size(&bed)[0] + self.floor, 0.9], rng);
        let bed = self.on_floor(bed, bed_x);
        (vec![load, bed], "cup", self.cup(inside), path)
    }

    /// A bed, and a bucket that digs into it, is lifted and emptied.
    fn scoop(&self, rng: &mut ChaCha8Rng) -> Draw {
        let bed = self.block(self.particles, within([3.5, 5.5], rng));
        let [width, depth] = size(&bed);
        let bed = self.on_floor(bed, 0.5);
        let scale = self.scale();
        let inside = [scale * within([0.16, 0.24], rng), scale * within([0.1, 0.16], rng)];
        let reach = 0.5 * libm::hypotf(inside[0], inside[1]) + 2.0 * self.thickness;
        // The mouth faces to the right.
        let (dig, carry) = (within([-85.0, -55.0], rng), within([-10.0, 15.0], rng));
        let left = self.floor + reach.max(0.5 - 0.5 * width);
        let begin = within([left, left + 0.08], rng);
        let end = (begin + within([0.25, 0.45], rng)).min(1.0 - left);
        let above = self.floor + depth + reach + 2.0 * self.spacing;
        // Its lowest point is in the lower half of the bed when that has spread over the floor.
        let (sin, cos) = libm::sincosf(f32::to_radians(dig));
        let below = (0.5 * inside[0] + self.thickness) * sin.abs()
            + (0.5 * inside[1] + self.thickness) * cos.abs();
        let spread = self.particles as f32 * self.spacing.powi(2) / (1.0 - 2.0 * self.floor);
        let deep = (spread * within([0.1, 0.5], rng)).max(2.0 * self.spacing);
        let low = self.floor + below + deep;
        let lifted = above + within([0.1, 0.25], rng);
        let mut path = Path::at([begin, above], dig, rng);
        let speed = within([0.25, 0.6], rng);
        path.line([begin, low.min(above)], dig, speed);
        path.line([end, low.min(above)], dig, speed);
        path.line([end, above], carry, speed);
        let away = within([left, 1.0 - left], rng);
        path.line([away, lifted.min(1.0 - self.floor - reach)], carry, 0.5);
        path.turn(within([100.0, 150.0], rng), within([120.0, 250.0], rng));
        (vec![bed], "bucket", self.cup(inside), path)
    }

    /// By how much lengths are smaller than with 2,500 particles.
    fn scale(&self) -> f32 {
        (self.particles as f32 / PARTICLES as f32).sqrt()
    }

    /// A block of so many particles, about `aspect` times as wide as high, and no wider than the domain.
    fn block(&self, particles: usize, aspect: f32) -> Body {
        let widest = (1.0 - 2.0 * self.floor) / self.spacing - 2.0;
        let columns = ((particles as f32 * aspect).sqrt().min(widest) as usize).max(1);
        let size = [columns, particles.div_ceil(columns)].map(|count| count as f32 * self.spacing);
        Body {
            material: self.material,
            shape: Shape::Rectangle { size },
            position: [0.5; 2],
            angle_degrees: 0.0,
            velocity: [0.0; 2],
            particles: Some(particles),
        }
    }

    /// The body on the floor with its middle there, or as near as the walls are.
    fn on_floor(&self, body: Body, x: f32) -> Body {
        let [width, height] = size(&body);
        let aside = self.floor + 0.5 * width;
        let x = x.clamp(aside.min(0.5), (1.0 - aside).max(0.5));
        Body { position: [x, self.floor + 0.5 * height], ..body }
    }

    /// Floor and walls around this width and height, open at the top.
    fn cup(&self, [width, height]: [f32; 2]) -> Outline {
        let (x, y, wall) = (0.5 * width, 0.5 * height, self.thickness);
        let rectangle = |[left, low]: [f32; 2], [right, top]: [f32; 2]| {
            vec![[left, low], [right, low], [right, top], [left, top]]
        };
        let corners = vec![
            rectangle([-x - wall, -y - wall], [x + wall, -y]),
            rectangle([-x - wall, -y - wall], [-x, y]),
            rectangle([x, -y - wall], [x + wall, y]),
        ];
        Outline::Polygons { corners }
    }
}

/// Width and height of a block.
fn size(body: &Body) -> [f32; 2] {
    match body.shape {
        Shape::Rectangle { size } => size,
        _ => unreachable!("blocks are rectangles"),
    }
}

/// A random number of a range; its beginning if the range is empty.
fn within<T: rand::distr::uniform::SampleUniform + PartialOrd + Copy>(
    [low, high]: [T; 2],
    rng: &mut ChaCha8Rng,
) -> T {
    if low < high { rng.random_range(low..high) } else { low }
}

/// Keyframes so far.
struct Path(Vec<Keyframe>);

impl Path {
    /// A tool that rests there for a while.
    fn at(position: [f32; 2], angle_degrees: f32, rng: &mut ChaCha8Rng) -> Self {
        let mut path = Self(vec![Keyframe { time: 0.0, position, angle_degrees }]);
        path.rest(within(WAIT, rng));
        path
    }

    fn last(&self) -> Keyframe {
        self.0[self.0.len() - 1]
    }

    /// Moves on to a pose at a speed (domain lengths per s), turning on the way.
    fn line(&mut self, position: [f32; 2], angle_degrees: f32, speed: f32) {
        let last = self.last();
        let [x, y] = [0, 1].map(|k| position[k] - last.position[k]);
        let way = libm::hypotf(x, y);
        // Not faster than half a turn per second, and never at once.
        let seconds = (way / speed).max((angle_degrees - last.angle_degrees).abs() / 180.0);
        let time = last.time + f64::from(seconds.max(0.01));
        self.0.push(Keyframe { time, position, angle_degrees });
    }

    /// Turns to an angle at a speed (degrees per s).
    fn turn(&mut self, angle_degrees: f32, speed: f32) {
        let last = self.last();
        let seconds = ((angle_degrees - last.angle_degrees).abs() / speed).max(0.01);
        self.0.push(Keyframe { time: last.time + f64::from(seconds), angle_degrees, ..last });
    }

    /// Stays for some time (s).
    fn rest(&mut self, seconds: f64) {
        let last = self.last();
        self.0.push(Keyframe { time: last.time + seconds, ..last });
    }
}

#[cfg(test)]
mod tests {
    use rayon::prelude::*;

    use super::*;
    use crate::{Settings, Simulation};

    const WITH_TOOLS: [Preset; 3] = [Preset::Push, Preset::Pour, Preset::Scoop];

    #[test]
    fn the_same_seed_and_id_give_the_same_scene_and_others_another() {
        for preset in WITH_TOOLS {
            let scene = Scene::generate(preset, 1, 3);
            assert_eq!(scene, Scene::generate(preset, 1, 3));
            for other in [Scene::generate(preset, 1, 15), Scene::generate(preset, 2, 3)] {
                assert_ne!(scene.bodies, other.bodies);
                assert_ne!(scene.tools, other.tools);
            }
        }
    }

    #[test]
    fn scenes_have_their_number_of_particles_and_each_material_in_turn() {
        for (preset, particles) in WITH_TOOLS.map(|preset| (preset, [250, 1000, 2500])) {
            for particles in particles {
                let extent = Extent::of(preset, particles).unwrap();
                for id in 0..40 {
                    let scene = Scene::generate_in(&extent, 1, id);
                    assert_eq!(scene.particles().unwrap().len(), particles);
                    let turns = if preset == Preset::Scoop { 3 } else { 4 };
                    assert_eq!(scene.materials(), [MATTER[id as usize % turns]]);
                }
            }
        }
    }

    #[test]
    fn tools_move_matter_and_no_scene_ends_early() {
        let scenes: Vec<(Preset, u64)> =
            WITH_TOOLS.into_iter().flat_map(|preset| (0..8).map(move |id| (preset, id))).collect();
        scenes.into_par_iter().for_each(|(preset, id)| {
            let extent = Extent::of(preset, 400).unwrap();
            let scene = Scene::generate_in(&extent, 7, id);
            let mut simulation = Simulation::new(scene, &Settings::default()).unwrap();
            let (mut frames, mut work) = (0, 0.0);
            let next = |simulation: &mut Simulation| match simulation.next_frame() {
                Ok(frame) => frame,
                Err(error) => panic!("{preset} {id}: {error}"),
            };
            while let Some(frame) = next(&mut simulation) {
                frames = frame.sequence + 1;
                work += simulation.loads()[0].work.abs();
            }
            assert_eq!(frames, 300, "{preset} {id}");
            assert!(work > 1e-5, "{preset} {id}: work of {work}");
        });
    }
}
