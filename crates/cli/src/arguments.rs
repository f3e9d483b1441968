//! Options of every command, and how all command lines are read.

use clap::{
    Args, Command, FromArgMatches,
    error::{ContextKind, ContextValue, ErrorKind},
};

/// Heading of the options that every command has.
const GLOBAL: &str = "Global options";

/// Options that every command has.
#[derive(Clone, Debug, Args)]
pub struct GlobalArgs {
    /// Print errors only: no progress bars, status lines or summaries.
    #[arg(long, short, global = true, help_heading = GLOBAL)]
    pub quiet: bool,

    /// Log level on standard error: error, warn, info, debug or trace, or a filter such as `eddy=debug` [default: warn].
    #[arg(
        long,
        value_name = "LEVEL",
        global = true,
        help_heading = GLOBAL,
        hide_default_value = true,
        hide_env_values = true,
        // RustDDS logs normal events as errors, such as participants that appear and disappear.
        default_value = "warn,zenoh=error,iceoryx2_bb_loggers=error,rustdds=off,ros2_client=error",
        env = "EDDY_LOG",
        value_parser = log_filter
    )]
    pub log_level: String,
}

/// Levels of the log; RFC 5424 and ROS 2 have further names.
const LEVELS: [&str; 6] = ["off", "error", "warn", "info", "debug", "trace"];

/// A filter of the log. A single word that is no level would be the name of a part of the program, of which all would be logged.
fn log_filter(text: &str) -> Result<String, String> {
    for directive in text.split(',') {
        let level = directive.rsplit_once('=').map_or(directive, |(_, level)| level);
        if !LEVELS.iter().any(|known| known.eq_ignore_ascii_case(level)) {
            let levels = LEVELS.join(", ");
            return Err(format!("found {level:?}, expected one of {levels}"));
        }
    }
    Ok(text.to_owned())
}

/// A command, and its examples.
pub type Examples = (&'static str, &'static [&'static str]);

/// The command line as users meet it: examples at the end of each command's long help, negative numbers as values, empty
/// environment variables as unset ones.
pub fn prepared(command: Command, examples: &[Examples]) -> Command {
    without_empty_variables(with_negative_numbers(with_examples(command, examples)))
}

/// Parses the arguments of this process.
///
/// # Errors
/// What is wrong with them; also for `--help` and `--version`, whose text is the error.
pub fn read<C: FromArgMatches>(command: Command) -> Result<C, clap::Error> {
    let matches = command.try_get_matches().map_err(without_escape_tip)?;
    C::from_arg_matches(&matches)
}

/// As in ROS 2, an empty environment variable is the same as an unset one.
#[expect(clippy::disallowed_methods, reason = "clap reads the variables that its arguments name")]
fn without_empty_variables(command: Command) -> Command {
    let is_empty = |arg: &clap::Arg| {
        let value = arg.get_env().and_then(std::env::var_os);
        value.is_some_and(|value| value.is_empty())
    };
    let command = command.mut_args(|arg| match is_empty(&arg) {
        true => arg.env(None::<&'static str>),
        false => arg,
    });
    command.mut_subcommands(without_empty_variables)
}

/// Takes `-1` for a value, which is then rejected with the range of the option, and not for an unknown option.
fn with_negative_numbers(command: Command) -> Command {
    let takes_value = |arg: &clap::Arg| arg.get_action().takes_values() && !arg.is_positional();
    let command = command.mut_args(|arg| match takes_value(&arg) {
        true => arg.allow_negative_numbers(true),
        false => arg,
    });
    command.mut_subcommands(with_negative_numbers)
}

/// Removes the tip to pass an unknown option as a value, which it hardly ever is.
fn without_escape_tip(mut error: clap::Error) -> clap::Error {
    if error.kind() == ErrorKind::UnknownArgument
        && let Some(ContextValue::StyledStrs(mut tips)) = error.remove(ContextKind::Suggested)
    {
        tips.retain(|tip| !tip.to_string().starts_with("to pass "));
        if !tips.is_empty() {
            error.insert(ContextKind::Suggested, ContextValue::StyledStrs(tips));
        }
    }
    error
}

/// The command line with the examples at the end of each command's long help.
fn with_examples(command: Command, examples: &[Examples]) -> Command {
    examples.iter().fold(command, |command, (path, lines)| {
        let words: Vec<_> = path.split(' ').collect();
        let lines: Vec<String> = lines.iter().map(|line| wrapped(line)).collect();
        under(command, &words, &format!("Examples:\n  {}", lines.join("\n  ")))
    })
}

/// A command for a terminal of 80 columns, continued with `\` as in a shell: before options, which keep their values beside them.
fn wrapped(line: &str) -> String {
    /// Columns without the indentation and the backslash.
    const COLUMNS: usize = 74;
    let mut options: Vec<String> = Vec::new();
    for word in line.split(' ') {
        match options.last_mut() {
            // What is too long for a line is broken where it must be.
            Some(option) if !word.starts_with('-') && option.len() + word.len() < COLUMNS => {
                *option = format!("{option} {word}");
            }
            _ => options.push(word.to_owned()),
        }
    }
    let (mut text, mut length) = (String::new(), 0);
    for option in options {
        if length > 0 && length + 1 + option.len() > COLUMNS {
            text.push_str(" \\\n     ");
            length = 4;
        }
        if length > 0 {
            text.push(' ');
        }
        text.push_str(&option);
        length += 1 + option.len();
    }
    text
}

fn under(command: Command, path: &[&str], text: &str) -> Command {
    match path {
        [] => command.after_long_help(text.to_owned()),
        [first, rest @ ..] => command.mut_subcommand(first, |inner| under(inner, rest, text)),
    }
}

#[cfg(test)]
mod tests {
    use super::{log_filter, wrapped};

    #[test]
    fn examples_break_before_options() {
        let line = "eddy eval --checkpoint checkpoints/particle-mingru checkpoints/mine --data bags/mm --output reports/both";
        let expected = "eddy eval --checkpoint checkpoints/particle-mingru checkpoints/mine \\\n      --data bags/mm --output reports/both";
        assert_eq!(wrapped(line), expected);
    }

    #[test]
    fn a_word_that_is_no_level_is_refused() {
        for known in ["debug", "WARN", "off,eddy=info", "warn,zenoh=error,rustdds=off"] {
            assert_eq!(log_filter(known), Ok(known.to_owned()));
        }
        for (text, found) in [("verbose", "verbose"), ("eddy=loud", "loud"), ("warn,eddy", "eddy")]
        {
            let error = log_filter(text).unwrap_err();
            assert!(error.starts_with(&format!("found {found:?}, expected one of off, error")));
        }
    }
}
