//! The scenes of `eddy demo --scene push`: a blade among bodies.

use eddy_mpm::{Contact, Keyframe, MpmError, Outline, Pose, Preset, Scene, Simulation, Tool};
use eddy_node::viewer::ToolTarget;

/// Width and height of the blade (domain lengths).
const BLADE: [f32; 2] = [0.02, 0.26];
/// Its coefficient of friction.
const FRICTION: f32 = 0.3;
/// Corners of the region in which its middle stays, so that matter escapes from between blade and walls (domain lengths).
const REACH: [[f32; 2]; 2] = [[0.1, 0.21], [0.9, 0.95]];
/// Its greatest speed when it is moved by hand (domain lengths per s).
const SPEED: f32 = 0.9;
/// Its way until it is moved by hand: times (s) and places (domain lengths).
const WAY: [(f64, [f32; 2]); 6] = [
    (0.0, [0.1, 0.8]),
    (0.6, [0.1, 0.8]),
    (1.4, [0.1, 0.21]),
    (3.0, [0.65, 0.21]),
    (3.8, [0.65, 0.75]),
    (5.0, [0.1, 0.8]),
];

/// The first scene from `id` on with bodies beside the blade.
pub(super) fn scene(seed: u64, id: u64) -> Scene {
    let keyframe =
        |&(time, position): &(f64, [f32; 2])| Keyframe { time, position, angle_degrees: 0.0 };
    let blade = Tool {
        name: "blade".into(),
        shape: Outline::Rectangle { size: BLADE },
        contact: Contact::Friction(FRICTION),
        keyframes: WAY.iter().map(keyframe).collect(),
    };
    let with_blade = |from| Scene {
        id,
        attractor: None,
        tools: vec![blade.clone()],
        ..Scene::generate(Preset::MultiMaterial, seed, from)
    };
    let mut scenes = (id..).map(with_blade);
    // About half of all scenes leave the corner free.
    scenes.find(|scene| scene.particles().is_ok()).unwrap_or_else(|| with_blade(id))
}

/// Moves the blade towards the place that the page wants, if it has named one: as far as it comes in a frame.
///
/// # Errors
/// As [`Simulation::move_tools`].
pub(super) fn follow(target: &ToolTarget, simulation: &mut Simulation) -> Result<(), MpmError> {
    let (Some(wanted), [pose]) = (target.position(), &simulation.poses()[..]) else {
        return Ok(());
    };
    let [lower, upper] = REACH;
    let way = [0, 1].map(|k| wanted[k].clamp(lower[k], upper[k]) - pose.position[k]);
    let most = SPEED * simulation.scene().frames.interval;
    let share = f32::min(1.0, most / way[0].hypot(way[1]).max(f32::MIN_POSITIVE));
    let position = [0, 1].map(|k| pose.position[k] + share * way[k]);
    simulation.move_tools(&[Pose { position, ..*pose }])
}

#[cfg(test)]
mod tests {
    use super::*;
    use eddy_mpm::Settings;

    #[test]
    fn the_blade_follows_at_its_speed_and_stays_in_its_region() {
        let scene = scene(3, 4);
        assert_eq!(scene.id, 4);
        let mut simulation = Simulation::new(scene, &Settings::default()).unwrap();
        let target = ToolTarget::default();
        simulation.next_frame().unwrap();
        let start = simulation.poses()[0].position;
        follow(&target, &mut simulation).unwrap();
        simulation.next_frame().unwrap();
        assert_eq!(simulation.poses()[0].position, start, "it waits");
        target.set([0.5, 9.0]);
        for _ in 0..5 {
            let before = simulation.poses()[0].position;
            follow(&target, &mut simulation).unwrap();
            simulation.next_frame().unwrap();
            let after = simulation.poses()[0].position;
            let speed = (after[0] - before[0]).hypot(after[1] - before[1]) / 0.016;
            assert!((speed - SPEED).abs() < 1e-3, "{speed}");
        }
        for _ in 0..60 {
            follow(&target, &mut simulation).unwrap();
            simulation.next_frame().unwrap();
        }
        let [x, y] = simulation.poses()[0].position;
        assert!((x - 0.5).abs() < 1e-5 && (y - REACH[1][1]).abs() < 1e-5, "[{x}, {y}]");
    }
}
