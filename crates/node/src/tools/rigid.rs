//! Positions and rotations in space, and their motion.

use eddy_messages::{Point, Pose, Quaternion};

/// Rotation vectors below this have no direction (rad).
const NO_TURN: f64 = 1e-12;

/// Where a coordinate frame is in another one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Rigid {
    /// Its origin (domain lengths).
    pub(super) position: [f64; 3],
    /// Its rotation, a quaternion of length 1: x, y, z, w.
    pub(super) rotation: [f64; 4],
}

/// The same with velocities.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Moving {
    pub(super) at: Rigid,
    /// Velocity of its origin (domain lengths per s).
    pub(super) velocity: [f64; 3],
    /// Angular velocity (rad/s).
    pub(super) spin: [f64; 3],
}

impl Rigid {
    /// Of a checked pose.
    pub(super) fn of(pose: &Pose) -> Self {
        let Pose { position: p, orientation: Quaternion { x, y, z, w } } = *pose;
        let length = (x * x + y * y + z * z + w * w).sqrt();
        Self { position: [p.x, p.y, p.z], rotation: [x, y, z, w].map(|part| part / length) }
    }

    /// As a message.
    pub(super) fn pose(&self) -> Pose {
        let ([x, y, z], [qx, qy, qz, qw]) = (self.position, self.rotation);
        let orientation = Quaternion { x: qx, y: qy, z: qz, w: qw };
        Pose { position: Point { x, y, z }, orientation }
    }

    /// At rest.
    pub(super) fn at_rest(self) -> Moving {
        Moving { at: self, velocity: [0.0; 3], spin: [0.0; 3] }
    }

    /// After a share (0 to 1) of a uniform motion that takes so many seconds and turns by at most half a turn.
    pub(super) fn towards(self, end: Self, share: f64, seconds: f64) -> Moving {
        let way: [f64; 3] = std::array::from_fn(|k| end.position[k] - self.position[k]);
        let [x, y, z, w] = self.rotation;
        let turn = rotation_vector(product([-x, -y, -z, w], end.rotation));
        let at = if share < 1.0 {
            Self {
                position: std::array::from_fn(|k| self.position[k] + share * way[k]),
                rotation: product(self.rotation, rotation(turn.map(|part| share * part))),
            }
        } else {
            end
        };
        let [velocity, spin] = [way, rotated(self.rotation, turn)];
        Moving { at, velocity: velocity.map(|x| x / seconds), spin: spin.map(|x| x / seconds) }
    }
}

impl Moving {
    /// What moves so in this frame, which moves itself, as seen from outside.
    pub(super) fn carries(&self, inner: &Self) -> Self {
        let Rigid { position, rotation } = self.at;
        let arm = rotated(rotation, inner.at.position);
        let [swept, own] = [cross(self.spin, arm), rotated(rotation, inner.velocity)];
        let turned = rotated(rotation, inner.spin);
        Self {
            at: Rigid {
                position: std::array::from_fn(|k| position[k] + arm[k]),
                rotation: product(rotation, inner.at.rotation),
            },
            velocity: std::array::from_fn(|k| self.velocity[k] + swept[k] + own[k]),
            spin: std::array::from_fn(|k| self.spin[k] + turned[k]),
        }
    }
}

fn cross([a, b, c]: [f64; 3], [x, y, z]: [f64; 3]) -> [f64; 3] {
    [b * z - c * y, c * x - a * z, a * y - b * x]
}

/// Hamilton's product.
fn product([a, b, c, d]: [f64; 4], [x, y, z, w]: [f64; 4]) -> [f64; 4] {
    [
        d * x + a * w + b * z - c * y,
        d * y - a * z + b * w + c * x,
        d * z + a * y - b * x + c * w,
        d * w - a * x - b * y - c * z,
    ]
}

/// A vector after a rotation.
fn rotated(by @ [x, y, z, w]: [f64; 4], vector: [f64; 3]) -> [f64; 3] {
    let [a, b, c] = vector;
    let [a, b, c, _] = product(product(by, [a, b, c, 0.0]), [-x, -y, -z, w]);
    [a, b, c]
}

/// The axis of a rotation times its angle, at most half a turn (rad).
fn rotation_vector([x, y, z, w]: [f64; 4]) -> [f64; 3] {
    let sine = (x * x + y * y + z * z).sqrt();
    let [sign, cosine] = if w < 0.0 { [-1.0, -w] } else { [1.0, w] };
    let angle = 2.0 * libm::atan2(sine, cosine);
    if angle < NO_TURN {
        return [0.0; 3];
    }
    [x, y, z].map(|part| sign * angle * (part / sine))
}

/// The rotation by a rotation vector.
fn rotation(vector @ [x, y, z]: [f64; 3]) -> [f64; 4] {
    let angle = (x * x + y * y + z * z).sqrt();
    if angle < NO_TURN {
        return [0.0, 0.0, 0.0, 1.0];
    }
    let (sine, cosine) = libm::sincos(0.5 * angle);
    let [x, y, z] = vector.map(|part| part / angle * sine);
    [x, y, z, cosine]
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn places() -> impl Strategy<Value = Rigid> {
        let number = -2.0..2.0f64;
        let vectors = prop::array::uniform3(number);
        (vectors.clone(), vectors).prop_map(|(position, vector)| Rigid {
            position,
            rotation: rotation(vector.map(|part| 0.8 * part)),
        })
    }

    fn planar(x: f64, y: f64, angle: f64) -> Rigid {
        Rigid { position: [x, y, 0.0], rotation: rotation([0.0, 0.0, angle]) }
    }

    fn near(one: [f64; 3], other: [f64; 3], tolerance: f64) -> bool {
        one.iter().zip(&other).all(|(a, b)| (a - b).abs() <= tolerance)
    }

    proptest! {
        #[test]
        fn in_the_plane_the_angle_turns_uniformly_the_shorter_way(
            from in -3.1..3.1f64, turn in -3.1..3.1f64, share in 0.0..1.0f64, seconds in 0.01..2.0f64,
        ) {
            let (start, end) = (planar(0.0, 1.0, from), planar(2.0, 0.5, from + turn));
            let moving = start.towards(end, share, seconds);
            let ([x, y], angle) = moving.at.pose().in_plane("pose").unwrap();
            prop_assert!((x - 2.0 * share).abs() < 1e-12 && (y - 1.0 + 0.5 * share).abs() < 1e-12);
            let off = angle - (from + share * turn);
            let whole = off / std::f64::consts::TAU;
            prop_assert!((whole - whole.round()).abs() < 1e-9, "{angle}");
            let spin = [0.0, 0.0, turn / seconds];
            prop_assert!(near(moving.spin, spin, 1e-9 / seconds), "{moving:?}");
            let velocity = [2.0 / seconds, -0.5 / seconds, 0.0];
            prop_assert!(near(moving.velocity, velocity, 1e-9 / seconds));
        }

        #[test]
        fn velocities_of_a_chain_are_the_derivatives_of_its_places(
            outer in [places(), places()], inner in [places(), places()], share in 0.1..0.9f64,
        ) {
            const STEP: f64 = 1e-5;
            let chain = |share: f64| {
                let [outer, inner] = [outer, inner].map(|[a, b]| a.towards(b, share, 1.0));
                outer.carries(&inner)
            };
            let [before, at, after] = [share - STEP, share, share + STEP].map(chain);
            let change = before.at.towards(after.at, 0.5, 2.0 * STEP);
            prop_assert!(near(change.velocity, at.velocity, 1e-6), "{change:?} {at:?}");
            prop_assert!(near(change.spin, at.spin, 1e-6), "{change:?} {at:?}");
        }

        #[test]
        fn a_motion_begins_at_its_start_and_ends_at_its_end(start in places(), end in places()) {
            let places = [start.towards(end, 0.0, 1.0), start.towards(end, 1.0, 1.0)];
            prop_assert!(near(places[0].at.position, start.position, 1e-12));
            prop_assert_eq!(places[1].at, end);
            let almost = start.towards(end, 1.0 - 1e-12, 1.0).at.rotation;
            // q and -q are the same rotation.
            let along: f64 = almost.iter().zip(&end.rotation).map(|(a, b)| a * b).sum();
            prop_assert!((along.abs() - 1.0).abs() < 1e-9);
        }
    }
}
