//! The arguments after `--ros-args`.

use std::path::Path;

use super::{
    InvalidArgument, RosNode,
    parameters::{self, ParameterOverride},
    remap::{Rule, quoted},
};
use eddy_transport::is_absolute_name;

/// The arguments of ROS 2 (`rcl/arguments.h`).
const KNOWN: &str = "-r/--remap, -p/--param, --params-file, -e/--enclave, --log-level, --log-config-file, --log-file-name, or \
                     --enable- or --disable- with stdout-logs, rosout-logs or external-lib-logs";

/// Arguments without effect: eddy's libraries log through it.
const IGNORED: [&str; 2] = ["--enable-external-lib-logs", "--disable-external-lib-logs"];
/// Arguments with a value and without effect: eddy writes no log files.
const IGNORED_WITH_VALUE: [&str; 2] = ["--log-config-file", "--log-file-name"];

/// Log levels of ROS and their names here. Nothing is logged as `fatal`.
const LEVELS: [(&str, &str); 5] =
    [("debug", "debug"), ("info", "info"), ("warn", "warn"), ("error", "error"), ("fatal", "off")];

/// Parsed ROS arguments, for any node.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RosArguments {
    pub(super) rules: Vec<Rule>,
    pub(super) parameters: Vec<ParameterOverride>,
    /// Levels of the logger of this name, or of all, in the order of the arguments.
    levels: Vec<(Option<String>, &'static str)>,
    /// Whether the log is not published on `/rosout`.
    pub(super) is_without_rosout: bool,
    /// Whether the log is not written to the terminal.
    pub(super) is_without_console: bool,
    /// Security enclave.
    pub(super) enclave: Option<String>,
}

impl RosArguments {
    /// Parses the arguments between `--ros-args` and `--`, and reads the files they name.
    ///
    /// # Errors
    /// [`InvalidArgument`] with the first invalid argument.
    pub fn parse(words: &[String]) -> Result<Self, InvalidArgument> {
        let mut arguments = Self::default();
        let mut words = words.iter().map(String::as_str);
        while let Some(word) = words.next() {
            let mut value = |expected: &str| {
                let missing = || InvalidArgument::new(word, "no value", expected);
                words.next().ok_or_else(missing)
            };
            match word {
                "-r" | "--remap" => arguments.rules.push(value("FROM:=TO")?.parse()?),
                "-p" | "--param" => {
                    arguments.parameters.push(parameters::parse(value("NAME:=VALUE")?)?);
                }
                "--params-file" => {
                    let file = Path::new(value("a file")?);
                    arguments.parameters.extend(parameters::read(file)?);
                }
                "--log-level" => arguments.levels.push(level(value("a level")?)?),
                "--enable-rosout-logs" => arguments.is_without_rosout = false,
                "--disable-rosout-logs" => arguments.is_without_rosout = true,
                "--enable-stdout-logs" => arguments.is_without_console = false,
                "--disable-stdout-logs" => arguments.is_without_console = true,
                "-e" | "--enclave" => {
                    let form = "the name of an enclave, for example /robots/arm";
                    let name = value(form)?;
                    if name != "/" && !is_absolute_name(name) {
                        return Err(InvalidArgument::new(word, quoted(name), form));
                    }
                    arguments.enclave = Some(name.to_owned());
                }
                word if IGNORED_WITH_VALUE.contains(&word) => {
                    value("a file")?;
                }
                // May be repeated.
                "--ros-args" => {}
                word if IGNORED.contains(&word) => {}
                word => return Err(InvalidArgument::new("--ros-args", quoted(word), KNOWN)),
            }
        }
        Ok(arguments)
    }

    /// The arguments that apply to a node whose default name is `name`.
    pub fn node(&self, name: &str) -> RosNode {
        RosNode::new(self, name)
    }

    /// The levels as filter directives, each after a comma. Loggers named after the node stand for eddy; unknown names
    /// have no effect.
    pub(super) fn directives(&self, node: &RosNode) -> String {
        let target = |logger: &Option<String>| match logger {
            None => "eddy".to_owned(),
            Some(name) if node.is_logger(name) => "eddy".to_owned(),
            Some(name) => name.replace('.', "::"),
        };
        self.levels.iter().map(|(logger, level)| format!(",{}={level}", target(logger))).collect()
    }
}

/// `LEVEL` or `LOGGER:=LEVEL`.
fn level(text: &str) -> Result<(Option<String>, &'static str), InvalidArgument> {
    let invalid = |found: &str, expected: &str| {
        InvalidArgument::new(&format!("--log-level {text}"), quoted(found), expected)
    };
    let (logger, word) = match text.split_once(":=") {
        Some((logger, word)) => (Some(logger), word),
        None => (None, text),
    };
    // It becomes part of a filter directive.
    let is_name = |name: &str| {
        !name.is_empty() && name.chars().all(|c| c.is_ascii_alphanumeric() || "_.".contains(c))
    };
    if let Some(found) = logger.filter(|logger| !is_name(logger)) {
        return Err(invalid(found, "the name of a logger: letters, digits, _ and ."));
    }
    let known = LEVELS.into_iter().find(|(ros, _)| word.eq_ignore_ascii_case(ros));
    let (_, level) = known.ok_or_else(|| invalid(word, "debug, info, warn, error or fatal"))?;
    Ok((logger.map(str::to_owned), level))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<RosArguments, String> {
        let words: Vec<_> = text.split_whitespace().map(str::to_owned).collect();
        RosArguments::parse(&words).map_err(|error| error.to_string())
    }

    #[test]
    fn every_argument_has_a_long_and_a_short_name() {
        let short = parse("-r /a:=/b -p horizon:=3 --log-level debug").unwrap();
        let long =
            parse("--remap /a:=/b --param horizon:=3 --log-level DEBUG --enable-rosout-logs");
        // Both are parsed to the same.
        assert_eq!(short, long.unwrap());
        assert_eq!(parse("").unwrap(), RosArguments::default());
        let has_rosout = |text: &str| parse(text).unwrap().node("a").has_rosout();
        assert!(has_rosout("") && !has_rosout("--disable-rosout-logs"));
    }

    #[test]
    fn every_argument_of_rcl_is_accepted() {
        let all = "--log-config-file log.ini --log-file-name a --enable-stdout-logs --disable-external-lib-logs \
                   --enable-external-lib-logs --enable-rosout-logs --log-level info -r a:=b -p c:=1";
        parse(all).unwrap();
        let node = |text| parse(text).unwrap().node("a");
        assert_eq!(node("").console_filter("warn"), "warn");
        assert_eq!(node("--disable-stdout-logs --log-level info").console_filter("warn"), "off");
        let again = "--disable-stdout-logs --enable-stdout-logs";
        assert_eq!(node(again).console_filter("warn"), "warn");
        // Messages are still published.
        assert_eq!(node("--disable-stdout-logs").log_filter("eddy=info"), "eddy=info");
        let enclave = |text| node(text).transport_options().unwrap().enclave;
        assert_eq!(enclave(""), "/");
        assert_eq!(enclave("-e /a"), "/a");
        assert_eq!(enclave("--enclave /a -e /robots/arm"), "/robots/arm");
    }

    #[test]
    fn invalid_arguments_are_named() {
        for (text, expected) in [
            ("-r", "-r: found no value, expected FROM:=TO"),
            ("-x", "--ros-args: found `-x`, expected -r/--remap, -p/--param, --params-file"),
            ("--enclave a", "--enclave: found `a`, expected the name of an enclave"),
            ("-e", "-e: found no value, expected the name of an enclave"),
            ("--log-config-file", "--log-config-file: found no value, expected a file"),
            ("--disable-logs", "--ros-args: found `--disable-logs`, expected"),
            ("--log-level loud", "--log-level loud: found `loud`, expected debug, info, warn"),
            ("--log-level a=b:=info", "--log-level a=b:=info: found `a=b`, expected the name"),
            ("--params-file /no/file", "--params-file /no/file: found No such file"),
        ] {
            let message = parse(text).unwrap_err();
            assert!(message.starts_with(expected), "{message}");
        }
    }

    #[test]
    fn later_levels_of_a_logger_take_precedence() {
        let arguments =
            parse("--log-level info --log-level eddy_node:=debug --log-level a.b:=fatal");
        let node = arguments.as_ref().unwrap().node("eddy_node");
        assert_eq!(node.log_filter("warn"), "warn,eddy=info,eddy=debug,a::b=off");
    }
}
