//! How a program ends.

use std::process::ExitCode;

use eddy_settings::usage::Usage;

use crate::terminal;

/// Exit code of a failure.
const FAILED: u8 = 1;
/// Exit code of wrong usage, as in clap.
const WRONG_USAGE: u8 = 2;

/// The exit code of a program, whose error is printed.
pub fn exit_code(program: &str, outcome: anyhow::Result<ExitCode>) -> ExitCode {
    let code = outcome.unwrap_or_else(|error| {
        eprintln!("{program}: {error:#}");
        ExitCode::from(if error.is::<Usage>() { WRONG_USAGE } else { FAILED })
    });
    match terminal::failure() {
        Some(error) => {
            eprintln!("{program}: cannot write to standard output: {error}");
            ExitCode::from(FAILED)
        }
        None => code,
    }
}
