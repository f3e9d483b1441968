//! `eddy completions` and `eddy man`.

use std::{
    fs,
    io::{ErrorKind, Write as _, stdout},
};

use anyhow::Context as _;

use crate::cli::{CompletionsArgs, ManArgs, command};

/// Prints a shell completion script.
pub fn run(args: &CompletionsArgs) -> anyhow::Result<()> {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut command(), "eddy", &mut script);
    // Not written by the generator, which panics if that fails.
    match stdout().write_all(&script) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => {
            Err(error).context("cannot print the script")
        }
        _ => Ok(()),
    }
}

/// Writes a manual page for each command.
pub fn man(args: &ManArgs, quiet: bool) -> anyhow::Result<()> {
    let folder = args.output.display();
    fs::create_dir_all(&args.output).with_context(|| format!("cannot create {folder}"))?;
    clap_mangen::generate_to(command(), &args.output)
        .with_context(|| format!("cannot write to {folder}"))?;
    if !quiet {
        println!("man -l {}", args.output.join("eddy.1").display());
    }
    Ok(())
}
