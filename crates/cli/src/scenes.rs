//! Scenes from a preset and a seed, or from a file.

use std::{
    num::NonZeroUsize,
    path::{Path, PathBuf},
};

use clap::{
    Args, ValueEnum,
    builder::{PossibleValue, PossibleValuesParser},
};
use eddy_dataset::simulate::{SimulateError, SimulationRequest, Source};
use eddy_mpm::{Extent, ExtentOptions, Law, ParticleOrder, Preset, Scene, Settings};
use eddy_settings::{self as config, usage::Usage};

use crate::{Device, values};

/// Scene files within the program, by their names for `--preset`.
const SHIPPED: [(&str, &str); 9] = [
    ("blade", include_str!("../scenes/blade.toml")),
    ("cup", include_str!("../scenes/cup.toml")),
    ("dam-break", include_str!("../scenes/dam_break.toml")),
    ("fountain", include_str!("../scenes/fountain.toml")),
    ("rope-on-jelly", include_str!("../scenes/rope_on_jelly.toml")),
    ("sand-column", include_str!("../scenes/sand_column.toml")),
    ("snowball", include_str!("../scenes/snowball.toml")),
    ("viscous-jet", include_str!("../scenes/viscous_jet.toml")),
    ("wide-tank", include_str!("../scenes/wide_tank.toml")),
];

/// The values of `--preset` with their help.
fn presets() -> PossibleValuesParser {
    let random = Preset::value_variants().iter().filter_map(ValueEnum::to_possible_value);
    let shipped = SHIPPED.iter().map(|(name, text)| {
        // The second line of each file describes it.
        let help = text.lines().nth(1).unwrap_or_default().trim_start_matches("# ");
        PossibleValue::new(*name).help(help.to_owned())
    });
    PossibleValuesParser::new(random.chain(shipped))
}

/// Which scenes to simulate, and where the solver runs.
#[derive(Debug, Args)]
pub struct SceneArgs {
    /// Kind of random scenes, or one of the scenes shipped with eddy.
    #[arg(long, value_name = "NAME", value_parser = presets(), default_value = "multi-material")]
    pub preset: String,
    /// Scene file (TOML); launch_configs/scenes/ has examples [default: scenes of --preset].
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
    /// Solve with cells and particles that are N times finer, and record one of N x N particles: truth of a finer solver, about N^3 times
    /// as dear [default: the scene's; 1].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=8))]
    pub resolve: Option<u32>,
    /// Young's modulus of every material (density x velocity^2); LOW..HIGH draws one for each random scene, its logarithm uniform
    /// in this range [default: the scene's; 1000, preset stiff 1e5].
    #[arg(long, value_name = "E|LOW..HIGH", value_parser = Stiffness::parse)]
    pub stiffness: Option<Stiffness>,
    /// Constitutive law of liquids: settling (water that comes to rest), water, or that of Taichi's mpm128 [default: the scene's; settling].
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

impl SceneArgs {
    /// The request of the command line.
    ///
    /// # Errors
    /// [`Usage`] for arguments that contradict each other or are out of range; a scene file that cannot be used.
    pub fn request(&self, threads: Option<NonZeroUsize>) -> anyhow::Result<SimulationRequest> {
        let source = self.source()?;
        let scene_name = match (&source, &self.scene) {
            (_, Some(file)) => Some(file.display().to_string()),
            (Source::Written(_), None) => Some(self.preset.clone()),
            (Source::Random(_), None) => None,
        };
        let name = match &self.scene {
            Some(file) => file.file_stem().unwrap_or_default().to_string_lossy().into_owned(),
            None => self.preset.clone(),
        };
        let SceneArgs { law, viscosity, substeps, resolve, duration, .. } = *self;
        let order = self.particle_order;
        // A range is part of the source.
        let stiffness = self.stiffness.and_then(Stiffness::one);
        Ok(SimulationRequest {
            source,
            name,
            scene_name,
            scenes: self.scenes,
            seed: self.seed,
            settings: Settings { stiffness, law, viscosity, substeps, resolve, duration, order },
            fields: self.fields,
            device: (self.device != Device::Cpu).then_some("cuda"),
            threads,
        })
    }

    /// The source that the arguments describe.
    fn source(&self) -> anyhow::Result<Source> {
        let range = self.stiffness.and_then(Stiffness::range);
        if self.scene.is_none()
            && let Ok(preset) = Preset::from_str(&self.preset, false)
        {
            let options = ExtentOptions {
                particles: self.particles,
                fill: self.fill,
                stiffness: range,
                same_bodies: self.same_bodies,
            };
            let usage = |error| Usage::new(format_args!("--{error}"));
            return Ok(Source::Random(Extent::requested(preset, options).map_err(usage)?));
        }
        if let Some([low, high]) = range {
            let scene = match &self.scene {
                Some(file) => file.display().to_string(),
                None => format!("preset {}", self.preset),
            };
            return Err(Usage::new(format_args!(
                "--stiffness: found {low}..{high}, expected one number: {scene} is a single scene"
            ))
            .into());
        }
        if let Some(file) = &self.scene {
            return Ok(Source::Written(Box::new(config::load_like(file, &Scene::default())?)));
        }
        for (option, given) in [("same-bodies", self.same_bodies), ("fill", self.fill.is_some())] {
            if given {
                return Err(Usage::new(format_args!(
                    "--{option}: preset {} is a single scene",
                    self.preset
                ))
                .into());
            }
        }
        if self.particles.is_some() {
            return Err(Usage::new(format_args!(
                "--particles: preset {} has a fixed number of particles",
                self.preset
            ))
            .into());
        }
        let shipped = SHIPPED.iter().find(|(name, _)| *name == self.preset);
        let text = shipped.map_or("", |(_, text)| text);
        Ok(Source::Written(Box::new(config::parse(Path::new(&self.preset), text)?)))
    }
}

/// An invalid request is wrong usage: its numbers are all from the command line.
pub fn with_usage(error: impl Into<anyhow::Error>) -> anyhow::Error {
    let error = error.into();
    match error.downcast_ref() {
        Some(SimulateError::Request { .. }) => Usage::new(format_args!("--{error}")).into(),
        _ => error,
    }
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
    fn one(self) -> Option<f32> {
        match self {
            Self::One(stiffness) => Some(stiffness),
            Self::Between(_) => None,
        }
    }

    /// The range.
    fn range(self) -> Option<[f32; 2]> {
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
