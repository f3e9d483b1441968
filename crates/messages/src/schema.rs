//! The type of a topic for other programs: its definition as MCAP stores it, and its type hash.
//!
//! The type hash is RIHS01: SHA-256 of the JSON type description (REP 2011, REP 2016).

use std::{
    borrow::Cow,
    collections::{BTreeMap, btree_map::Entry},
    sync::{LazyLock, OnceLock},
};

use hiroz_schema::{TypeDescription, TypeDescriptionMsg, calculate_hash};

use super::{
    definition::{InvalidDefinition, full_name, parse, parts, render, short_name},
    library, service_type,
};

/// Description of a message type for other programs.
#[derive(Clone, Debug)]
pub struct TypeSupport {
    /// ROS 2 name, such as `eddy_msgs/msg/ParticleFrame`.
    pub name: String,
    /// The `.msg` text of the type and all its dependencies; empty if unknown.
    pub schema: String,
    /// Type hash, `RIHS01_` and 64 hexadecimal digits; empty if unknown.
    pub hash: String,
    /// The parsed type, and the referenced types sorted by name.
    pub description: TypeDescriptionMsg,
}

impl TypeSupport {
    /// A type without a definition: only its name and its type hash (empty if unknown).
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

    /// The type `name` from `.msg` texts: `text_of` returns that of a full name such as `std_msgs/msg/Header`.
    ///
    /// # Errors
    /// [`InvalidDefinition`] when a text is missing or is not a definition.
    pub fn from_texts<'t>(
        name: &str,
        text_of: &dyn Fn(&str) -> Option<Cow<'t, str>>,
    ) -> Result<Self, InvalidDefinition> {
        let missing = |type_name: &str| InvalidDefinition::Missing {
            type_name: type_name.to_owned(),
            of: name.to_owned(),
        };
        let text = text_of(name).ok_or_else(|| missing(name))?;
        let main = parse(name, &text)?;
        let mut dependencies = BTreeMap::new();
        let mut open = references(&main);
        while let Some(dependency) = open.pop() {
            if let Entry::Vacant(entry) = dependencies.entry(dependency) {
                let dependency = entry.key();
                let text = text_of(dependency).ok_or_else(|| missing(dependency))?;
                let parsed = parse(dependency, &text)?;
                open.extend(references(&parsed));
                entry.insert((text, parsed));
            }
        }
        let mut schema = written(&text, &main);
        for (dependency, (text, parsed)) in &dependencies {
            let (separator, short) = ("=".repeat(80), short_name(dependency));
            schema.push_str(&format!("\n{separator}\nMSG: {short}\n{}", written(text, parsed)));
        }
        let dependencies = dependencies.into_values().map(|(_, parsed)| parsed).collect();
        Ok(Self::new(schema, main, dependencies))
    }

    /// The type `name` from a `ros2msg` text, as in MCAP files. Dependencies that the text lacks are taken from the
    /// built-in types.
    ///
    /// # Errors
    /// As [`TypeSupport::from_texts`].
    pub fn from_schema(name: &str, schema: &str) -> Result<Self, InvalidDefinition> {
        let mut texts: BTreeMap<_, _> = parts(schema)
            .into_iter()
            .map(|(part, text)| (part.map_or_else(|| name.to_owned(), full_name), text))
            .collect();
        if texts.is_empty() {
            // A type without fields.
            texts.insert(name.to_owned(), "");
        }
        let text_of = |of: &str| texts.get(of).copied().or_else(|| library::text_of(of));
        Self::from_texts(name, &|of| text_of(of).map(Cow::Borrowed))
    }

    /// A type from its description. The schema has neither constants nor comments.
    ///
    /// # Errors
    /// [`InvalidDefinition`] when a field has a type that `.msg` files lack.
    pub fn from_description(description: &TypeDescriptionMsg) -> Result<Self, InvalidDefinition> {
        let TypeDescriptionMsg { type_description, referenced_type_descriptions } = description;
        let name = &type_description.type_name;
        let parts = referenced_type_descriptions.iter().chain([type_description]);
        let text_of = |of: &str| {
            let part = parts.clone().find(|part| part.type_name == of)?;
            render(part).map(Cow::Owned)
        };
        Self::from_texts(name, &text_of)
    }

    /// This type, if it has this name and, unless that is empty, this type hash.
    ///
    /// # Errors
    /// [`InvalidDefinition::Hash`] when the hashes differ, [`InvalidDefinition::Missing`] when the names do.
    pub fn checked(self, name: &str, hash: &str) -> Result<Self, InvalidDefinition> {
        if self.name != name {
            return Err(InvalidDefinition::Missing { type_name: name.to_owned(), of: self.name });
        }
        if !hash.is_empty() && self.hash != hash {
            let (type_name, expected) = (self.name, hash.to_owned());
            return Err(InvalidDefinition::Hash { type_name, found: self.hash, expected });
        }
        Ok(self)
    }

    fn new(schema: String, main: TypeDescription, dependencies: Vec<TypeDescription>) -> Self {
        let name = main.type_name.clone();
        let description = TypeDescriptionMsg {
            type_description: main,
            referenced_type_descriptions: dependencies,
        };
        let hash = calculate_hash(&description).to_rihs_string();
        Self { name, schema, hash, description }
    }
}

/// A message type that is not built in.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "message type: found {found}, expected a type of one of the packages {}",
    library::packages()
)]
pub struct UnknownType {
    /// The unknown name.
    pub found: String,
}

/// Each type is assembled when it is first asked for.
static TYPES: LazyLock<BTreeMap<&'static str, OnceLock<TypeSupport>>> = LazyLock::new(|| {
    let names = library::names().chain(service_type::part_names());
    names.map(|name| (name, OnceLock::new())).collect()
});

/// The type support of a message type, or of the request, response or event of a service.
///
/// # Errors
/// [`UnknownType`] when the type is not built in.
pub fn type_support(name: &str) -> Result<&'static TypeSupport, UnknownType> {
    let known = TYPES.get(name).ok_or_else(|| UnknownType { found: name.to_owned() })?;
    Ok(known.get_or_init(|| {
        let text_of = |of: &str| library::text_of(of).or_else(|| service_type::text_of_part(of));
        TypeSupport::from_texts(name, &|of| text_of(of).map(Cow::Borrowed))
            .unwrap_or_else(|error| panic!("msgs/: {error}"))
    }))
}

/// The text of a definition; a line for the byte of an empty message, so that no schema is empty.
fn written(text: &str, parsed: &TypeDescription) -> String {
    match text.trim() {
        "" => render(parsed).unwrap_or_default(),
        _ => text.to_owned(),
    }
}

/// The types of the fields of a message that are messages themselves.
pub(super) fn references(of: &TypeDescription) -> Vec<String> {
    let names = of.fields.iter().map(|field| &field.field_type.nested_type_name);
    names.filter(|name| !name.is_empty()).cloned().collect()
}

#[cfg(test)]
mod tests {
    use hiroz_schema::TypeId;
    use serde::de::DeserializeOwned;
    use serde_reflection::{ContainerFormat, Format, Registry, Samples, Tracer, TracerConfig};

    use super::*;
    use crate::{
        Clock, DiagnosticArray, Log, Message, ParameterEvent, ParticleFrame, PointCloud2,
        PoseStamped, PredictionStatus, RosString, TFMessage, ToolDescription, ToolFrame,
        lifecycle::TransitionEvent,
    };

    #[test]
    fn the_hash_of_a_standard_message_is_the_published_one() {
        // ros2 topic info --verbose, Jazzy.
        for (name, hash) in [
            // The JSON files of rclpy's wheels, `share/<package>/msg/<name>.json`.
            (
                "geometry_msgs/msg/Twist",
                "9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a",
            ),
            (
                "sensor_msgs/msg/Imu",
                "7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b",
            ),
            (
                "std_msgs/msg/Empty",
                "20b625256f32d5dbc0d04fee44f43c41e51c70d3502f84b4a08e7a9c26a96312",
            ),
            (RosString::TYPE, "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"),
            (PointCloud2::TYPE, "9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5"),
            (
                ParameterEvent::TYPE,
                "043e627780fcad87a22d225bc2a037361dba713fca6a6b9f4b869a5aa0393204",
            ),
            // rosbags 0.11.9: `get_typestore(Stores.ROS2_JAZZY).hash_rihs01(name)`.
            (PoseStamped::TYPE, "10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8"),
            (TFMessage::TYPE, "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"),
        ] {
            assert_eq!(type_support(name).unwrap().hash, format!("RIHS01_{hash}"), "{name}");
        }
    }

    #[test]
    fn an_unknown_type_is_rejected_with_the_known_packages() {
        let message = type_support("acme_msgs/msg/Imu").unwrap_err().to_string();
        let expected = "message type: found acme_msgs/msg/Imu, expected a type of one of the packages eddy_msgs,";
        assert!(message.starts_with(expected), "{message}");
        assert!(message.contains(" sensor_msgs,"), "{message}");
    }

    #[test]
    fn the_schema_text_has_each_dependency_once() {
        let schema = &type_support("eddy_msgs/msg/ParticleFrame").unwrap().schema;
        assert_eq!(schema.matches("MSG: std_msgs/Header\n").count(), 1);
        assert_eq!(schema.matches("MSG: builtin_interfaces/Time\n").count(), 1);
    }

    #[test]
    fn a_schema_is_read_back_with_the_same_hash() {
        for name in library::names() {
            let known = type_support(name).unwrap();
            assert!(!known.schema.is_empty(), "{name}");
            assert_eq!(TypeSupport::from_schema(name, &known.schema).unwrap().hash, known.hash);
            let described = TypeSupport::from_description(&known.description).unwrap();
            assert_eq!(described.hash, known.hash, "{name}");
            let again = TypeSupport::from_schema(name, &described.schema).unwrap();
            assert_eq!(again.hash, known.hash, "{name}");
        }
    }

    #[test]
    fn a_schema_without_its_standard_dependencies_is_completed() {
        let whole = "std_msgs/Header header\nfloat64 x\n";
        let support = TypeSupport::from_schema("acme_msgs/msg/Probe", whole).unwrap();
        let again = TypeSupport::from_schema("acme_msgs/msg/Probe", &support.schema).unwrap();
        assert!(support.schema.contains("MSG: builtin_interfaces/Time\n"), "{}", support.schema);
        assert_eq!(support.hash, again.hash);
        let error = TypeSupport::from_schema("acme_msgs/msg/Probe", "Other x\n").unwrap_err();
        let expected =
            "definition of acme_msgs/msg/Other: found none, expected one for acme_msgs/msg/Probe";
        assert_eq!(error.to_string(), expected);
    }

    #[test]
    fn an_empty_text_is_the_definition_of_a_type_without_fields() {
        const EMPTY: &str = "std_msgs/msg/Empty";
        for text in ["", "\n", "# Nothing.\n"] {
            let support = TypeSupport::from_schema(EMPTY, text).unwrap();
            assert_eq!(support.hash, type_support(EMPTY).unwrap().hash, "{text:?}");
        }
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
        agree::<ToolDescription>();
        agree::<ToolFrame>();
        agree::<PoseStamped>();
        agree::<TFMessage>();
        agree::<Log>();
        agree::<TransitionEvent>();
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
