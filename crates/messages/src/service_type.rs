//! Parses and hashes the `.srv` files.
//!
//! For its type hash, a service is a message of the fields `request_message`, `response_message` and `event_message` with
//! the types `T_Request`, `T_Response` and `T_Event` (`rosidl_parser/rosidl_parser/definition.py`, `Service`, and
//! REP 2016). An event has a `service_msgs/msg/ServiceEventInfo` and at most one request and one response.

use std::{collections::BTreeMap, sync::LazyLock};

use hiroz_schema::{
    FieldTypeDescription, TypeDescription, TypeDescriptionMsg, TypeId, calculate_hash,
};

use super::{
    definition::{field, parse},
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
const FILES: [(&str, &str); 16] = files![
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

fn hash(name: &str, text: &str) -> String {
    calculate_hash(&description(name, text)).to_rihs_string()
}

/// The service as a message, with all referenced types sorted by name.
fn description(name: &str, text: &str) -> TypeDescriptionMsg {
    let (request, response) = text
        .split_once("---")
        .unwrap_or_else(|| panic!("{name}: found no `---`, expected one between two messages"));
    let [request, response] = [("Request", request), ("Response", response)].map(|(part, text)| {
        parse(&format!("{name}_{part}"), text).unwrap_or_else(|error| panic!("msgs/: {error}"))
    });
    let one = |name: &str| FieldTypeDescription::nested(TypeId::NESTED_TYPE, name);
    let at_most_one = |name: &str| {
        let kind = TypeId::NESTED_TYPE + TypeId::BOUNDED_SEQUENCE_OFFSET;
        FieldTypeDescription::nested_array(kind, 1, name)
    };
    let event = TypeDescription {
        type_name: format!("{name}_Event"),
        fields: vec![
            field("info", one("service_msgs/msg/ServiceEventInfo")),
            field("request", at_most_one(&request.type_name)),
            field("response", at_most_one(&response.type_name)),
        ],
    };
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
        // The parts have no `.msg` file.
        if let Ok(known) = type_support(&dependency) {
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
    /// (packages std_srvs 5.5.1 and rcl_interfaces 2.3.0, type_description_interfaces 2.3.0).
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
                "type_description_interfaces/srv/GetTypeDescription",
                "69b9c19c1021405984cc60dbbb1edceb147a6538b411d812ba6afabeed962cd5",
            ),
        ] {
            assert_eq!(service_hash(name).unwrap(), format!("RIHS01_{published}"), "{name}");
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
        let message = service_hash("std_srvs/srv/SetBool").unwrap_err().to_string();
        assert!(message.starts_with("service type: found std_srvs/srv/SetBool, expected one of"));
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
