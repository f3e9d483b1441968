//! `eddy bag recover`.

use std::process::ExitCode;

use super::{LOSSY, report, watch, watch_bytes, writer_options};
use crate::{cli::RecoverArgs, commands::checked_custom_data};
use eddy_bag::{CopyOptions, Recovery};
use eddy_cli::{Interrupt, Output, OutputKind, progress_bar};

/// Copies what can be read of a bag.
pub fn run(args: &RecoverArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<ExitCode> {
    let custom_data = checked_custom_data(&args.new.custom_data)?;
    let bar = progress_bar(Recovery::size(&args.bag)?, "bytes", quiet);
    let found = Recovery::open(&args.bag, &mut watch_bytes(&bar, interrupt));
    bar.finish_and_clear();
    let found = found?;
    let room = Output::at(
        &args.new.output,
        OutputKind::Bag,
        args.new.force,
        std::slice::from_ref(&args.bag),
    )?;
    let writer = writer_options(&args.new, std::slice::from_ref(found.bag()));
    let bar = progress_bar(found.bag().message_count(), "messages", quiet);
    let options = CopyOptions { writer, custom_data, on_message: &mut watch(&bar, interrupt) };
    let outcome = found.save(&args.new.output, options);
    bar.finish_and_clear();
    let recovered = outcome?;
    room.replaced();
    report(&recovered.bag);
    for loss in &recovered.losses {
        println!("lost: {loss}");
    }
    Ok(if recovered.losses.is_empty() { ExitCode::SUCCESS } else { ExitCode::from(LOSSY) })
}
