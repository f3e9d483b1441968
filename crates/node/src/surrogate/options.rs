//! Settings as command-line options.

use clap::{
    Arg, ArgAction, ArgMatches, Args, Command, Error, FromArgMatches,
    builder::{PossibleValue, PossibleValuesParser},
    value_parser,
};

use super::{NodeSettings, ParameterSpec, Values, parameter};
use eddy_messages::services::{Parameter, ParameterValue};

/// Options of a node that runs: parameter and option.
const LIVE: &[(&str, &str)] = &[
    ("horizon", "horizon"),
    ("publish", "publish"),
    ("free_run", "free-run"),
    ("stiffness", "stiffness"),
    ("cloud", "cloud"),
    ("group", "group"),
];
/// Options of the node's code over a bag.
const OFFLINE: &[(&str, &str)] =
    &[("horizon", "horizon"), ("publish", "publish"), ("stiffness", "stiffness")];

/// The settings that were given on the command line.
#[derive(Clone, Debug)]
pub struct SettingOptions<const IS_LIVE: bool>(Vec<Parameter>);

/// Options of `eddy node`.
pub type NodeOptions = SettingOptions<true>;
/// Options of `eddy predict`.
pub type PredictOptions = SettingOptions<false>;

impl<const IS_LIVE: bool> SettingOptions<IS_LIVE> {
    fn specs() -> impl Iterator<Item = (&'static ParameterSpec, &'static str)> {
        let options = if IS_LIVE { LIVE } else { OFFLINE };
        options.iter().filter_map(|&(name, option)| Some((parameter(name)?, option)))
    }

    /// The given settings, in the order of the table.
    pub fn parameters(&self) -> &[Parameter] {
        &self.0
    }
}

impl<const IS_LIVE: bool> Args for SettingOptions<IS_LIVE> {
    fn augment_args(command: Command) -> Command {
        command.args(Self::specs().map(|(spec, option)| argument(spec, option)))
    }

    fn augment_args_for_update(command: Command) -> Command {
        Self::augment_args(command)
    }
}

impl<const IS_LIVE: bool> FromArgMatches for SettingOptions<IS_LIVE> {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, Error> {
        let given = |(spec, _): (&ParameterSpec, _)| {
            let value = match spec.values {
                Values::Bool => {
                    Some(ParameterValue::bool(true)).filter(|_| matches.get_flag(spec.name))
                }
                Values::Integer { .. } => {
                    matches.get_one(spec.name).copied().map(ParameterValue::integer)
                }
                Values::Number { .. } => {
                    matches.get_one(spec.name).copied().map(ParameterValue::double)
                }
                Values::Name | Values::Word(_) => {
                    matches.get_one(spec.name).cloned().map(ParameterValue::string)
                }
            };
            Some(Parameter { name: spec.name.to_owned(), value: value? })
        };
        Ok(Self(Self::specs().filter_map(given).collect()))
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), Error> {
        *self = Self::from_arg_matches(matches)?;
        Ok(())
    }
}

/// A setting as an option. Its default is only shown: a settings file may have another.
fn argument(spec: &ParameterSpec, option: &'static str) -> Arg {
    let argument = Arg::new(spec.name).long(option);
    let default = spec.get(&NodeSettings::default());
    match &spec.values {
        Values::Bool => argument.action(ArgAction::SetTrue).help(spec.help),
        Values::Integer { .. } => argument
            .value_parser(value_parser!(i64))
            .value_name("N")
            .help(format!("{} [default: {}]", spec.help, default.integer_value)),
        Values::Number { unit, .. } => {
            let unit = unit.trim_matches(['(', ')']);
            argument
                .value_parser(value_parser!(f64))
                .value_name("X")
                .help(format!("{} ({unit}) [default: {}]", spec.help, default.double_value))
        }
        Values::Name => argument.value_name("NAME").help(format!("{} [default: none]", spec.help)),
        Values::Word(words) => {
            let words = words.iter().map(|(word, help)| PossibleValue::new(*word).help(*help));
            argument
                .value_parser(PossibleValuesParser::new(words))
                .value_name("FRAMES")
                .help(format!("{} [default: {}]", spec.help, default.string_value))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Publish;

    fn given(words: &[&str]) -> Vec<Parameter> {
        let command = NodeOptions::augment_args(Command::new("node"));
        let matches = command.try_get_matches_from([&["node"], words].concat()).unwrap();
        NodeOptions::from_arg_matches(&matches).unwrap().0
    }

    #[test]
    fn options_set_what_they_name_and_nothing_else() {
        assert_eq!(given(&[]), []);
        let mut settings = NodeSettings::default();
        let words =
            ["--horizon", "7", "--publish", "all", "--free-run", "9", "--cloud", "--group", "a"];
        given(&words).iter().try_for_each(|parameter| settings.set(parameter)).unwrap();
        let expected = NodeSettings {
            horizon: 7,
            publish: Publish::All,
            free_run: Some(9),
            cloud: true,
            group: "a".to_owned(),
            ..NodeSettings::default()
        };
        assert_eq!(settings, expected);
    }
}
