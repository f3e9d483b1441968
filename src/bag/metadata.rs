//! `metadata.yaml`, version 9: written as rosbag2 writes it, read as far as eddy needs it.

use std::{
    fs,
    path::{Path, PathBuf},
};

use serde::{Deserialize, Serialize};

use super::{error::BagError, layout::METADATA, writer::BagSummary};

/// The version that is written (rosbag2 Jazzy and later), and the newest that is read.
const VERSION: u32 = 9;

/// `rmw_time_t` of a duration without end: 2^63 - 1 nanoseconds.
const INFINITE: QosTime = QosTime { sec: 9_223_372_036, nsec: 854_775_807 };

/// One offered quality of service, in the words of version 9.
#[derive(Serialize)]
struct QosProfile {
    history: &'static str,
    depth: u32,
    reliability: &'static str,
    durability: &'static str,
    deadline: QosTime,
    lifespan: QosTime,
    liveliness: &'static str,
    liveliness_lease_duration: QosTime,
    avoid_ros_namespace_conventions: bool,
}

#[derive(Clone, Copy, Serialize)]
struct QosTime {
    sec: u64,
    nsec: u64,
}

/// ROS 2's default profile, which a player then offers: nothing is lost when a bag is replayed.
const DEFAULT_PROFILE: QosProfile = QosProfile {
    history: "keep_last",
    depth: 10,
    reliability: "reliable",
    durability: "volatile",
    deadline: INFINITE,
    lifespan: INFINITE,
    liveliness: "automatic",
    liveliness_lease_duration: INFINITE,
    avoid_ros_namespace_conventions: false,
};

/// The value of a channel's `offered_qos_profiles`: the list of `metadata.yaml` as a text.
pub(super) fn offered_qos_profiles() -> String {
    to_yaml(&[DEFAULT_PROFILE])
}

fn to_yaml<T: Serialize>(value: &T) -> String {
    serde_saphyr::to_string(value)
        .expect("structs of numbers and strings with fixed keys are always YAML")
}

#[derive(Serialize)]
struct Document<'a> {
    rosbag2_bagfile_information: Information<'a>,
}

#[derive(Serialize)]
struct Information<'a> {
    version: u32,
    storage_identifier: &'static str,
    duration: Nanoseconds,
    starting_time: SinceEpoch,
    message_count: u64,
    topics_with_message_count: Vec<TopicWithCount<'a>>,
    compression_format: &'static str,
    compression_mode: &'static str,
    relative_file_paths: [&'a str; 1],
    files: [FileInformation<'a>; 1],
    custom_data: Option<()>,
    ros_distro: &'static str,
}

#[derive(Clone, Copy, Serialize)]
struct Nanoseconds {
    nanoseconds: i64,
}

#[derive(Clone, Copy, Serialize)]
struct SinceEpoch {
    nanoseconds_since_epoch: i64,
}

#[derive(Serialize)]
struct TopicWithCount<'a> {
    topic_metadata: TopicMetadata<'a>,
    message_count: u64,
}

#[derive(Serialize)]
struct TopicMetadata<'a> {
    name: &'a str,
    r#type: &'a str,
    serialization_format: &'static str,
    offered_qos_profiles: [QosProfile; 1],
    type_description_hash: &'a str,
}

#[derive(Serialize)]
struct FileInformation<'a> {
    path: &'a str,
    starting_time: SinceEpoch,
    duration: Nanoseconds,
    message_count: u64,
}

/// Writes `metadata.yaml` into the bag's directory, whole or not at all.
pub(super) fn write(bag: &BagSummary) -> Result<(), BagError> {
    let text = text(bag);
    let path = bag.directory.join(METADATA);
    let unfinished = bag.directory.join(format!("{METADATA}.tmp"));
    fs::write(&unfinished, text).map_err(BagError::io(&unfinished, "writing the metadata"))?;
    fs::rename(&unfinished, &path).map_err(BagError::io(path, "naming the metadata"))
}

fn text(bag: &BagSummary) -> String {
    let file = bag.file.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    let starting_time =
        SinceEpoch { nanoseconds_since_epoch: bag.start.map_or(0, |start| start.0) };
    let duration = Nanoseconds {
        nanoseconds: bag.start.zip(bag.end).map_or(0, |(start, end)| end.0 - start.0),
    };
    let message_count = bag.messages;
    let topics_with_message_count = bag
        .topics
        .iter()
        .map(|topic| TopicWithCount {
            topic_metadata: TopicMetadata {
                name: &topic.name,
                r#type: &topic.type_name,
                serialization_format: "cdr",
                offered_qos_profiles: [DEFAULT_PROFILE],
                type_description_hash: &topic.hash,
            },
            message_count: topic.messages,
        })
        .collect();
    to_yaml(&Document {
        rosbag2_bagfile_information: Information {
            version: VERSION,
            storage_identifier: "mcap",
            duration,
            starting_time,
            message_count,
            topics_with_message_count,
            // Compression is that of MCAP's chunks; these two are for whole files and messages.
            compression_format: "",
            compression_mode: "",
            relative_file_paths: [file],
            files: [FileInformation { path: file, starting_time, duration, message_count }],
            custom_data: None,
            ros_distro: "eddy",
        },
    })
}

#[derive(Deserialize)]
struct ReadDocument {
    rosbag2_bagfile_information: ReadInformation,
}

#[derive(Deserialize)]
struct ReadInformation {
    version: u32,
    storage_identifier: String,
    relative_file_paths: Vec<String>,
    message_count: u64,
    #[serde(default)]
    compression_mode: String,
}

fn read(path: &Path) -> Result<ReadInformation, BagError> {
    let text = fs::read_to_string(path).map_err(BagError::io(path, "reading the metadata"))?;
    let document: ReadDocument = serde_saphyr::from_str(&text).map_err(|error| {
        wrong(
            path,
            "rosbag2_bagfile_information",
            error.to_string(),
            "the keys that rosbag2 writes",
        )
    })?;
    Ok(document.rosbag2_bagfile_information)
}

fn wrong(path: &Path, field: &'static str, found: String, expected: &'static str) -> BagError {
    BagError::Metadata { path: path.into(), field, found, expected }
}

/// The MCAP files that `metadata.yaml` at `path` names, in the bag's `directory`.
pub(super) fn files(path: &Path, directory: &Path) -> Result<Vec<PathBuf>, BagError> {
    let information = read(path)?;
    if information.version > VERSION {
        return Err(wrong(path, "version", information.version.to_string(), "at most 9"));
    }
    if information.storage_identifier != "mcap" {
        return Err(wrong(path, "storage_identifier", information.storage_identifier, "mcap"));
    }
    if !matches!(information.compression_mode.to_lowercase().as_str(), "" | "none") {
        let expected = "an empty text: MCAP compresses its own chunks";
        return Err(wrong(path, "compression_mode", information.compression_mode, expected));
    }
    // Only the last part of each path counts: bags are moved, and older versions wrote more.
    let file = |name: &String| Path::new(name).file_name().map(|name| directory.join(name));
    let files: Vec<PathBuf> = information.relative_file_paths.iter().filter_map(file).collect();
    let expected = "the names of files beside metadata.yaml";
    if let Some(missing) = files.iter().find(|file| !file.exists()) {
        let found = format!("{}, which does not exist", missing.display());
        return Err(wrong(path, "relative_file_paths", found, expected));
    }
    if files.is_empty() {
        return Err(wrong(path, "relative_file_paths", "no file".into(), expected));
    }
    Ok(files)
}

/// `message_count` of the metadata of the bag at `bag`, if it has any.
pub(super) fn message_count(bag: &Path) -> Result<Option<u64>, BagError> {
    let path = bag.join(METADATA);
    if !path.exists() {
        return Ok(None);
    }
    Ok(Some(read(&path)?.message_count))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{bag::WrittenTopic, frame::Stamp};

    fn bag() -> BagSummary {
        let topic = WrittenTopic {
            name: "/particles".into(),
            type_name: "eddy_msgs/msg/ParticleFrame".into(),
            hash: "RIHS01_00".into(),
            messages: 3,
        };
        BagSummary {
            directory: "run".into(),
            file: "run/run_0.mcap".into(),
            messages: 3,
            start: Some(Stamp(1_000)),
            end: Some(Stamp(33_000)),
            size: 0,
            topics: vec![topic],
        }
    }

    #[test]
    fn the_text_is_that_of_rosbag2() {
        insta::assert_snapshot!(text(&bag()), @r#"
        rosbag2_bagfile_information:
          version: 9
          storage_identifier: mcap
          duration:
            nanoseconds: 32000
          starting_time:
            nanoseconds_since_epoch: 1000
          message_count: 3
          topics_with_message_count:
          - topic_metadata:
              name: /particles
              type: eddy_msgs/msg/ParticleFrame
              serialization_format: cdr
              offered_qos_profiles:
              - history: keep_last
                depth: 10
                reliability: reliable
                durability: volatile
                deadline:
                  sec: 9223372036
                  nsec: 854775807
                lifespan:
                  sec: 9223372036
                  nsec: 854775807
                liveliness: automatic
                liveliness_lease_duration:
                  sec: 9223372036
                  nsec: 854775807
                avoid_ros_namespace_conventions: false
              type_description_hash: RIHS01_00
            message_count: 3
          compression_format: ""
          compression_mode: ""
          relative_file_paths:
          - run_0.mcap
          files:
          - path: run_0.mcap
            starting_time:
              nanoseconds_since_epoch: 1000
            duration:
              nanoseconds: 32000
            message_count: 3
          custom_data: null
          ros_distro: eddy
        "#);
    }

    #[test]
    fn metadata_that_cannot_be_used_names_field_found_and_expected() {
        let good = text(&bag());
        let cases = [
            ("version: 9", "version: 10", "version: found 10, expected at most 9"),
            (
                "_identifier: mcap",
                "_identifier: sqlite3",
                "storage_identifier: found sqlite3, expected mcap",
            ),
            (
                "compression_mode: \"\"",
                "compression_mode: FILE",
                "compression_mode: found FILE, expected an empty",
            ),
            (
                "  - run_0.mcap",
                "  - gone.mcap",
                "gone.mcap, which does not exist, expected the names of files",
            ),
            ("message_count: 3", "message_count: many", "rosbag2_bagfile_information: found"),
        ];
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join(METADATA);
        fs::write(directory.path().join("run_0.mcap"), "").unwrap();
        fs::write(&path, &good).unwrap();
        assert_eq!(files(&path, directory.path()).unwrap(), [directory.path().join("run_0.mcap")]);
        for (from, to, expected) in cases {
            assert!(good.contains(from), "{from} in {good}");
            fs::write(&path, good.replacen(from, to, 1)).unwrap();
            let message = files(&path, directory.path()).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        }
    }
}
