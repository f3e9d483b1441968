//! The parameters of a node: one table of what each is called, may be, and does.

use std::ops::RangeInclusive;

use super::{InvalidSettings, NodeSettings, Publish};
use eddy_messages::services::{
    IntegerRange, Parameter, ParameterDescriptor, ParameterKind, ParameterValue,
};

/// A parameter of every node.
pub struct ParameterSpec {
    /// Its name: that of the field of [`NodeSettings`].
    pub name: &'static str,
    /// What it does.
    pub description: &'static str,
    /// What it may be.
    pub values: Values,
    /// Whether it counts at the start only.
    pub read_only: bool,
    get: fn(&NodeSettings) -> ParameterValue,
    /// Takes a value that was checked.
    set: fn(&mut NodeSettings, &ParameterValue),
}

/// What a parameter may be.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Values {
    /// True or false.
    Bool,
    /// A whole number.
    Integer(RangeInclusive<i64>),
    /// One of these words.
    Word(&'static [&'static str]),
}

impl Values {
    /// The kind of the value.
    pub fn kind(&self) -> ParameterKind {
        match self {
            Self::Bool => ParameterKind::Bool,
            Self::Integer(_) => ParameterKind::Integer,
            Self::Word(_) => ParameterKind::String,
        }
    }
}

/// Everything that can be asked of a node, in the order in which it is listed.
pub static PARAMETERS: [ParameterSpec; 8] = [
    ParameterSpec {
        name: "horizon",
        description: "frames predicted ahead of each observed frame",
        values: Values::Integer(1..=10_000),
        read_only: false,
        get: |settings| ParameterValue::integer(settings.horizon.into()),
        set: |settings, value| settings.horizon = value.integer_value as u32,
    },
    ParameterSpec {
        name: "publish",
        description: "which of the frames up to the horizon are published",
        values: Values::Word(&Publish::NAMES),
        read_only: false,
        get: |settings| ParameterValue::string(settings.publish.name().to_owned()),
        set: |settings, value| {
            settings.publish = Publish::named(&value.string_value).unwrap_or_default();
        },
    },
    ParameterSpec {
        name: "free_run",
        description: "frames observed of a stream before it is simulated alone; 0: observe for ever",
        values: Values::Integer(0..=i64::MAX),
        read_only: false,
        get: |settings| integer(settings.free_run.unwrap_or(0)),
        set: |settings, value| {
            settings.free_run =
                u64::try_from(value.integer_value).ok().filter(|&frames| frames > 0);
        },
    },
    ParameterSpec {
        name: "max_gap",
        description: "missing frames that the model fills with its own prediction; more reset the stream",
        values: Values::Integer(0..=1_000),
        read_only: false,
        get: |settings| integer(settings.max_gap),
        set: |settings, value| settings.max_gap = value.integer_value as u64,
    },
    ParameterSpec {
        name: "max_streams",
        description: "streams kept at the same time; of more the least recently used goes",
        values: Values::Integer(1..=65_536),
        read_only: false,
        get: |settings| integer(settings.max_streams as u64),
        set: |settings, value| settings.max_streams = value.integer_value as usize,
    },
    ParameterSpec {
        name: "queue",
        description: "frames that wait for the model",
        values: Values::Integer(1..=65_536),
        read_only: true,
        get: |settings| integer(settings.queue as u64),
        set: |settings, value| settings.queue = value.integer_value as usize,
    },
    ParameterSpec {
        name: "cloud",
        description: "whether observed and predicted frames are also published as sensor_msgs/PointCloud2",
        values: Values::Bool,
        read_only: true,
        get: |settings| ParameterValue::bool(settings.cloud),
        set: |settings, value| settings.cloud = value.bool_value,
    },
    ParameterSpec {
        name: "use_sim_time",
        description: "whether free runs and stamps follow /clock",
        values: Values::Bool,
        read_only: false,
        get: |settings| ParameterValue::bool(settings.use_sim_time),
        set: |settings, value| settings.use_sim_time = value.bool_value,
    },
];

/// The parameter of this name.
pub fn parameter(name: &str) -> Option<&'static ParameterSpec> {
    PARAMETERS.iter().find(|spec| spec.name == name)
}

/// What is more than ROS can tell is its largest number.
fn integer(value: u64) -> ParameterValue {
    ParameterValue::integer(i64::try_from(value).unwrap_or(i64::MAX))
}

impl ParameterSpec {
    /// Its value.
    pub fn get(&self, settings: &NodeSettings) -> ParameterValue {
        (self.get)(settings)
    }

    /// Checks a value for it.
    ///
    /// # Errors
    /// [`InvalidSettings`] with what was found and what was expected.
    pub fn check(&self, value: &ParameterValue) -> Result<(), InvalidSettings> {
        let (field, expected) = (self.name, self.values.kind());
        if value.kind != expected as u8 {
            let found = value.kind().map_or("a value of no kind", ParameterKind::name);
            return Err(InvalidSettings::Kind { field, found, expected: expected.name() });
        }
        match &self.values {
            Values::Bool => Ok(()),
            Values::Integer(range) if range.contains(&value.integer_value) => Ok(()),
            Values::Integer(range) => Err(InvalidSettings::Range {
                field,
                found: value.integer_value,
                range: range.clone(),
            }),
            Values::Word(words) if words.contains(&value.string_value.as_str()) => Ok(()),
            Values::Word(words) => Err(InvalidSettings::Word {
                field,
                found: value.string_value.clone(),
                expected: words.join(" or "),
            }),
        }
    }

    /// As ROS describes parameters.
    pub fn descriptor(&self) -> ParameterDescriptor {
        let Self { name, description, values, read_only, .. } = self;
        let mut descriptor = ParameterDescriptor {
            name: (*name).to_owned(),
            kind: values.kind() as u8,
            description: (*description).to_owned(),
            read_only: *read_only,
            ..ParameterDescriptor::default()
        };
        match values {
            Values::Bool => {}
            Values::Integer(range) => {
                let (from_value, to_value) = (*range.start(), *range.end());
                descriptor.integer_range = vec![IntegerRange { from_value, to_value, step: 1 }];
            }
            Values::Word(words) => descriptor.additional_constraints = words.join(" or "),
        }
        descriptor
    }
}

impl NodeSettings {
    /// Sets a parameter of a node that has not started yet.
    ///
    /// # Errors
    /// [`InvalidSettings`] when there is no such parameter, or its value is none for it; then nothing
    /// changes.
    pub fn set(&mut self, Parameter { name, value }: &Parameter) -> Result<(), InvalidSettings> {
        let spec =
            parameter(name).ok_or_else(|| InvalidSettings::Unknown { found: name.clone() })?;
        spec.check(value)?;
        (spec.set)(self, value);
        Ok(())
    }

    /// Sets a parameter of a node that runs.
    ///
    /// # Errors
    /// As [`NodeSettings::set`]; also when it can only be set at the start.
    pub fn set_running(&mut self, wanted: &Parameter) -> Result<(), InvalidSettings> {
        match parameter(&wanted.name) {
            Some(ParameterSpec { name: field, read_only: true, .. }) => {
                Err(InvalidSettings::ReadOnly { field })
            }
            _ => self.set(wanted),
        }
    }

    /// All parameters.
    pub fn parameters(&self) -> Vec<Parameter> {
        let named = |spec: &ParameterSpec| (spec.name.to_owned(), spec.get(self));
        PARAMETERS.iter().map(named).map(|(name, value)| Parameter { name, value }).collect()
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
            queue: 8,
            cloud: true,
            use_sim_time: true,
        };
        let mut other = NodeSettings::default();
        for parameter in settings.parameters() {
            assert!(!other.parameters().contains(&parameter), "{parameter:?} says nothing");
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
    fn what_cannot_be_set_is_named_with_found_and_expected() {
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
            ("cloud", ParameterValue::integer(1), "cloud: found an integer, expected a bool"),
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
        assert_eq!(message, "queue: found a value of no kind, expected an integer");
        assert_eq!(settings, NodeSettings::default());
    }

    #[test]
    fn read_only_parameters_count_at_the_start_only() {
        let mut settings = NodeSettings::default();
        let queue = of("queue", ParameterValue::integer(3));
        let message = settings.set_running(&queue).unwrap_err().to_string();
        assert_eq!(
            message,
            "queue: found a value for a running node, expected it at the start (read-only)"
        );
        settings.set(&queue).unwrap();
        assert_eq!(settings.queue, 3);
        assert!(PARAMETERS.iter().any(|spec| spec.descriptor().read_only));
    }
}
