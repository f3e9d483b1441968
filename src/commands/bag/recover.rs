//! `eddy bag recover`.

use std::process::ExitCode;

use super::{report, watch, writer_options};
use crate::{
    cli::RecoverArgs,
    commands::{Interrupt, progress_bar},
};
use eddy::bag::{BagReader, CopyOptions, recover};

/// Exit code when the new bag lacks something of the old one, as that of `mcap recover`.
const LOSSY: u8 = 3;

/// Saves what can be read of a bag.
pub fn run(args: &RecoverArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<ExitCode> {
    // Only for the length of the bar and the compression: a bag that does not open may have files
    // that do.
    let opened: Vec<BagReader> = BagReader::open(&args.bag).into_iter().collect();
    let writer = writer_options(&args.new, &opened);
    let messages = opened.iter().map(BagReader::message_count).sum();
    let bar = progress_bar(messages, "messages", quiet);
    let options = CopyOptions { writer, go_on: &mut watch(&bar, interrupt) };
    let outcome = recover(&args.bag, &args.new.output, options);
    bar.finish_and_clear();
    let recovered = outcome?;
    report(&recovered.bag);
    for loss in &recovered.losses {
        println!("not whole: {loss}");
    }
    Ok(if recovered.losses.is_empty() { ExitCode::SUCCESS } else { ExitCode::from(LOSSY) })
}
