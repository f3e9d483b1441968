//! Scenes from a preset and a seed, or from a file.

use std::path::Path;

use clap::{
    ValueEnum,
    builder::{PossibleValue, PossibleValuesParser},
};

use crate::cli::{SceneArgs, Stiffness};
use eddy_evaluation::dataset::simulate::Source;
use eddy_mpm::{Extent, MpmError, Preset, Scene};
use eddy_settings::{self as config, usage::Usage};

/// Scene files within the program, by their names for `--preset`.
const SHIPPED: [(&str, &str); 6] = [
    ("dam-break", include_str!("../../../launch_configs/scenes/dam_break.toml")),
    ("fountain", include_str!("../../../launch_configs/scenes/fountain.toml")),
    ("pour", include_str!("../../../launch_configs/scenes/pour.toml")),
    ("rope-on-jelly", include_str!("../../../launch_configs/scenes/rope_on_jelly.toml")),
    ("snowball", include_str!("../../../launch_configs/scenes/snowball.toml")),
    ("wide-tank", include_str!("../../../launch_configs/scenes/wide_tank.toml")),
];

/// The values of `--preset` with their help.
pub(crate) fn presets() -> PossibleValuesParser {
    let random = Preset::value_variants().iter().filter_map(ValueEnum::to_possible_value);
    let shipped = SHIPPED.iter().map(|(name, text)| {
        // The second line of each file describes it.
        let help = text.lines().nth(1).unwrap_or_default().trim_start_matches("# ");
        PossibleValue::new(*name).help(help.to_owned())
    });
    PossibleValuesParser::new(random.chain(shipped))
}

/// The source that the arguments describe.
pub(super) fn source(args: &SceneArgs) -> anyhow::Result<Source> {
    let range = args.stiffness.and_then(Stiffness::range);
    if args.scene.is_none()
        && let Ok(preset) = Preset::from_str(&args.preset, false)
    {
        let usage = |error: MpmError| Usage::new(format_args!("--{error}"));
        let extent = args.particles.map(|particles| Extent::of(preset, particles));
        let extent = extent.transpose().map_err(usage)?.unwrap_or(Extent::usual(preset));
        let extent = match args.fill {
            Some(range) => extent.with_fill(range).map_err(usage)?,
            None => extent,
        };
        let extent = match range {
            Some(range) => extent.with_stiffness(range).map_err(usage)?,
            None => extent,
        };
        return Ok(Source::Random(if args.same_bodies {
            extent.with_same_bodies()
        } else {
            extent
        }));
    }
    if let Some([low, high]) = range {
        let scene = match &args.scene {
            Some(file) => file.display().to_string(),
            None => format!("preset {}", args.preset),
        };
        return Err(Usage::new(format_args!(
            "--stiffness: found {low}..{high}, expected one number: {scene} is a single scene"
        ))
        .into());
    }
    if let Some(file) = &args.scene {
        return Ok(Source::Written(Box::new(config::load_like(file, &Scene::default())?)));
    }
    for (option, given) in [("same-bodies", args.same_bodies), ("fill", args.fill.is_some())] {
        if given {
            return Err(Usage::new(format_args!(
                "--{option}: preset {} is a single scene",
                args.preset
            ))
            .into());
        }
    }
    if args.particles.is_some() {
        return Err(Usage::new(format_args!(
            "--particles: preset {} has a fixed number of particles",
            args.preset
        ))
        .into());
    }
    let shipped = SHIPPED.iter().find(|(name, _)| *name == args.preset);
    let text = shipped.map_or("", |(_, text)| text);
    Ok(Source::Written(Box::new(config::parse(Path::new(&args.preset), text)?)))
}
