//! What the data of a stream states, compared with what a network was trained on: data that it can predict, but not as well, and
//! assumptions that it makes. Every program that reads streams asks this module.

use std::{
    fmt,
    mem::{Discriminant, discriminant},
};

use crate::{
    checkpoint::{Architecture, Description},
    kernels::spacing::spacing,
};
use eddy_frames::{Domain, Frame, Material};

/// Factor by which the spacing of particles may differ from training without a warning. In a splash, spacing is uneven.
const SPACING_FACTOR: f32 = 1.5;
/// The same for the stiffness: the speed of sound differs by half as much.
const STIFFNESS_FACTOR: f32 = 1.1;
/// Largest difference of gravity without a warning, relative to that in training.
const GRAVITY_TOLERANCE: f32 = 0.01;

/// What is known of a stream at its beginning.
#[derive(Clone, Copy, Debug)]
pub struct StreamSetup<'a> {
    /// The box that holds the particles.
    pub domain: Domain,
    /// Positions in the first frame, `[N, 2]` (domain lengths).
    pub position: &'a [[f32; 2]],
    /// Materials, `[N]`.
    pub material: &'a [Material],
    /// Sequence number of the first frame.
    pub sequence: u64,
    /// What its source states.
    pub stated: Stated,
}

/// What the source of a stream states about it and its frames do not show. What is not stated is not compared.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Stated {
    /// Gravity along y, negative is down (domain lengths per second squared).
    pub gravity: Option<f32>,
    /// Young's modulus of its materials (density x velocity^2).
    pub stiffness: Option<f32>,
}

impl<'a> StreamSetup<'a> {
    /// A stream that begins with `frame`.
    pub fn of(frame: &'a Frame, stated: Stated) -> Self {
        let Frame { domain, position, material, sequence, .. } = frame;
        Self { domain: *domain, position, material, sequence: *sequence, stated }
    }
}

/// A warning about a stream.
#[derive(Clone, Debug, PartialEq)]
pub enum Warning {
    /// The domain has another size than in training: its walls are assumed to be as thick.
    Domain {
        /// Width and height in the frame (domain lengths).
        found: [f32; 2],
        /// Width and height in training (domain lengths).
        expected: [f32; 2],
    },
    /// Particles are closer together or further apart than in training: forces between them will be wrong.
    Spacing {
        /// Median distance to the nearest particle in the frame (domain lengths).
        found: f32,
        /// The same at rest in training (domain lengths).
        expected: f32,
    },
    /// Gravity is another one: everything falls too fast or too slowly.
    Gravity {
        /// Along y in the stream (domain lengths per second squared).
        found: f32,
        /// The same in training.
        expected: f32,
    },
    /// The matter is softer or stiffer than in training.
    Stiffness {
        /// Young's modulus in the stream (density x velocity^2).
        found: f32,
        /// The smallest and the largest in training.
        expected: [f32; 2],
        /// Whether the network is conditioned on it.
        conditioned: bool,
    },
    /// The source does not state the stiffness that the network is conditioned on.
    AssumedStiffness {
        /// What the checkpoint assumes (density x velocity^2).
        assumed: f32,
    },
    /// The stream was not observed from its beginning and contains solids: their shape in this frame is taken as their rest
    /// shape.
    RestShape {
        /// Sequence number of the frame.
        sequence: u64,
    },
}

impl fmt::Display for Warning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Domain { found: [x, y], expected: [u, v] } => write!(
                f,
                "domain is {x} x {y}, model was trained on {u} x {v}; assuming walls of the same thickness; train on such a \
                 domain if that is wrong"
            ),
            Self::Spacing { found, expected } => write!(
                f,
                "particle spacing is {found:.5}, model was trained on {expected:.5}; predictions will be poor; scale lengths \
                 or use other particles so that spacings agree, or train on such data"
            ),
            Self::Gravity { found, expected } => write!(
                f,
                "gravity is {found} along y, model was trained with {expected}; predictions will fall wrongly; train on such \
                 data with `gravity = [0.0, {found:?}]`"
            ),
            Self::Stiffness { found, expected: [low, high], conditioned } => {
                let trained =
                    if low == high { low.to_string() } else { format!("{low} to {high}") };
                let (matter, remedy) = match conditioned {
                    true => ("as at the nearest of these", "train on such data"),
                    false if found > high => (
                        "too soft",
                        "train on such data, or use a checkpoint that is conditioned on the stiffness",
                    ),
                    false => (
                        "too stiff",
                        "train on such data, or use a checkpoint that is conditioned on the stiffness",
                    ),
                };
                write!(
                    f,
                    "stiffness is {found}, model was trained with {trained}; predicted matter will be {matter}; {remedy}"
                )
            }
            Self::AssumedStiffness { assumed } => write!(
                f,
                "stiffness is not stated; assuming {assumed}; set `--stiffness` or state it if that is wrong"
            ),
            Self::RestShape { sequence } => write!(
                f,
                "joined at sequence {sequence}; assuming that jelly and rope are unstrained in this frame"
            ),
        }
    }
}

/// Warnings about a stream, for a network with this description.
pub fn warnings(description: &Description, setup: &StreamSetup<'_>) -> Vec<Warning> {
    let mut warnings = Vec::new();
    let &StreamSetup { domain, position, material, sequence, stated } = setup;
    if let Some(found) = stated.gravity {
        let [_, expected] = description.gravity;
        if (found - expected).abs() > GRAVITY_TOLERANCE * expected.abs() {
            warnings.push(Warning::Gravity { found, expected });
        }
    }
    if let (Some(found), Some(expected)) = (stated.stiffness, description.trained_stiffness()) {
        let [low, high] = expected;
        if !(low / STIFFNESS_FACTOR..=high * STIFFNESS_FACTOR).contains(&found) {
            let conditioned = description.stiffness;
            warnings.push(Warning::Stiffness { found, expected, conditioned });
        }
    }
    let Some(grid) = &description.grid else { return warnings };
    debug_assert_eq!(description.architecture, Architecture::Particle);
    let size = |lower: [f32; 2], upper: [f32; 2]| [upper[0] - lower[0], upper[1] - lower[1]];
    let found = size(domain.lower, domain.upper);
    let expected = size(description.domain.lower, description.domain.upper);
    if (0..2).any(|axis| (found[axis] - expected[axis]).abs() > 1e-6 * expected[axis]) {
        warnings.push(Warning::Domain { found, expected });
    }
    let (found, expected) = (spacing(position), grid.spacing);
    if found.is_finite() && !(1.0 / SPACING_FACTOR..SPACING_FACTOR).contains(&(found / expected)) {
        warnings.push(Warning::Spacing { found, expected });
    }
    if sequence > 0 && material.iter().any(|material| material.keeps_shape()) {
        warnings.push(Warning::RestShape { sequence });
    }
    if let (None, Some(assumed)) = (stated.stiffness, description.assumed_stiffness) {
        warnings.push(Warning::AssumedStiffness { assumed });
    }
    warnings
}

/// Warnings about many streams as sentences: each kind once, as of the first stream that has it, with the number of streams.
#[derive(Debug, Default)]
pub struct WarningCounts(Vec<Counted>);

#[derive(Debug)]
struct Counted {
    compared_with: String,
    kind: Discriminant<Warning>,
    first: String,
    streams: usize,
    /// Whether all have the same numbers.
    alike: bool,
}

impl WarningCounts {
    /// Counts a warning of one stream that was compared with a network or settings, put as this sentence.
    pub fn add(&mut self, compared_with: &str, warning: &Warning, sentence: String) {
        let kind = discriminant(warning);
        match self.0.iter_mut().find(|one| one.compared_with == compared_with && one.kind == kind) {
            Some(counted) => {
                counted.streams += 1;
                counted.alike &= counted.first == sentence;
            }
            None => {
                let compared_with = compared_with.to_owned();
                let first = sentence;
                self.0.push(Counted { compared_with, kind, first, streams: 1, alike: true });
            }
        }
    }

    /// The sentences, with their numbers of `all` streams.
    pub fn sentences(self, all: usize) -> impl Iterator<Item = String> {
        self.0.into_iter().map(move |Counted { first, streams, alike, .. }| match alike {
            true => format!("{first} ({streams} of {all} streams)"),
            false => format!("{first} (the first of {streams} such streams of {all})"),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::checkpoint::{Core, ElasticRule, Sizes};
    use eddy_frames::Stamp;

    /// A lattice of one material.
    fn frame(step: f32, material: Material, sequence: u64) -> Frame {
        let position: Vec<_> =
            (0..36).map(|k| [0.3 + step * (k % 6) as f32, 0.3 + step * (k / 6) as f32]).collect();
        Frame {
            stream: 0,
            sequence,
            stamp: Stamp(0),
            dt: 0.016,
            domain: Domain::UNIT,
            velocity: vec![[0.0; 2]; position.len()],
            material: vec![material; position.len()],
            position,
        }
    }

    fn description() -> Description {
        let sizes = Sizes { encoder: 4, hidden: 4, layers: 1, particles: None };
        Description::untrained(Architecture::Particle, Core::MinGru, sizes)
    }

    fn of(description: &Description, frame: &Frame, stated: Stated) -> Vec<String> {
        let found = warnings(description, &StreamSetup::of(frame, stated));
        found.iter().map(ToString::to_string).collect()
    }

    fn displayed(frame: &Frame) -> Vec<String> {
        of(&description(), frame, Stated::default())
    }

    #[test]
    fn data_like_the_training_data_causes_no_warning() {
        assert!(displayed(&frame(1.0 / 128.0, Material::Jelly, 0)).is_empty());
        assert!(displayed(&frame(1.0 / 128.0, Material::Liquid, 7)).is_empty());
    }

    #[test]
    fn another_domain_another_spacing_and_a_late_start_cause_warnings() {
        let mut frame = frame(0.02, Material::Rope, 57);
        frame.domain.upper = [2.0, 1.0];
        assert_eq!(
            displayed(&frame),
            [
                "domain is 2 x 1, model was trained on 1 x 1; assuming walls of the same thickness; train on such a domain if \
                 that is wrong",
                "particle spacing is 0.02000, model was trained on 0.00781; predictions will be poor; scale lengths or use \
                 other particles so that spacings agree, or train on such data",
                "joined at sequence 57; assuming that jelly and rope are unstrained in this frame",
            ]
        );
    }

    #[test]
    fn stated_gravity_and_stiffness_are_compared_with_both_numbers() {
        let frame = frame(1.0 / 128.0, Material::Liquid, 0);
        let mut description = description();
        description.rules.elastic = Some(ElasticRule::new(300.0, 1.0 / 128.0, 0.016));
        let like = Stated { gravity: Some(-9.81), stiffness: Some(1e3) };
        assert!(of(&description, &frame, like).is_empty());
        let moon = Stated { gravity: Some(-1.62), stiffness: Some(1e5) };
        assert_eq!(
            of(&description, &frame, moon),
            [
                "gravity is -1.62 along y, model was trained with -9.8; predictions will fall wrongly; train on such data with \
                 `gravity = [0.0, -1.62]`",
                "stiffness is 100000, model was trained with 1000; predicted matter will be too soft; train on such data, or \
                 use a checkpoint that is conditioned on the stiffness",
            ]
        );
        let upwards = Stated { gravity: Some(9.8), ..Stated::default() };
        assert_eq!(of(&description, &frame, upwards).len(), 1);
        let soft = Stated { stiffness: Some(1e2), ..Stated::default() };
        assert!(of(&description, &frame, soft)[0].contains("too stiff"));
        // Nothing is known of its training, until the streams state it.
        description.rules.elastic = None;
        assert!(of(&description, &frame, soft).is_empty());
        description.training.stiffness = Some([5e2, 5e3]);
        assert!(of(&description, &frame, soft)[0].contains("trained with 500 to 5000;"));
    }

    #[test]
    fn a_network_conditioned_on_the_stiffness_is_warned_of_others_than_it_has_weights_for() {
        let frame = frame(1.0 / 128.0, Material::Liquid, 0);
        let knots = vec![1e3, 1e5];
        let description = Description { stiffness: true, stiffness_knots: knots, ..description() };
        let stated = |stiffness| Stated { stiffness: Some(stiffness), ..Stated::default() };
        assert!(of(&description, &frame, stated(3e4)).is_empty());
        assert!(of(&description, &frame, Stated::default()).is_empty());
        let assuming = Description { assumed_stiffness: Some(2e3), ..description.clone() };
        assert!(of(&assuming, &frame, stated(3e4)).is_empty());
        let found = of(&assuming, &frame, Stated::default());
        assert_eq!(
            found,
            [
                "stiffness is not stated; assuming 2000; set `--stiffness` or state it if that is wrong"
            ]
        );
        let found = of(&description, &frame, stated(1e7));
        assert_eq!(
            found,
            [
                "stiffness is 10000000, model was trained with 1000 to 100000; predicted matter will be as at the nearest of \
              these; train on such data"
            ]
        );
    }

    #[test]
    fn a_kind_of_warning_is_said_once_for_many_streams() {
        let mut counts = WarningCounts::default();
        let mut add =
            |with: &str, warning: Warning| counts.add(with, &warning, warning.to_string());
        for found in [-1.62, -3.7, -1.62] {
            add("a", Warning::Gravity { found, expected: -9.8 });
        }
        add("b", Warning::Gravity { found: -3.7, expected: -9.8 });
        for _ in 0..2 {
            add("a", Warning::RestShape { sequence: 5 });
        }
        let found: Vec<_> = counts.sentences(7).collect();
        let [first, other, rest] = &found[..] else { panic!("{found:?}") };
        assert!(first.starts_with("gravity is -1.62"), "{first}");
        assert!(first.ends_with("(the first of 3 such streams of 7)"), "{first}");
        assert!(
            other.starts_with("gravity is -3.7") && other.ends_with("(1 of 7 streams)"),
            "{other}"
        );
        assert!(rest.ends_with("(2 of 7 streams)"), "{rest}");
    }
}
