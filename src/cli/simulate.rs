//! `eddy simulate`: scenes, and where they go.

use std::{num::NonZeroUsize, path::PathBuf};

use clap::Args;

use super::{Device, values};
use crate::commands::simulate;
use eddy_mpm::{Law, ParticleOrder};
use eddy_transport::{Link, Reliability};

/// `eddy simulate`
#[derive(Debug, Args)]
pub struct SimulateArgs {
    #[command(flatten)]
    pub scenes: SceneArgs,
    /// Output directory; one bag per scene.
    #[arg(long, short, value_name = "DIR", required_unless_present = "publish")]
    pub output: Option<PathBuf>,
    /// Replace the scenes in the output directory; without it, the same command adds those that are missing.
    #[arg(long, requires = "output")]
    pub force: bool,
    /// Publish frames in real time, for example on zenoh:/particles, shm:/particles or dds:/particles, and the simulated
    /// time on /clock of the same transport.
    #[arg(long, value_name = "LINK", value_parser = Link::from_argument)]
    pub publish: Option<Link>,
    /// Simulated time per real time when publishing.
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0, requires = "publish", value_parser = values::positive)]
    pub rate: f64,
    /// Wait for N subscribers before the first frame (at most 30 s).
    #[arg(long, value_name = "N", default_value_t = 0, requires = "publish")]
    pub wait_for: usize,
    /// What happens when a subscriber cannot keep up.
    #[arg(long, value_enum, default_value_t = Reliability::Block, requires = "publish")]
    pub reliability: Reliability,
    /// Number of threads: one per scene, the remaining ones work within the scenes [default: one per scene, at most one
    /// per core].
    #[arg(long, value_name = "N")]
    pub threads: Option<NonZeroUsize>,
}

/// Which scenes to simulate, and where the solver runs.
#[derive(Debug, Args)]
pub struct SceneArgs {
    /// Kind of random scenes, or one of the scenes shipped with eddy.
    #[arg(long, value_name = "NAME", value_parser = simulate::source::presets(), default_value = "multi-material")]
    pub preset: String,
    /// Scene file (TOML); launch_configs/scenes/ has examples.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["preset", "scenes", "seed"])]
    pub scene: Option<PathBuf>,
    /// Number of random scenes.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    pub scenes: u32,
    /// Seed of random scenes; the same seed gives identical bags.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Particles of a random scene; more particles make the domain wider, at the same spacing and height [default: 2500].
    #[arg(long, value_name = "N", conflicts_with = "scene")]
    pub particles: Option<usize>,
    /// Fraction of the unit square that the bodies of a random scene fill, drawn for each scene; LOW 0.02 to 0.15, HIGH up to 0.4
    /// [default: that of 2,500 particles, 0.153; preset fluid 0.038].
    #[arg(long, value_name = "LOW..HIGH", conflicts_with_all = ["scene", "particles", "same_bodies"], value_parser = range)]
    pub fill: Option<[f32; 2]>,
    /// All random scenes have the bodies of the first: the same materials, shapes and places. Only their velocities and the
    /// attractor differ.
    #[arg(long, conflicts_with = "scene")]
    pub same_bodies: bool,
    /// How the particles of bodies are numbered: body by body, or along a Hilbert curve through their initial positions
    /// [default: the scene's; bodies].
    #[arg(long, value_enum, value_name = "ORDER")]
    pub particle_order: Option<ParticleOrder>,
    /// Duration of a scene (simulated s) [default: the scene's].
    #[arg(long, value_name = "SECONDS", value_parser = values::positive_seconds)]
    pub duration: Option<f64>,
    /// Solver substeps per frame; unstable values are rejected [default: from the CFL condition].
    #[arg(long, value_name = "N")]
    pub substeps: Option<u32>,
    /// Young's modulus of every material (density x velocity^2); LOW..HIGH draws one for each random scene, its logarithm uniform
    /// in this range [default: the scene's; 1000, preset stiff 1e5].
    #[arg(long, value_name = "E|LOW..HIGH", value_parser = Stiffness::parse)]
    pub stiffness: Option<Stiffness>,
    /// Constitutive law of liquids: water, or that of Taichi's mpm128 [default: the scene's; water].
    #[arg(long, value_enum)]
    pub law: Option<Law>,
    /// Kinematic viscosity of water (domain lengths^2/s) [default: the scene's; 0].
    #[arg(long, value_name = "NU")]
    pub viscosity: Option<f32>,
    /// Also record pressure and energy of every particle, as point clouds on /particles/fields.
    #[arg(long, requires = "output")]
    pub fields: bool,
    /// Where the solver runs: cpu, cuda for an NVIDIA GPU, cuda:1 for the second. A GPU simulates up to 256 scenes side by
    /// side, and its results differ from the processor's by rounding.
    #[arg(long, value_name = "DEVICE", default_value = "cpu", value_parser = Device::parse)]
    pub device: Device,
}

/// Young's modulus of scenes (density x velocity^2).
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Stiffness {
    /// That of every scene.
    One(f32),
    /// The range of a random one for each scene.
    Between([f32; 2]),
}

impl Stiffness {
    /// The one of every scene.
    pub fn one(self) -> Option<f32> {
        match self {
            Self::One(stiffness) => Some(stiffness),
            Self::Between(_) => None,
        }
    }

    /// The range.
    pub fn range(self) -> Option<[f32; 2]> {
        match self {
            Self::One(_) => None,
            Self::Between(range) => Some(range),
        }
    }

    fn parse(text: &str) -> Result<Self, String> {
        let one = || text.trim().parse().ok().map(Self::One);
        let found = range(text).ok().map(Self::Between).or_else(one);
        found.ok_or_else(|| "expected a number, or a range such as 300..3e5".to_owned())
    }
}

/// Two numbers, LOW..HIGH.
fn range(text: &str) -> Result<[f32; 2], String> {
    let number = |text: &str| text.trim().parse().ok();
    let found = text.split_once("..").and_then(|(low, high)| number(low).zip(number(high)));
    found
        .map(|(low, high)| [low, high])
        .ok_or_else(|| "expected a range such as 0.1..0.3".to_owned())
}
