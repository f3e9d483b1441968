//! The built-in `.msg` texts: those of eddy, and those of ROS 2 Jazzy in one file per package.

use std::{collections::BTreeMap, sync::LazyLock};

use super::definition::{full_name, parts};

macro_rules! ours {
    ($($name:literal),* $(,)?) => {
        [$((
            concat!("eddy_msgs/msg/", $name),
            include_str!(concat!("../msgs/eddy_msgs/msg/", $name, ".msg")),
        )),*]
    };
}

/// eddy's own messages.
const OURS: [(&str, &str); 6] =
    ours!["ParticleFrame", "PredictionStatus", "Tool", "ToolDescription", "ToolFrame", "ToolPart",];

macro_rules! packages {
    ($($name:literal),* $(,)?) => {
        [$(($name, include_str!(concat!("../msgs/standard/", $name, ".txt")))),*]
    };
}

/// Names and texts of the packages, as `msgs/standard/generate` writes them.
const PACKAGES: [(&str, &str); 20] = packages![
    "action_msgs",
    "actionlib_msgs",
    "builtin_interfaces",
    "diagnostic_msgs",
    "geometry_msgs",
    "lifecycle_msgs",
    "nav_msgs",
    "rcl_interfaces",
    "rosgraph_msgs",
    "sensor_msgs",
    "service_msgs",
    "shape_msgs",
    "statistics_msgs",
    "std_msgs",
    "stereo_msgs",
    "tf2_msgs",
    "trajectory_msgs",
    "type_description_interfaces",
    "unique_identifier_msgs",
    "visualization_msgs",
];

static TEXTS: LazyLock<BTreeMap<String, &'static str>> = LazyLock::new(|| {
    let standard = PACKAGES.iter().flat_map(|(_, text)| parts(text));
    let standard = standard.filter_map(|(name, text)| Some((full_name(name?), text)));
    standard.chain(OURS.map(|(name, text)| (name.to_owned(), text))).collect()
});

/// The `.msg` text of a built-in message type, such as `std_msgs/msg/Header`.
pub fn text_of(name: &str) -> Option<&'static str> {
    TEXTS.get(name).copied()
}

/// The names of all built-in message types.
pub fn names() -> impl Iterator<Item = &'static str> {
    TEXTS.keys().map(String::as_str)
}

/// The packages whose message types are built in.
pub(crate) fn packages() -> String {
    let names = PACKAGES.iter().map(|(name, _)| *name);
    ["eddy_msgs"].into_iter().chain(names).collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests {
    use std::{fs, path::Path};

    use super::*;

    #[test]
    fn every_file_of_the_package_is_built_in() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("msgs/eddy_msgs/msg");
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            let name = format!("eddy_msgs/msg/{}", path.file_stem().unwrap().to_str().unwrap());
            assert_eq!(text_of(&name), Some(&*fs::read_to_string(&path).unwrap()));
        }
    }

    #[test]
    fn every_file_of_the_standard_packages_is_built_in() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("msgs/standard");
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.extension().is_some_and(|extension| extension == "txt") {
                let package = path.file_stem().unwrap().to_str().unwrap().to_owned();
                assert!(PACKAGES.iter().any(|(name, _)| *name == package), "{package}");
                assert!(names().any(|name| name.starts_with(&format!("{package}/msg/"))));
            }
        }
    }
}
