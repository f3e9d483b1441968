//! `eddy bag import`.

use super::watch;
use crate::{
    cli::ImportArgs,
    commands::{checked_custom_data, counted},
};
use eddy_cli::{Interrupt, Output, OutputKind, progress_bar};
use eddy_exchange::{ImportOverrides, import};
use eddy_frames::Domain;

/// Writes trajectories from files of other programs as bags.
pub fn run(args: ImportArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    let domain = args.domain.as_deref().and_then(|sides| match *sides {
        [left, bottom, right, top] => {
            Some(Domain { lower: [left, bottom], upper: [right, top] }.into())
        }
        _ => None,
    });
    let custom_data = checked_custom_data(&args.custom_data)?;
    let overrides = ImportOverrides { dt: args.dt, domain, material: args.material, custom_data };
    let room =
        Output::at(&args.output, OutputKind::Bags, args.force, std::slice::from_ref(&args.path))?;
    // The number of frames is unknown until the end.
    let bar = progress_bar(0, "frames", quiet);
    bar.unset_length();
    let imported =
        import(&args.path, args.format, &overrides, &args.output, &mut watch(&bar, interrupt));
    bar.finish_and_clear();
    let imported = imported?;
    room.replaced();
    let streams = counted(imported.streams as u64, "stream");
    let frames = counted(imported.frames as u64, "frame");
    println!("{}: {streams}, {frames}", args.output.display());
    Ok(())
}
