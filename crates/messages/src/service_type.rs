//! Parses and hashes the `.srv` files.
//!
//! For its type hash, a service is a message of the fields `request_message`, `response_message` and `event_message` with
//! the types `T_Request`, `T_Response` and `T_Event` (`rosidl_parser/rosidl_parser/definition.py`, `Service`, and
//! REP 2016). An event has a `service_msgs/msg/ServiceEventInfo` and at most one request and one response.

use std::{borrow::Cow, collections::BTreeMap, sync::LazyLock};

use hiroz_schema::{
    FieldTypeDescription, TypeDescription, TypeDescriptionMsg, TypeId, calculate_hash,
};

use super::{
    InvalidDefinition, TypeSupport,
    definition::{field, parse},
    library,
    schema::{references, type_support},
};

/// A service type that is not built in.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("service type: found {found}, expected one of {}", known_services().join(", "))]
pub struct UnknownService {
    /// The unknown name.
    pub found: String,
}

macro_rules! files {
    ($($name:literal),* $(,)?) => {
        [$(($name, include_str!(concat!("../msgs/standard/", $name, ".srv")))),*]
    };
}

/// Names and texts of the built-in `.srv` files.
const FILES: [(&str, &str); 22] = files![
    "lifecycle_msgs/srv/ChangeState",
    "lifecycle_msgs/srv/GetAvailableStates",
    "lifecycle_msgs/srv/GetAvailableTransitions",
    "lifecycle_msgs/srv/GetState",
    "rcl_interfaces/srv/DescribeParameters",
    "rcl_interfaces/srv/GetParameterTypes",
    "rcl_interfaces/srv/GetParameters",
    "rcl_interfaces/srv/ListParameters",
    "rcl_interfaces/srv/SetParameters",
    "rcl_interfaces/srv/SetParametersAtomically",
    "rosbag2_interfaces/srv/GetRate",
    "rosbag2_interfaces/srv/IsPaused",
    "rosbag2_interfaces/srv/Pause",
    "rosbag2_interfaces/srv/PlayNext",
    "rosbag2_interfaces/srv/Resume",
    "rosbag2_interfaces/srv/Seek",
    "rosbag2_interfaces/srv/SetRate",
    "rosbag2_interfaces/srv/TogglePaused",
    "std_srvs/srv/Empty",
    "std_srvs/srv/SetBool",
    "std_srvs/srv/Trigger",
    "type_description_interfaces/srv/GetTypeDescription",
];

static HASHES: LazyLock<BTreeMap<&'static str, String>> =
    LazyLock::new(|| FILES.iter().map(|&(name, text)| (name, hash(name, text))).collect());

/// The type hash of a service type: `RIHS01_` and 64 hexadecimal digits.
///
/// # Errors
/// [`UnknownService`] when the type is not built in.
pub fn service_hash(name: &str) -> Result<&'static str, UnknownService> {
    let hash = HASHES.get(name).map(String::as_str);
    hash.ok_or_else(|| UnknownService { found: name.to_owned() })
}

fn known_services() -> Vec<&'static str> {
    FILES.iter().map(|(name, _)| *name).collect()
}

/// The `.msg` texts of the requests, responses and events of the built-in services, by name.
static PARTS: LazyLock<BTreeMap<String, String>> = LazyLock::new(|| {
    let parts = FILES.iter().map(|(name, text)| parts(name, text));
    parts.flat_map(|parts| parts.unwrap_or_else(|error| panic!("msgs/: {error}"))).collect()
});

/// The `.msg` text of the request, response or event of a built-in service, such as `std_srvs/srv/Trigger_Event`.
pub(crate) fn text_of_part(name: &str) -> Option<&'static str> {
    PARTS.get(name).map(String::as_str)
}

/// The names of these parts.
pub(crate) fn part_names() -> impl Iterator<Item = &'static str> {
    PARTS.keys().map(String::as_str)
}

/// Request and response of the service `name` from its `.srv` text; `text_of` returns the `.msg` text of any other type,
/// unless it is built in.
///
/// # Errors
/// [`InvalidDefinition`] when a text is missing or is not a definition.
pub fn service_messages(
    name: &str,
    text: &str,
    text_of: &dyn Fn(&str) -> Option<String>,
) -> Result<[TypeSupport; 2], InvalidDefinition> {
    let parts = BTreeMap::from(parts(name, text)?);
    let text_of = |of: &str| {
        let part = parts.get(of).map(|text| Cow::Borrowed(text.as_str()));
        part.or_else(|| text_of(of).map(Cow::Owned))
            .or_else(|| library::text_of(of).map(Cow::Borrowed))
    };
    let part = |part: &str| TypeSupport::from_texts(&format!("{name}_{part}"), &text_of);
    Ok([part("Request")?, part("Response")?])
}

/// Names and `.msg` texts of request, response and event.
fn parts(name: &str, text: &str) -> Result<[(String, String); 3], InvalidDefinition> {
    let (request, response) = text.split_once("---").ok_or_else(|| InvalidDefinition::Line {
        type_name: name.to_owned(),
        line: text.lines().next_back().unwrap_or_default().to_owned(),
    })?;
    let event = format!(
        "service_msgs/ServiceEventInfo info\n{name}_Request[<=1] request\n{name}_Response[<=1] response\n"
    );
    let named = |part: &str, text: &str| (format!("{name}_{part}"), text.to_owned());
    Ok([named("Request", request), named("Response", response), named("Event", &event)])
}

fn hash(name: &str, text: &str) -> String {
    calculate_hash(&description(name, text)).to_rihs_string()
}

/// The service as a message, with all referenced types sorted by name.
fn description(name: &str, text: &str) -> TypeDescriptionMsg {
    let parts = parts(name, text).and_then(|parts| {
        let [request, response, event] = parts.map(|(name, text)| parse(&name, &text));
        Ok([request?, response?, event?])
    });
    let [request, response, event] = parts.unwrap_or_else(|error| panic!("msgs/: {error}"));
    let one = |name: &str| FieldTypeDescription::nested(TypeId::NESTED_TYPE, name);
    let service = TypeDescription {
        type_name: name.to_owned(),
        fields: vec![
            field("request_message", one(&request.type_name)),
            field("response_message", one(&response.type_name)),
            field("event_message", one(&event.type_name)),
        ],
    };
    let parts = [request, response, event];
    let mut referenced = BTreeMap::new();
    for dependency in parts.iter().flat_map(references) {
        let is_part = dependency.starts_with(&format!("{name}_"));
        if let (false, Ok(known)) = (is_part, type_support(&dependency)) {
            let TypeDescriptionMsg { type_description, referenced_type_descriptions } =
                known.description.clone();
            let all = referenced_type_descriptions.into_iter().chain([type_description]);
            referenced.extend(all.map(|of| (of.type_name.clone(), of)));
        }
    }
    referenced.extend(parts.map(|part| (part.type_name.clone(), part)));
    TypeDescriptionMsg {
        type_description: service,
        referenced_type_descriptions: referenced.into_values().collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// From the type descriptions that ROS 2 Kilted installs, `share/<package>/srv/<name>.json`
    /// (packages std_srvs 5.5.1, lifecycle_msgs, rcl_interfaces and type_description_interfaces 2.3.0).
    #[test]
    fn hashes_of_standard_services_are_the_published_ones() {
        for (name, published) in [
            (
                "std_srvs/srv/Trigger",
                "eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f",
            ),
            (
                "rcl_interfaces/srv/DescribeParameters",
                "845b484d71eb0673dae682f2e3ba3c4851a65a3dcfb97bddd82c5b57e91e4cff",
            ),
            (
                "rcl_interfaces/srv/GetParameterTypes",
                "da199c878688b3e530bdfe3ca8f74cb9fa0c303101e980a9e8f260e25e1c80ca",
            ),
            (
                "rcl_interfaces/srv/GetParameters",
                "bf9803d5c74cf989a5de3e0c2e99444599a627c7ff75f97b8c05b01003675cbc",
            ),
            (
                "rcl_interfaces/srv/ListParameters",
                "3e6062bfbb27bfb8730d4cef2558221f51a11646d78e7bb30a1e83afac3aad9d",
            ),
            (
                "rcl_interfaces/srv/SetParameters",
                "56eed9a67e169f9cb6c1f987bc88f868c14a8fc9f743a263bc734c154015d7e0",
            ),
            (
                "rcl_interfaces/srv/SetParametersAtomically",
                "0e192ef259c07fc3c07a13191d27002222e65e00ccec653ca05e856f79285fcd",
            ),
            (
                "lifecycle_msgs/srv/ChangeState",
                "356fe34f0475a43acf54542013af4167b0e729f77ea22ffb045c6ad8e20668e5",
            ),
            (
                "lifecycle_msgs/srv/GetAvailableStates",
                "00a07d79d2207d71e81a8cbc1880e5d924cc16d4688ea8e8e06e443dc8f8aa1d",
            ),
            (
                "lifecycle_msgs/srv/GetAvailableTransitions",
                "59b7ecefce0982a8a844b9f2c4f14764c1c4543cc55e72924e2aa4adad83e9bc",
            ),
            (
                "lifecycle_msgs/srv/GetState",
                "800a0a5aae599782b02932de0caf563f6dc4e7e94b794eadde075ba2cbef9795",
            ),
            (
                "std_srvs/srv/Empty",
                "5888399dedec5ccc85ea6451949fd2c9f97bfdf963f9a588821639fcd31b5d19",
            ),
            (
                "std_srvs/srv/SetBool",
                "abe9e4bb6b41b40e6789712c00ec8871923e089af3f667a79992a428cff2da0a",
            ),
            (
                "type_description_interfaces/srv/GetTypeDescription",
                "69b9c19c1021405984cc60dbbb1edceb147a6538b411d812ba6afabeed962cd5",
            ),
        ] {
            assert_eq!(service_hash(name).unwrap(), format!("RIHS01_{published}"), "{name}");
        }
    }

    /// From the same files.
    #[test]
    fn hashes_of_service_events_are_the_published_ones() {
        for (name, published) in [
            ("SetBool", "3c4c20015afb4303eafd347b1d6a786f171a89c814726961a9593ef10df878cf"),
            ("Empty", "66fa7fcfb5f2bf04b9a8a55603318c5c402edfc4bd56bb0ed7b602990c29305a"),
            ("Trigger", "ec4a1d26b0575e61906890342aba9523a2360e9845857c5590fa6e23bc39e1c2"),
        ] {
            let event = type_support(&format!("std_srvs/srv/{name}_Event")).unwrap();
            assert_eq!(event.hash, format!("RIHS01_{published}"), "{name}");
        }
    }

    #[test]
    fn a_service_of_another_package_is_parsed_with_its_own_types() {
        let text = "Level level\nstd_msgs/Header header\n---\nbool done\n";
        let text_of = |of: &str| (of == "acme/msg/Level").then(|| "float64 x\n".to_owned());
        let [request, response] = service_messages("acme/srv/Fill", text, &text_of).unwrap();
        assert_eq!(request.name, "acme/srv/Fill_Request");
        assert!(request.schema.contains("MSG: acme/Level\nfloat64 x\n"), "{}", request.schema);
        assert_eq!(response.schema.trim(), "bool done");
        for (text, expected) in [
            ("Tank tank\n---\n", "found none, expected one for acme/srv/Fill_Request"),
            ("bool a\nbool b", "found `bool b`"),
        ] {
            let message =
                service_messages("acme/srv/Fill", text, &text_of).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        }
    }

    /// Computed with zenoh-ros2-sdk 0.1.8, `compute_service_type_hash`.
    #[test]
    fn hashes_of_the_players_services_match_another_implementation() {
        for (name, hash) in [
            ("Pause", "b101e6aaf344c37f1405f5a1f484fee1c7d2acc61c6f04aeb636e9ab3f51a497"),
            ("Seek", "6e9b6b38c44f111e36e43903da565fb2775ab0f0e69c02169a5fb0f130b23eb4"),
        ] {
            let found = service_hash(&format!("rosbag2_interfaces/srv/{name}")).unwrap();
            assert_eq!(found, format!("RIHS01_{hash}"), "{name}");
        }
    }

    #[test]
    fn an_unknown_service_is_rejected_with_the_known_ones() {
        let message = service_hash("acme/srv/Fill").unwrap_err().to_string();
        assert!(message.starts_with("service type: found acme/srv/Fill, expected one of"));
        assert!(message.contains("std_srvs/srv/Trigger"));
    }

    #[test]
    fn referenced_types_of_a_service_are_listed_once_and_sorted() {
        let (name, text) = FILES.iter().find(|(name, _)| name.ends_with("/Seek")).unwrap();
        let described = description(name, text);
        let names: Vec<_> =
            described.referenced_type_descriptions.iter().map(|of| of.type_name.as_str()).collect();
        let expected = [
            "builtin_interfaces/msg/Time",
            "rosbag2_interfaces/srv/Seek_Event",
            "rosbag2_interfaces/srv/Seek_Request",
            "rosbag2_interfaces/srv/Seek_Response",
            "service_msgs/msg/ServiceEventInfo",
        ];
        assert_eq!(names, expected);
    }
}
