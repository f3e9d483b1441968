//! The table of the node's settings. Fields, defaults, ROS parameters, command-line options, the keys of settings files
//! and their documentation are derived from it.

use std::ops::RangeInclusive;

use serde::Deserialize;

use super::parameter::{Setting, Values};
use eddy_messages::services::{
    FloatingPointRange, IntegerRange, Parameter, ParameterDescriptor, ParameterKind, ParameterValue,
};
use eddy_settings::near;
use eddy_transport::is_name_token;

/// Which of the frames up to the horizon are published.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Publish {
    /// The frame at the horizon.
    #[default]
    Last,
    /// Every frame up to the horizon.
    All,
}

impl Publish {
    const WORDS: [(&str, &str); 2] =
        [("last", "The frame at the horizon"), ("all", "Every frame up to the horizon")];

    /// The word in files and parameters.
    pub fn name(self) -> &'static str {
        Self::WORDS[self as usize].0
    }
}

impl Setting for Publish {
    fn to_parameter(&self) -> ParameterValue {
        ParameterValue::string(self.name().to_owned())
    }

    fn from_parameter(value: &ParameterValue) -> Self {
        let named = |publish: &Self| publish.name() == value.string_value;
        [Self::Last, Self::All].into_iter().find(named).unwrap_or_default()
    }
}

/// A row of the table.
pub struct ParameterSpec {
    /// Name of the field of [`NodeSettings`], of the ROS parameter and of the key in settings files.
    pub name: &'static str,
    /// What it does.
    pub help: &'static str,
    /// What it may be.
    pub values: Values,
    /// Whether it can only be set before the node starts.
    pub read_only: bool,
    get: fn(&NodeSettings) -> ParameterValue,
    /// Takes a checked value.
    set: fn(&mut NodeSettings, &ParameterValue),
}

const CHANGEABLE: bool = false;
const READ_ONLY: bool = true;

const fn whole(range: RangeInclusive<i64>, unit: &'static str) -> Values {
    Values::Integer { range, unit }
}

macro_rules! node_settings {
    ($($name:ident: $kind:ty = $default:expr, $values:expr, $read_only:expr, $help:literal;)*) => {
        /// Settings of a [`SurrogateNode`](super::SurrogateNode), each a ROS parameter of the same name.
        #[derive(Clone, Debug, PartialEq, Deserialize)]
        #[serde(default, deny_unknown_fields)]
        pub struct NodeSettings {
            $(#[doc = $help] pub $name: $kind,)*
        }

        impl Default for NodeSettings {
            fn default() -> Self {
                Self { $($name: $default,)* }
            }
        }

        /// All settings, in the order in which they are listed.
        pub static PARAMETERS: &[ParameterSpec] = &[
            $(ParameterSpec {
                name: stringify!($name),
                help: $help,
                values: $values,
                read_only: $read_only,
                get: |settings| settings.$name.to_parameter(),
                set: |settings, value| settings.$name = <$kind>::from_parameter(value),
            },)*
        ];
    };
}

node_settings! {
    horizon: u32 = 1, whole(1..=10_000, "frames"), CHANGEABLE,
        "Frames to predict ahead of each observed frame; each costs as much as one";
    publish: Publish = Publish::Last, Values::Word(&Publish::WORDS), CHANGEABLE,
        "Which of the frames up to the horizon to publish";
    free_run: Option<u64> = None, whole(0..=i64::MAX, "frames"), CHANGEABLE,
        "Observe this many frames of a stream, then simulate it without further input; 0 never stops observing";
    max_gap: u64 = 3, whole(0..=1_000, "frames"), CHANGEABLE,
        "Longest gap in a stream that the model fills with its own predictions; a longer one resets the stream";
    max_streams: usize = 64, whole(1..=65_536, "streams"), CHANGEABLE,
        "Streams to keep at the same time; the least recently used one is forgotten";
    max_expected_error: Option<f64> = None, Values::Number { range: 0.0..=1e6, unit: "domain lengths" }, CHANGEABLE,
        "Report WARN on /diagnostics if the position error of a prediction is expected to be larger; 0 never does; the checkpoint must be calibrated (eddy calibrate)";
    stiffness: Option<f64> = None, Values::Number { range: 0.0..=1e9, unit: "(density x velocity^2)" }, READ_ONLY,
        "Young's modulus of all streams, for a checkpoint that is conditioned on the stiffness; 0: what the bag states (eddy predict), otherwise what the checkpoint assumes";
    queue: usize = 64, whole(1..=65_536, "frames"), READ_ONLY,
        "Frames that may wait for the model";
    cloud: bool = false, Values::Bool, READ_ONLY,
        "Also publish observed and predicted frames as sensor_msgs/PointCloud2 on INPUT/cloud and OUTPUT/cloud";
    use_sim_time: bool = false, Values::Bool, CHANGEABLE,
        "Take the time of free runs and of the node's own stamps from /clock";
    group: String = String::new(), Values::Name, READ_ONLY,
        "Name of the group of nodes that share the streams of a zenoh input, each stream predicted by one of them";
}

/// A setting that cannot be used.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[expect(missing_docs, reason = "the message says what the fields are")]
pub enum InvalidSettings {
    /// There is no parameter of this name.
    #[error(
        "parameter: found {found}, expected one of {}{}",
        names().collect::<Vec<_>>().join(", "),
        near::hint(found, names())
    )]
    Unknown { found: String },
    /// The value has the wrong type.
    #[error("{field}: found {found}, expected {expected}")]
    Kind { field: &'static str, found: &'static str, expected: &'static str },
    /// The value is out of range.
    #[error("{field}: found {found}, expected {} to {}", range.start(), range.end())]
    Range { field: &'static str, found: i64, range: RangeInclusive<i64> },
    /// The number is out of range, or not finite.
    #[error("{field}: found {found}, expected {} to {}", range.start(), range.end())]
    NumberRange { field: &'static str, found: f64, range: RangeInclusive<f64> },
    /// The value is no name, or none of the words of this parameter.
    #[error("{field}: found `{found}`, expected {expected}")]
    Word { field: &'static str, found: String, expected: String },
    /// `/clock` cannot be subscribed to.
    #[error("use_sim_time: cannot subscribe to /clock: {reason}")]
    Clock { reason: String },
    /// The checkpoint is conditioned on the stiffness, which is missing, or does not use it.
    #[error("{reason}")]
    Stiffness { reason: String },
    /// The parameter cannot be changed while the node runs.
    #[error("{field}: read-only while the node runs; set it at the start")]
    ReadOnly { field: &'static str },
}

fn names() -> impl Iterator<Item = &'static str> {
    PARAMETERS.iter().map(|spec| spec.name)
}

/// The parameter of this name.
pub fn parameter(name: &str) -> Option<&'static ParameterSpec> {
    PARAMETERS.iter().find(|spec| spec.name == name)
}

impl ParameterSpec {
    /// Its value in `settings`.
    pub fn get(&self, settings: &NodeSettings) -> ParameterValue {
        (self.get)(settings)
    }

    /// Checks type and range of a value.
    ///
    /// # Errors
    /// [`InvalidSettings`] with the value found and the values expected.
    pub fn check(&self, value: &ParameterValue) -> Result<(), InvalidSettings> {
        let (field, expected) = (self.name, self.values.kind());
        if value.kind != expected as u8 {
            let found = value.kind().map_or("a value of unknown type", ParameterKind::name);
            return Err(InvalidSettings::Kind { field, found, expected: expected.name() });
        }
        let found = value.integer_value;
        match &self.values {
            Values::Integer { range, .. } if !range.contains(&found) => {
                Err(InvalidSettings::Range { field, found, range: range.clone() })
            }
            Values::Number { range, .. } if !range.contains(&value.double_value) => {
                let (found, range) = (value.double_value, range.clone());
                Err(InvalidSettings::NumberRange { field, found, range })
            }
            Values::Name
                if !value.string_value.is_empty() && !is_name_token(&value.string_value) =>
            {
                let (found, expected) = (value.string_value.clone(), self.values.words());
                Err(InvalidSettings::Word { field, found, expected })
            }
            Values::Word(words) if words.iter().all(|(word, _)| *word != value.string_value) => {
                let (found, expected) = (value.string_value.clone(), self.values.words());
                Err(InvalidSettings::Word { field, found, expected })
            }
            _ => Ok(()),
        }
    }

    /// The description for ROS.
    pub fn descriptor(&self) -> ParameterDescriptor {
        let Self { name, help, values, read_only, .. } = self;
        let integer_range = match values {
            Values::Integer { range, .. } => {
                vec![IntegerRange { from_value: *range.start(), to_value: *range.end(), step: 1 }]
            }
            _ => Vec::new(),
        };
        let floating_point_range = match values {
            Values::Number { range, .. } => {
                let (from_value, to_value) = (*range.start(), *range.end());
                vec![FloatingPointRange { from_value, to_value, step: 0.0 }]
            }
            _ => Vec::new(),
        };
        ParameterDescriptor {
            name: (*name).to_owned(),
            kind: values.kind() as u8,
            description: (*help).to_owned(),
            additional_constraints: values.words(),
            read_only: *read_only,
            integer_range,
            floating_point_range,
            ..ParameterDescriptor::default()
        }
    }
}

impl NodeSettings {
    /// Checks all ranges.
    ///
    /// # Errors
    /// [`InvalidSettings`] with the first setting that is out of range.
    pub fn check(&self) -> Result<(), InvalidSettings> {
        // 0 stands for `None` in a parameter; in a settings file, leaving the key out does.
        if self.free_run == Some(0) {
            let range = 1..=i64::MAX;
            return Err(InvalidSettings::Range { field: "free_run", found: 0, range });
        }
        PARAMETERS.iter().try_for_each(|spec| spec.check(&spec.get(self)))
    }

    /// Sets a parameter of a node that has not started.
    ///
    /// # Errors
    /// [`InvalidSettings`] when the parameter is unknown or the value invalid; then nothing changes.
    pub fn set(&mut self, Parameter { name, value }: &Parameter) -> Result<(), InvalidSettings> {
        let spec =
            parameter(name).ok_or_else(|| InvalidSettings::Unknown { found: name.clone() })?;
        let value = spec.values.with_kind(value);
        spec.check(&value)?;
        (spec.set)(self, &value);
        Ok(())
    }

    /// Sets a parameter of a running node.
    ///
    /// # Errors
    /// As [`NodeSettings::set`]; also when the parameter is read-only.
    pub fn set_running(&mut self, wanted: &Parameter) -> Result<(), InvalidSettings> {
        match parameter(&wanted.name) {
            Some(ParameterSpec { name: field, read_only: true, .. }) => {
                Err(InvalidSettings::ReadOnly { field })
            }
            _ => self.set(wanted),
        }
    }

    /// The stiffness for the model.
    pub(super) fn stream_stiffness(&self) -> Option<f32> {
        self.stiffness.map(|stiffness| stiffness as f32)
    }

    /// All parameters with their values.
    pub fn parameters(&self) -> Vec<Parameter> {
        let named =
            |spec: &ParameterSpec| Parameter { name: spec.name.to_owned(), value: spec.get(self) };
        PARAMETERS.iter().map(named).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(name: &str, value: ParameterValue) -> Parameter {
        Parameter { name: name.to_owned(), value }
    }

    #[test]
    fn every_setting_is_a_parameter_and_comes_back_as_it_was_set() {
        let settings = NodeSettings {
            horizon: 7,
            publish: Publish::All,
            free_run: Some(9),
            max_gap: 5,
            max_streams: 6,
            max_expected_error: Some(0.25),
            stiffness: Some(3e4),
            queue: 8,
            cloud: true,
            use_sim_time: true,
            group: "robots".to_owned(),
        };
        let mut other = NodeSettings::default();
        for parameter in settings.parameters() {
            assert!(!other.parameters().contains(&parameter), "{parameter:?} is the default");
            other.set(&parameter).unwrap();
        }
        assert_eq!(other, settings);
        assert_eq!(other.check(), Ok(()));
    }

    #[test]
    fn defaults_are_in_their_ranges() {
        assert_eq!(NodeSettings::default().check(), Ok(()));
    }

    #[test]
    fn a_value_that_cannot_be_set_is_named_with_the_values_expected() {
        let mut settings = NodeSettings::default();
        for (name, value, expected) in [
            ("horizon", ParameterValue::integer(0), "horizon: found 0, expected 1 to 10000"),
            (
                "horizon",
                ParameterValue::double(2.0),
                "horizon: found a double, expected an integer",
            ),
            (
                "publish",
                ParameterValue::string("first".into()),
                "publish: found `first`, expected last or all",
            ),
            (
                "group",
                ParameterValue::string("a/b".into()),
                "group: found `a/b`, expected a name of letters, digits and _, or nothing",
            ),
            ("cloud", ParameterValue::integer(1), "cloud: found an integer, expected a bool"),
            (
                "max_expected_error",
                ParameterValue::double(f64::NAN),
                "max_expected_error: found NaN, expected 0 to 1000000",
            ),
            (
                "max_expected_error",
                ParameterValue::integer(-1),
                "max_expected_error: found -1, expected 0 to 1000000",
            ),
            (
                "stiffness",
                ParameterValue::double(f64::INFINITY),
                "stiffness: found inf, expected 0 to 1000000000",
            ),
            (
                "stiffness",
                ParameterValue::double(-1e4),
                "stiffness: found -10000, expected 0 to 1000000000",
            ),
            ("max_gap", ParameterValue::integer(-1), "max_gap: found -1, expected 0 to 1000"),
            (
                "depth",
                ParameterValue::integer(1),
                "parameter: found depth, expected one of horizon, publish, ",
            ),
        ] {
            let message = settings.set(&of(name, value)).unwrap_err().to_string();
            assert!(message.starts_with(expected), "{message}");
        }
        let odd = ParameterValue { kind: 77, ..ParameterValue::default() };
        let message = settings.set(&of("queue", odd)).unwrap_err().to_string();
        assert_eq!(message, "queue: found a value of unknown type, expected an integer");
        assert_eq!(settings, NodeSettings::default());
    }

    #[test]
    fn a_number_may_be_whole_and_0_is_off() {
        let mut settings = NodeSettings::default();
        settings.set(&of("max_expected_error", ParameterValue::integer(2))).unwrap();
        assert_eq!(settings.max_expected_error, Some(2.0));
        settings.set(&of("max_expected_error", ParameterValue::integer(0))).unwrap();
        assert_eq!(settings.max_expected_error, None);
        let file: NodeSettings = toml::from_str("max_expected_error = 0").unwrap();
        assert_eq!(file.check(), Ok(()));
    }

    #[test]
    fn read_only_parameters_can_be_set_at_the_start_only() {
        let mut settings = NodeSettings::default();
        let queue = of("queue", ParameterValue::integer(3));
        let message = settings.set_running(&queue).unwrap_err().to_string();
        assert_eq!(message, "queue: read-only while the node runs; set it at the start");
        settings.set(&queue).unwrap();
        assert_eq!(settings.queue, 3);
        assert!(PARAMETERS.iter().any(|spec| spec.descriptor().read_only));
    }
}
