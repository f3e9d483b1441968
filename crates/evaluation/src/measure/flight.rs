//! Bodies in free flight: without contact a body gains g dt per frame and keeps its spin.

use std::collections::HashMap;

use super::{Mean, bulk::mean};
use crate::errors::square;
use eddy_dataset::Stream;
use eddy_frames::State;
use eddy_inference::engine::Ballistic;

/// Minimum width of the empty strip around a body (spacings).
const GAP: f32 = 16.0;
/// Minimum distance of a body in flight from the walls (spacings).
const WALL_GAP: f32 = 8.0;
/// Minimum number of particles of a body; fewer are spray.
const MIN_PARTICLES: usize = 100;

/// A body in free flight in the truth, from one frame to the next.
#[derive(Clone, Debug)]
struct Body {
    particles: Vec<u32>,
    /// Momentum per mass in the first frame (domain lengths per second).
    momentum: [f64; 2],
    /// Angular momentum per mass about the centre of mass (domain lengths^2 per second).
    spin: f64,
    /// Mean squared distance from the centre of mass (domain lengths^2).
    inertia: f64,
}

/// All free flight in a stream.
#[derive(Clone, Debug, Default)]
pub(crate) struct Flights {
    /// Frames with bodies in flight, and the bodies.
    bodies: Vec<(usize, Vec<Body>)>,
    gravity: [f64; 2],
    dt: f64,
}

/// Errors of one-step predictions of bodies in free flight.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FlightSums {
    /// Momentum per mass gained per frame in excess of gravity (g dt).
    pub gain: Mean,
    /// Maximum of these gains.
    pub worst_gain: f64,
    /// Squared change of the spin per frame (rad^2 per s^2).
    pub spin: Mean,
}

impl FlightSums {
    /// Adds other sums.
    pub fn merge(&mut self, other: &Self) {
        self.gain.merge(&other.gain);
        self.worst_gain = self.worst_gain.max(other.worst_gain);
        self.spin.merge(&other.spin);
    }
}

impl Flights {
    /// Finds bodies that are isolated in a frame and in the next one.
    pub(crate) fn of(stream: &Stream, ballistic: &Ballistic, spacing: f32) -> Self {
        let gap = GAP * spacing;
        let mut found = Vec::new();
        let mut next = stream.states.first().map(|state| sets(&state.position, gap));
        for (index, pair) in stream.states.windows(2).enumerate() {
            let [state, after] = pair else { continue };
            let Some(now) = next.replace(sets(&after.position, gap)) else { continue };
            let then = next.as_deref().unwrap_or_default();
            let in_flight = |particles: &Vec<u32>| {
                particles.len() >= MIN_PARTICLES
                    && off_the_walls(particles, state, ballistic, spacing)
                    && off_the_walls(particles, after, ballistic, spacing)
                    && is_whole(particles, then, state.position.len())
            };
            let body = |particles: Vec<u32>| {
                let (momentum, spin, inertia) =
                    motion(&particles, &state.position, &state.velocity);
                Body { particles, momentum, spin, inertia }
            };
            let bodies: Vec<Body> = now.into_iter().filter(in_flight).map(body).collect();
            if !bodies.is_empty() {
                found.push((index, bodies));
            }
        }
        let (gravity, dt) = (ballistic.gravity.map(f64::from), f64::from(ballistic.dt));
        Self { bodies: found, gravity, dt }
    }

    /// The frames with bodies in flight.
    pub(crate) fn frames(&self) -> impl Iterator<Item = usize> {
        self.bodies.iter().map(|(index, _)| *index)
    }

    /// Adds the errors of a prediction made from frame `index`, over the bodies in flight there. Without gravity there
    /// is no unit and nothing is added. NaN counts as infinite.
    pub(crate) fn add(
        &self,
        index: usize,
        position: &[[f32; 2]],
        velocity: &[[f32; 2]],
        sums: &mut FlightSums,
    ) {
        let unit = square(self.gravity).sqrt() * self.dt;
        let Ok(at) = self.bodies.binary_search_by_key(&index, |(index, _)| *index) else { return };
        if unit == 0.0 {
            return;
        }
        for body in &self.bodies[at].1 {
            let (momentum, spin, _) = motion(&body.particles, position, velocity);
            let excess = [0, 1]
                .map(|axis| momentum[axis] - body.momentum[axis] - self.gravity[axis] * self.dt);
            let gain = or_infinite(square(excess).sqrt() / unit);
            sums.gain.add(gain, 1.0);
            sums.worst_gain = sums.worst_gain.max(gain);
            if body.inertia > 0.0 {
                let change = (spin - body.spin) / body.inertia;
                sums.spin.add(or_infinite(change * change), 1.0);
            }
        }
    }
}

/// `f64::max` ignores NaN, which must not hide a failure.
fn or_infinite(number: f64) -> f64 {
    if number.is_nan() { f64::INFINITY } else { number }
}

/// Momentum, angular momentum about the centre of mass, and moment of inertia, all per mass.
fn motion(particles: &[u32], position: &[[f32; 2]], velocity: &[[f32; 2]]) -> ([f64; 2], f64, f64) {
    let of = |rows: &[[f32; 2]]| mean(particles.iter().map(|&k| &rows[k as usize]));
    let (centre, momentum) = (of(position), of(velocity));
    let (mut spin, mut inertia) = (0.0, 0.0);
    for &k in particles {
        let [x, y] = position[k as usize].map(f64::from);
        let [u, v] = velocity[k as usize].map(f64::from);
        let r = [x - centre[0], y - centre[1]];
        spin += r[0] * (v - momentum[1]) - r[1] * (u - momentum[0]);
        inertia += square(r);
    }
    let count = particles.len() as f64;
    (momentum, spin / count, inertia / count)
}

/// Partitions the particles into sets at least `gap` (domain lengths) apart, by flood fill over cells of that width.
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

/// Whether no set contains both some of these particles and others.
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
    use eddy_frames::{Domain, Material, Stamp};

    const SPACING: f32 = 1.0 / 128.0;
    const BALLISTIC: Ballistic =
        Ballistic { gravity: [0.0, -10.0], dt: 0.01, lower: [0.0; 2], upper: [1.0; 2] };

    /// A rotating block of 12 x 12 particles around `centre`.
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

    /// Ten frames of a block that falls from `[x, y]` and another at rest on the floor.
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
            stiffness: None,
            tools: None,
            states: states.collect(),
        }
    }

    fn flights(stream: &Stream) -> Flights {
        Flights::of(stream, &BALLISTIC, SPACING)
    }

    #[test]
    fn a_falling_body_is_in_flight_and_one_on_the_floor_is_not() {
        let found = flights(&stream([0.3, 0.5]));
        assert_eq!(found.frames().collect::<Vec<_>>(), (0..9).collect::<Vec<_>>());
        for (_, bodies) in found.bodies {
            assert_eq!(bodies.iter().map(|b| b.particles.len()).collect::<Vec<_>>(), [144]);
        }
    }

    #[test]
    fn a_body_near_another_is_not_in_flight() {
        assert_eq!(flights(&stream([0.7, 0.2])).frames().count(), 0);
    }

    #[test]
    fn the_truth_gains_nothing_and_a_push_is_measured() {
        let stream = stream([0.3, 0.5]);
        let flights = flights(&stream);
        let truth = &stream.states[6];
        let mut sums = FlightSums::default();
        flights.add(5, &truth.position, &truth.velocity, &mut sums);
        assert_eq!(sums.gain.weight, 1.0);
        assert!(sums.worst_gain < 1e-5 && sums.spin.value() < 1e-8, "{sums:?}");

        // 0.01 is a tenth of g dt; the rotation is lost.
        let pushed: Vec<[f32; 2]> = vec![[0.01, -0.6]; 288];
        let mut sums = FlightSums::default();
        flights.add(5, &truth.position, &pushed, &mut sums);
        assert!((sums.gain.value() - 0.1).abs() < 1e-5, "{sums:?}");
        assert!((sums.spin.value().sqrt() - 2.0).abs() < 1e-4, "{sums:?}");
        let lost = vec![[f32::NAN; 2]; 288];
        let mut infinite = FlightSums::default();
        flights.add(5, &truth.position, &lost, &mut infinite);
        assert_eq!(infinite.worst_gain, f64::INFINITY);
        assert_eq!([infinite.gain.value(), infinite.spin.value()], [f64::INFINITY; 2]);

        flights.add(9, &truth.position, &pushed, &mut sums);
        assert_eq!(sums.gain.weight, 1.0, "the flight has no next frame");
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
