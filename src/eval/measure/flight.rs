//! Bodies in free flight: what has nothing near it falls by g dt a frame and keeps its spin.

use std::collections::HashMap;

use super::{Mean, bulk::mean};
use crate::{
    dataset::{State, Stream},
    eval::errors::square,
    model::Ballistic,
};

/// Bodies have an empty strip of at least so many spacings around them.
const GAP: f32 = 16.0;
/// Distance to walls of a body in flight (spacings).
const WALL_GAP: f32 = 8.0;
/// Fewest particles of a body; less is spray.
const FEWEST: usize = 100;
/// The most frames that a flight is followed.
const LONGEST: usize = 20;

/// A body that is in free flight in the truth.
#[derive(Clone, Debug)]
pub(super) struct Body {
    particles: Vec<u32>,
    /// Frames after the start for which nothing comes near it.
    frames: usize,
    /// Momentum per mass at the start (domain lengths per second).
    momentum: [f64; 2],
    /// Angular momentum per mass at the start, about the centre (domain lengths^2 per second).
    spin: f64,
    /// Mean squared distance to the centre at the start (domain lengths^2).
    inertia: f64,
}

/// The bodies in free flight at frame `start`, each with how long its flight lasts.
pub(super) fn bodies(
    stream: &Stream,
    start: usize,
    ballistic: &Ballistic,
    spacing: f32,
) -> Vec<Body> {
    let state = &stream.states[start];
    let mut bodies = Vec::new();
    for particles in sets(&state.position, GAP * spacing) {
        if particles.len() >= FEWEST && off_the_walls(&particles, state, ballistic, spacing) {
            let (momentum, spin, inertia) = motion(&particles, state);
            bodies.push(Body { particles, frames: 0, momentum, spin, inertia });
        }
    }
    for (ahead, state) in stream.states[start + 1..].iter().take(LONGEST).enumerate() {
        if bodies.iter().all(|body| body.frames < ahead) {
            break;
        }
        let sets = sets(&state.position, GAP * spacing);
        for body in bodies.iter_mut().filter(|body| body.frames == ahead) {
            let alone = is_whole(&body.particles, &sets, state.position.len());
            if alone && off_the_walls(&body.particles, state, ballistic, spacing) {
                body.frames = ahead + 1;
            }
        }
    }
    bodies
}

impl Body {
    /// Adds, if it is still in flight `ahead` frames after the start, the momentum that was gained a
    /// frame beside that of free fall (g dt), and the square of the change of its spin (rad/s).
    pub(super) fn add(
        &self,
        predicted: &State,
        ahead: usize,
        ballistic: &Ballistic,
        (gained, spin): (&mut Mean, &mut Mean),
    ) {
        let fall = ballistic.gravity.map(|g| f64::from(g) * f64::from(ballistic.dt));
        let unit = square(fall).sqrt();
        if ahead > self.frames || unit == 0.0 {
            return;
        }
        let (momentum, now, _) = motion(&self.particles, predicted);
        let frames = ahead as f64;
        let beside = [0, 1].map(|axis| momentum[axis] - self.momentum[axis] - frames * fall[axis]);
        gained.add(square(beside).sqrt() / (frames * unit), 1.0);
        let change = (now - self.spin) / self.inertia;
        spin.add(change * change, 1.0);
    }
}

/// Momentum, angular momentum about the centre, and moment of inertia, all per mass.
fn motion(particles: &[u32], state: &State) -> ([f64; 2], f64, f64) {
    let of = |rows: &[[f32; 2]]| mean(particles.iter().map(|&k| &rows[k as usize]));
    let (centre, momentum) = (of(&state.position), of(&state.velocity));
    let (mut spin, mut inertia) = (0.0, 0.0);
    for &k in particles {
        let [x, y] = state.position[k as usize].map(f64::from);
        let [u, v] = state.velocity[k as usize].map(f64::from);
        let r = [x - centre[0], y - centre[1]];
        spin += r[0] * (v - momentum[1]) - r[1] * (u - momentum[0]);
        inertia += square(r);
    }
    let count = particles.len() as f64;
    (momentum, spin / count, inertia / count)
}

/// The particles in sets with an empty strip of at least `gap` (domain lengths) between any two: cells
/// of that width are flooded from neighbour to neighbour.
fn sets(position: &[[f32; 2]], gap: f32) -> Vec<Vec<u32>> {
    let mut cells: HashMap<[i32; 2], Vec<u32>> = HashMap::new();
    for (k, x) in position.iter().enumerate() {
        cells.entry(x.map(|x| (x / gap).floor() as i32)).or_default().push(k as u32);
    }
    let mut seeds: Vec<[i32; 2]> = cells.keys().copied().collect();
    seeds.sort_unstable();
    let mut sets = Vec::new();
    for seed in seeds {
        let (mut open, mut set) = (vec![seed], Vec::new());
        while let Some([a, b]) = open.pop() {
            let Some(particles) = cells.remove(&[a, b]) else { continue };
            set.extend(particles);
            let around = (-1..=1).flat_map(|da| {
                (-1..=1).map(move |db| [a.saturating_add(da), b.saturating_add(db)])
            });
            open.extend(around.filter(|cell| cells.contains_key(cell)));
        }
        if !set.is_empty() {
            sets.push(set);
        }
    }
    sets
}

/// Whether no set holds some of these particles and others too.
fn is_whole(particles: &[u32], sets: &[Vec<u32>], count: usize) -> bool {
    let mut belongs = vec![false; count];
    particles.iter().for_each(|&k| belongs[k as usize] = true);
    sets.iter().all(|set| {
        let first = set.first().is_some_and(|&k| belongs[k as usize]);
        set.iter().all(|&k| belongs[k as usize] == first)
    })
}

fn off_the_walls(particles: &[u32], state: &State, walls: &Ballistic, spacing: f32) -> bool {
    let gap = WALL_GAP * spacing;
    particles.iter().map(|&k| state.position[k as usize]).all(|x| {
        (0..2).all(|axis| x[axis] > walls.lower[axis] + gap && x[axis] < walls.upper[axis] - gap)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::{Domain, Material, Stamp};

    const SPACING: f32 = 1.0 / 128.0;
    const BALLISTIC: Ballistic =
        Ballistic { gravity: [0.0, -10.0], dt: 0.01, lower: [0.0; 2], upper: [1.0; 2] };

    /// A block of 12 x 12 particles around `centre` that turns and falls.
    fn block(centre: [f32; 2], velocity: [f32; 2], turn: f32) -> State {
        let offset = |n: usize| (n as f32 - 5.5) * SPACING;
        let places: Vec<[f32; 2]> = (0..144).map(|k| [offset(k % 12), offset(k / 12)]).collect();
        State {
            position: places.iter().map(|[x, y]| [centre[0] + x, centre[1] + y]).collect(),
            velocity: places
                .iter()
                .map(|[x, y]| [velocity[0] - turn * y, velocity[1] + turn * x])
                .collect(),
        }
    }

    fn together(states: [State; 2]) -> State {
        let [mut all, other] = states;
        all.position.extend(other.position);
        all.velocity.extend(other.velocity);
        all
    }

    /// One block falls from `[x, y]` for ten frames, the other lies on the floor.
    fn stream([x, y]: [f32; 2]) -> Stream {
        let states = (0..10u8).map(|n| {
            let t = 0.01 * f32::from(n);
            let falling = block([x, y - 5.0 * t * t], [0.0, -10.0 * t], 2.0);
            together([falling, block([0.7, 6.0 * SPACING], [0.0; 2], 0.0)])
        });
        Stream {
            id: 0,
            source: "test".into(),
            dt: 0.01,
            domain: Domain::UNIT,
            material: vec![Material::Jelly; 288],
            first_sequence: 0,
            first_stamp: Stamp(0),
            states: states.collect(),
        }
    }

    #[test]
    fn a_falling_body_flies_and_one_on_the_floor_does_not() {
        let found = bodies(&stream([0.3, 0.5]), 0, &BALLISTIC, SPACING);
        assert_eq!(found.len(), 1);
        assert_eq!((found[0].particles.len(), found[0].frames), (144, 9));
    }

    #[test]
    fn a_body_near_another_does_not_fly() {
        assert!(bodies(&stream([0.7, 0.2]), 0, &BALLISTIC, SPACING).is_empty());
    }

    #[test]
    fn the_truth_gains_nothing_and_what_is_pushed_gains_what_it_was_pushed() {
        let stream = stream([0.3, 0.5]);
        let body = &bodies(&stream, 0, &BALLISTIC, SPACING)[0];
        let measure = |push: f32, turn: f32| {
            let state = together([
                block([0.3, 0.4875], [push, -0.5], turn),
                block([0.7, 6.0 * SPACING], [0.0; 2], 0.0),
            ]);
            let (mut gained, mut spin) = (Mean::default(), Mean::default());
            body.add(&state, 5, &BALLISTIC, (&mut gained, &mut spin));
            assert_eq!(gained.weight, 1.0);
            (gained.value(), spin.value().sqrt())
        };
        let (gained, spin) = measure(0.0, 2.0);
        assert!(gained < 1e-6 && spin < 1e-4, "{gained}, {spin}");
        // 0.05 in five frames are 0.01 a frame, and g dt is 0.1.
        let (gained, spin) = measure(0.05, 1.5);
        assert!((gained - 0.1).abs() < 1e-5 && (spin - 0.5).abs() < 1e-3, "{gained}, {spin}");
    }

    #[test]
    fn sets_are_apart() {
        let position = [[0.05, 0.05], [0.95, 0.05], [0.15, 0.12], [0.55, 0.95]];
        let mut found = sets(&position, 0.1);
        found.iter_mut().for_each(|set| set.sort_unstable());
        assert_eq!(found, [vec![0, 2], vec![3], vec![1]]);
        assert!(is_whole(&[0, 2], &found, 4) && is_whole(&[3, 1], &found, 4));
        assert!(!is_whole(&[0], &found, 4) && !is_whole(&[1, 2], &found, 4));
    }
}
