//! `eddy completions`, `eddy man`: what shells and readers of manuals are given.

use std::{
    fs,
    io::{Write as _, stdout},
};

use anyhow::Context as _;

use crate::cli::{CompletionsArgs, ManArgs, command};

/// Prints a script that makes the shell complete eddy's commands, options and their values.
pub fn run(args: &CompletionsArgs) -> anyhow::Result<()> {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut command(), "eddy", &mut script);
    // Written here, as the generator's own writing takes a closed pipe for its end.
    stdout().write_all(&script).context("cannot print the script")
}

/// Writes a manual page for every command.
pub fn man(args: &ManArgs, quiet: bool) -> anyhow::Result<()> {
    let folder = args.output.display();
    fs::create_dir_all(&args.output).with_context(|| format!("cannot make {folder}"))?;
    clap_mangen::generate_to(command(), &args.output)
        .with_context(|| format!("cannot write to {folder}"))?;
    if !quiet {
        println!("man -l {}", args.output.join("eddy.1").display());
    }
    Ok(())
}
