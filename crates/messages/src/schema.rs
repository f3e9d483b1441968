//! Parses the `.msg` files, makes their schema text, and hashes them.
//!
//! Schema text is that of MCAP (`ros2msg`): the text of the message, then each dependency after a line of 80 `=` and a
//! line `MSG: package/Type` (MCAP specification, appendix "ros2msg").
//! The type hash is RIHS01: SHA-256 of the JSON type description (REP 2011, REP 2016).

use std::{collections::BTreeMap, sync::LazyLock};

use hiroz_schema::{
    FieldDescription, FieldTypeDescription, TypeDescription, TypeDescriptionMsg, TypeId,
    calculate_hash,
};

/// Description of a message type for other programs.
#[derive(Clone, Debug)]
pub struct TypeSupport {
    /// ROS 2 name, such as `eddy_msgs/msg/ParticleFrame`.
    pub name: String,
    /// The `.msg` text of the type and all its dependencies.
    pub schema: String,
    /// Type hash, `RIHS01_` and 64 hexadecimal digits.
    pub hash: String,
    /// The parsed type, and the referenced types sorted by name.
    pub description: TypeDescriptionMsg,
}

impl TypeSupport {
    /// A type that is not built in: only its name and its type hash (empty if unknown).
    pub fn foreign(name: &str, hash: &str) -> Self {
        let type_description = TypeDescription { type_name: name.to_owned(), fields: Vec::new() };
        Self {
            name: name.to_owned(),
            schema: String::new(),
            hash: hash.to_owned(),
            description: TypeDescriptionMsg {
                type_description,
                referenced_type_descriptions: Vec::new(),
            },
        }
    }
}

/// A message type that is not built in.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("message type: found {found}, expected one of {}", known_types().join(", "))]
pub struct UnknownType {
    /// The unknown name.
    pub found: String,
}

macro_rules! files {
    ($($folder:literal $name:literal),* $(,)?) => {
        [$(($name, include_str!(concat!("../msgs/", $folder, $name, ".msg")))),*]
    };
}

/// Names and texts of the built-in `.msg` files.
const FILES: [(&str, &str); 14] = files![
    "standard/" "builtin_interfaces/msg/Time",
    "standard/" "diagnostic_msgs/msg/DiagnosticArray",
    "standard/" "diagnostic_msgs/msg/DiagnosticStatus",
    "standard/" "diagnostic_msgs/msg/KeyValue",
    "" "eddy_msgs/msg/ParticleFrame",
    "" "eddy_msgs/msg/PredictionStatus",
    "standard/" "rcl_interfaces/msg/Parameter",
    "standard/" "rcl_interfaces/msg/ParameterEvent",
    "standard/" "rcl_interfaces/msg/ParameterValue",
    "standard/" "rosgraph_msgs/msg/Clock",
    "standard/" "sensor_msgs/msg/PointCloud2",
    "standard/" "sensor_msgs/msg/PointField",
    "standard/" "std_msgs/msg/Header",
    "standard/" "std_msgs/msg/String",
];

/// Names and texts of the `.msg` files of messages that are only fields of others.
const NESTED_FILES: [(&str, &str); 6] = files![
    "standard/" "rcl_interfaces/msg/FloatingPointRange",
    "standard/" "rcl_interfaces/msg/IntegerRange",
    "standard/" "rcl_interfaces/msg/ListParametersResult",
    "standard/" "rcl_interfaces/msg/ParameterDescriptor",
    "standard/" "rcl_interfaces/msg/SetParametersResult",
    "standard/" "service_msgs/msg/ServiceEventInfo",
];

static TYPES: LazyLock<BTreeMap<&'static str, TypeSupport>> =
    LazyLock::new(|| FILES.iter().map(|&(name, _)| (name, assemble(name))).collect());

/// The type support of a message type.
///
/// # Errors
/// [`UnknownType`] when the type is not built in.
pub fn type_support(name: &str) -> Result<&'static TypeSupport, UnknownType> {
    TYPES.get(name).ok_or_else(|| UnknownType { found: name.to_owned() })
}

fn known_types() -> Vec<&'static str> {
    FILES.iter().map(|(name, _)| *name).collect()
}

fn text_of(name: &str) -> &'static str {
    let (_, text) =
        FILES.iter().chain(&NESTED_FILES).find(|(known, _)| *known == name).unwrap_or_else(|| {
            panic!("msgs/ does not have {name}, which another message references")
        });
    text
}

fn assemble(name: &str) -> TypeSupport {
    let main = parse(name, text_of(name));
    let mut dependencies = BTreeMap::new();
    collect_dependencies(&main, &mut dependencies);

    let mut schema = text_of(name).to_owned();
    for dependency in dependencies.keys() {
        let short = dependency.replace("/msg/", "/");
        let separator = "=".repeat(80);
        schema.push_str(&format!("\n{separator}\nMSG: {short}\n{}", text_of(dependency)));
    }
    let description = TypeDescriptionMsg {
        type_description: main,
        referenced_type_descriptions: dependencies.into_values().collect(),
    };
    let hash = calculate_hash(&description).to_rihs_string();
    TypeSupport { name: name.to_owned(), schema, hash, description }
}

/// Adds all messages that `of` references, directly or indirectly.
pub(super) fn collect_dependencies(
    of: &TypeDescription,
    into: &mut BTreeMap<String, TypeDescription>,
) {
    for field in &of.fields {
        let name = &field.field_type.nested_type_name;
        if !name.is_empty() && !into.contains_key(name) {
            let dependency = parse(name, text_of(name));
            into.insert(name.clone(), dependency.clone());
            collect_dependencies(&dependency, into);
        }
    }
}

/// Parses the subset of the `.msg` language that the files use: comments, constants, fields of primitive, string or
/// message type, arrays and sequences; defaults are ignored.
pub(super) fn parse(name: &str, text: &str) -> TypeDescription {
    let package = name.split('/').next().unwrap_or_default();
    let fields = text
        .lines()
        .map(|line| line.split('#').next().unwrap_or_default().trim())
        // Constants have a `=` that is not part of `<=`.
        .filter(|line| !line.is_empty() && !line.replace("<=", "").contains('='))
        .map(|line| {
            let mut words = line.split_whitespace();
            let (Some(kind), Some(name_of_field)) = (words.next(), words.next()) else {
                panic!("{name}: found `{line}`, expected `type name`");
            };
            field(name_of_field, field_type(package, kind))
        })
        .collect();
    TypeDescription { type_name: name.to_owned(), fields }
}

pub(super) fn field(name: &str, field_type: FieldTypeDescription) -> FieldDescription {
    FieldDescription { name: name.to_owned(), field_type, default_value: String::new() }
}

fn field_type(package: &str, kind: &str) -> FieldTypeDescription {
    let number = |text: &str| {
        text.parse()
            .unwrap_or_else(|_| panic!("{package}: found `{kind}`, expected a number in it"))
    };
    let (element, offset, capacity) =
        match kind.strip_suffix(']').and_then(|kind| kind.split_once('[')) {
            None => (kind, 0, 0),
            Some((element, "")) => (element, TypeId::UNBOUNDED_SEQUENCE_OFFSET, 0),
            Some((element, bound)) => match bound.strip_prefix("<=") {
                Some(most) => (element, TypeId::BOUNDED_SEQUENCE_OFFSET, number(most)),
                None => (element, TypeId::ARRAY_OFFSET, number(bound)),
            },
        };
    let primitive = match element {
        "bool" => TypeId::BOOL,
        "byte" => TypeId::BYTE,
        "uint8" | "char" => TypeId::UINT8,
        "int32" => TypeId::INT32,
        "uint32" => TypeId::UINT32,
        "int64" => TypeId::INT64,
        "uint64" => TypeId::UINT64,
        "float32" => TypeId::FLOAT32,
        "float64" => TypeId::FLOAT64,
        "string" => TypeId::STRING,
        message => {
            let full = match message.split_once('/') {
                Some((package, message)) => format!("{package}/msg/{message}"),
                None => format!("{package}/msg/{message}"),
            };
            let kind = TypeId::NESTED_TYPE + offset;
            return FieldTypeDescription::nested_array(kind, capacity, full);
        }
    };
    FieldTypeDescription::array(primitive + offset, capacity)
}

#[cfg(test)]
mod tests {
    use std::{fs, path::Path};

    use serde::de::DeserializeOwned;
    use serde_reflection::{ContainerFormat, Format, Registry, Samples, Tracer, TracerConfig};

    use super::*;
    use crate::{
        Clock, DiagnosticArray, Message, ParameterEvent, ParticleFrame, PointCloud2,
        PredictionStatus, RosString,
    };

    #[test]
    fn the_hash_of_a_standard_message_is_the_published_one() {
        // ros2 topic info --verbose, Jazzy.
        for (name, hash) in [
            (RosString::TYPE, "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"),
            (PointCloud2::TYPE, "9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5"),
            (
                ParameterEvent::TYPE,
                "043e627780fcad87a22d225bc2a037361dba713fca6a6b9f4b869a5aa0393204",
            ),
        ] {
            assert_eq!(type_support(name).unwrap().hash, format!("RIHS01_{hash}"), "{name}");
        }
    }

    #[test]
    fn an_unknown_type_is_rejected_with_the_known_ones() {
        let message = type_support("sensor_msgs/msg/Imu").unwrap_err().to_string();
        assert!(message.starts_with("message type: found sensor_msgs/msg/Imu, expected one of"));
        assert!(message.contains("eddy_msgs/msg/ParticleFrame"));
    }

    #[test]
    fn every_file_of_the_package_is_built_in() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("msgs/eddy_msgs/msg");
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            let name = format!("eddy_msgs/msg/{}", path.file_stem().unwrap().to_str().unwrap());
            assert_eq!(text_of(&name), fs::read_to_string(&path).unwrap());
        }
    }

    #[test]
    fn the_schema_text_has_each_dependency_once() {
        let schema = &type_support("eddy_msgs/msg/ParticleFrame").unwrap().schema;
        assert_eq!(schema.matches("MSG: std_msgs/Header\n").count(), 1);
        assert_eq!(schema.matches("MSG: builtin_interfaces/Time\n").count(), 1);
    }

    #[test]
    fn structs_and_files_have_the_same_fields() {
        agree::<ParticleFrame>();
        agree::<PredictionStatus>();
        agree::<DiagnosticArray>();
        agree::<Clock>();
        agree::<ParameterEvent>();
        agree::<PointCloud2>();
        agree::<RosString>();
    }

    fn agree<M: Message + DeserializeOwned>() {
        let mut tracer = Tracer::new(TracerConfig::default());
        tracer.trace_type::<M>(&Samples::new()).unwrap();
        let registry = tracer.registry().unwrap();
        let support = type_support(M::TYPE).unwrap();
        let referred = &support.description.referenced_type_descriptions;
        for description in referred.iter().chain([&support.description.type_description]) {
            assert_eq!(
                fields_of_struct(&registry, &description.type_name),
                fields_of_file(description)
            );
        }
    }

    fn struct_name(type_name: &str) -> &str {
        match type_name.rsplit('/').next().unwrap() {
            "String" => "RosString",
            short => short,
        }
    }

    fn fields_of_struct(registry: &Registry, type_name: &str) -> Vec<(String, String)> {
        let name = struct_name(type_name);
        let ContainerFormat::Struct(fields) = &registry[name] else {
            panic!("{name} is not a struct with named fields");
        };
        fields.iter().map(|field| (field.name.clone(), format!("{:?}", field.value))).collect()
    }

    fn fields_of_file(description: &TypeDescription) -> Vec<(String, String)> {
        description
            .fields
            .iter()
            .map(|field| {
                let kind = &field.field_type;
                let element = match TypeId::base_type(kind.type_id) {
                    TypeId::NESTED_TYPE => {
                        Format::TypeName(struct_name(&kind.nested_type_name).into())
                    }
                    TypeId::BYTE | TypeId::UINT8 => Format::U8,
                    TypeId::BOOL => Format::Bool,
                    TypeId::INT32 => Format::I32,
                    TypeId::UINT32 => Format::U32,
                    TypeId::INT64 => Format::I64,
                    TypeId::UINT64 => Format::U64,
                    TypeId::FLOAT32 => Format::F32,
                    TypeId::FLOAT64 => Format::F64,
                    TypeId::STRING => Format::Str,
                    other => panic!("{}: type id {other} has no Rust type", field.name),
                };
                let format = if TypeId::is_unbounded_sequence(kind.type_id) {
                    Format::Seq(Box::new(element))
                } else {
                    element
                };
                (field.name.clone(), format!("{format:?}"))
            })
            .collect()
    }
}
