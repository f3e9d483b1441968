//! `type_description_interfaces/srv/GetTypeDescription`: a node tells the definitions of the types that it uses (REP 2016).
//!
//! Nodes of rclcpp and rclpy offer it as `~/get_type_description`, from ROS 2 Jazzy on.

use std::borrow::Cow;

use hiroz_schema::{TypeDescription, TypeDescriptionMsg};
use serde::{Deserialize, Serialize};

use super::{InvalidDefinition, KeyValue, TypeSupport, built_in_text, type_support};

/// Type of the service.
pub const GET_TYPE_DESCRIPTION: &str = "type_description_interfaces/srv/GetTypeDescription";
/// Name of the service, below that of the node.
pub const SERVICE_NAME: &str = "get_type_description";
/// Encoding of sources that are `.msg` files, and of types without a file.
const MSG: &str = "msg";
const IMPLICIT: &str = "implicit";

/// Request of the service.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TypeDescriptionRequest {
    /// Name of the type.
    pub type_name: String,
    /// RIHS01 type hash.
    pub type_hash: String,
    /// Whether to return the files.
    pub include_type_sources: bool,
}

/// Response of the service.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct TypeDescriptionResponse {
    /// Whether the node knows the type.
    pub successful: bool,
    /// Why it does not; empty otherwise.
    pub failure_reason: String,
    /// The parsed type.
    pub type_description: TypeDescriptionMsg,
    /// The files of the type and of all types that it references.
    pub type_sources: Vec<TypeSource>,
    /// Anything else.
    pub extra_information: Vec<KeyValue>,
}

/// A file that defines a type (`type_description_interfaces/msg/TypeSource`).
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TypeSource {
    /// Name of the type.
    pub type_name: String,
    /// Language: `msg`, `idl`, or `implicit` for parts of services and actions, which have no file.
    pub encoding: String,
    /// The text; empty if there is no file.
    pub raw_file_contents: String,
}

impl TypeDescriptionResponse {
    /// The response of a node that knows the built-in types.
    pub fn to(request: &TypeDescriptionRequest) -> Self {
        let TypeDescriptionRequest { type_name, type_hash, include_type_sources } = request;
        match type_support(type_name) {
            Ok(known) if known.hash == *type_hash => {
                let known = &known.description;
                let referenced = known.referenced_type_descriptions.iter();
                let all = [&known.type_description].into_iter().chain(referenced);
                let source = |of: &TypeDescription| {
                    let text = built_in_text(&of.type_name);
                    TypeSource {
                        type_name: of.type_name.clone(),
                        encoding: if text.is_some() { MSG } else { IMPLICIT }.to_owned(),
                        raw_file_contents: text.unwrap_or_default().to_owned(),
                    }
                };
                Self {
                    successful: true,
                    failure_reason: String::new(),
                    type_description: known.clone(),
                    type_sources: all.filter(|_| *include_type_sources).map(source).collect(),
                    extra_information: Vec::new(),
                }
            }
            Ok(known) => {
                Self::failed(format!("found type hash {type_hash}, expected {}", known.hash))
            }
            Err(error) => Self::failed(error.to_string()),
        }
    }

    fn failed(failure_reason: String) -> Self {
        Self {
            successful: false,
            failure_reason,
            type_description: TypeSupport::foreign("", "").description,
            type_sources: Vec::new(),
            extra_information: Vec::new(),
        }
    }

    /// The type `name` with type hash `hash`: from the `.msg` files, with their comments and constants, or from the
    /// description where these are missing.
    ///
    /// # Errors
    /// [`InvalidDefinition`] when the response does not define a type with this name and hash.
    pub fn into_type(self, name: &str, hash: &str) -> Result<TypeSupport, InvalidDefinition> {
        let text_of = |of: &str| {
            let mut sources = self.type_sources.iter();
            let source = sources.find(|source| source.type_name == of && source.encoding == MSG)?;
            Some(Cow::Borrowed(source.raw_file_contents.as_str()))
        };
        if let Ok(support) = TypeSupport::from_texts(name, &text_of)
            && support.hash == hash
        {
            return Ok(support);
        }
        let support = TypeSupport::from_description(&self.type_description)?;
        support.checked(name, hash)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{cdr, type_support};

    fn response(sources: &[(&str, &str)]) -> TypeDescriptionResponse {
        let known = type_support("std_msgs/msg/Header").unwrap();
        let source = |(of, text): &(&str, &str)| TypeSource {
            type_name: (*of).to_owned(),
            encoding: MSG.to_owned(),
            raw_file_contents: (*text).to_owned(),
        };
        TypeDescriptionResponse {
            successful: true,
            failure_reason: String::new(),
            type_description: known.description.clone(),
            type_sources: sources.iter().map(source).collect(),
            extra_information: Vec::new(),
        }
    }

    #[test]
    fn files_are_preferred_to_the_description() {
        let name = "std_msgs/msg/Header";
        let hash = &type_support(name).unwrap().hash;
        let files = [
            (name, "# When and where\nbuiltin_interfaces/Time stamp\nstring frame_id\n"),
            ("builtin_interfaces/msg/Time", "int32 sec\nuint32 nanosec\n"),
        ];
        let whole: TypeDescriptionResponse = cdr::decode(&cdr::encode(&response(&files))).unwrap();
        let support = whole.into_type(name, hash).unwrap();
        assert!(support.schema.starts_with("# When and where\n"), "{}", support.schema);
        for incomplete in [&files[..1], &[], &[(name, "int8 other\n")]] {
            let support = response(incomplete).into_type(name, hash).unwrap();
            assert_eq!((support.name.as_str(), &support.hash), (name, hash));
            assert!(support.schema.starts_with("builtin_interfaces/Time stamp\n"));
        }
    }

    #[test]
    fn a_node_describes_the_built_in_types() {
        for name in [
            "eddy_msgs/msg/ParticleFrame",
            "diagnostic_msgs/msg/DiagnosticArray",
            "std_srvs/srv/Trigger_Event",
        ] {
            let known = type_support(name).unwrap();
            let mut request = TypeDescriptionRequest {
                type_name: name.to_owned(),
                type_hash: known.hash.clone(),
                include_type_sources: true,
            };
            let response = TypeDescriptionResponse::to(&request);
            assert!(response.successful, "{}", response.failure_reason);
            let sources = response.type_sources.len();
            assert_eq!(sources, 1 + known.description.referenced_type_descriptions.len());
            let described = response.into_type(name, &known.hash).unwrap();
            assert_eq!((&described.name, &described.hash), (&known.name, &known.hash));
            request.include_type_sources = false;
            let response = TypeDescriptionResponse::to(&request);
            assert_eq!((response.successful, response.type_sources.len()), (true, 0));
            request.type_hash = format!("RIHS01_{}", "0".repeat(64));
            let response = TypeDescriptionResponse::to(&request);
            let expected =
                format!("found type hash {}, expected {}", request.type_hash, known.hash);
            assert_eq!((response.successful, response.failure_reason), (false, expected));
        }
        let request = TypeDescriptionRequest {
            type_name: "acme_msgs/msg/Probe".to_owned(),
            type_hash: String::new(),
            include_type_sources: true,
        };
        let failed = TypeDescriptionResponse::to(&request);
        assert!(failed.failure_reason.contains("found acme_msgs/msg/Probe"));
        // Empty types are on the wire, too.
        cdr::decode::<TypeDescriptionResponse>(&cdr::encode(&failed)).unwrap();
    }

    #[test]
    fn a_description_of_another_type_is_rejected() {
        let hash = format!("RIHS01_{}", "0".repeat(64));
        let message =
            response(&[]).into_type("std_msgs/msg/Header", &hash).unwrap_err().to_string();
        assert!(message.starts_with("definition of std_msgs/msg/Header: found type hash RIHS01_"));
        assert!(message.ends_with(&format!("expected {hash}")), "{message}");
    }
}
