//! `metadata.yaml`, version 9, as rosbag2 writes it; only the fields that eddy needs are read.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

use serde::{Deserialize, Serialize};

use super::{
    custom_data::CustomData,
    description::Description,
    layout::is_mcap,
    qos::{self, YamlProfile},
    summary::BagSummary,
};
use crate::error::BagError;
use eddy_frames::Stamp;
use eddy_settings::atomic;

/// The file in a bag directory.
pub(crate) const FILE_NAME: &str = "metadata.yaml";

/// The version that is written (rosbag2 Jazzy and later), and the newest that is known.
const VERSION: u32 = 9;

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
    relative_file_paths: Vec<&'a str>,
    files: Vec<FileInformation<'a>>,
    custom_data: Option<&'a BTreeMap<String, String>>,
    ros_distro: &'a str,
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
    serialization_format: &'a str,
    offered_qos_profiles: Vec<YamlProfile>,
    type_description_hash: &'a str,
}

#[derive(Serialize)]
struct FileInformation<'a> {
    path: &'a str,
    starting_time: SinceEpoch,
    duration: Nanoseconds,
    message_count: u64,
}

/// Writes `metadata.yaml` into the bag directory, atomically.
pub(crate) fn write(bag: &BagSummary) -> Result<(), BagError> {
    let path = bag.directory.join(FILE_NAME);
    atomic::replace(&path, text(bag).as_bytes()).map_err(BagError::io(path, "writing the metadata"))
}

fn text(bag: &BagSummary) -> String {
    let files: Vec<FileInformation> = bag
        .files
        .iter()
        .map(|file| FileInformation {
            path: file.path.file_name().and_then(|name| name.to_str()).unwrap_or_default(),
            starting_time: starting_time(file.start),
            duration: duration(file.start, file.end),
            message_count: file.messages,
        })
        .collect();
    serde_saphyr::to_string(&Document {
        rosbag2_bagfile_information: Information {
            version: VERSION,
            storage_identifier: "mcap",
            duration: duration(bag.start, bag.end),
            starting_time: starting_time(bag.start),
            message_count: bag.messages,
            topics_with_message_count: topics(bag),
            // MCAP compresses its chunks; these two are about compressed files and messages.
            compression_format: "",
            compression_mode: "",
            relative_file_paths: files.iter().map(|file| file.path).collect(),
            files,
            custom_data: (!bag.custom_data.is_empty()).then_some(&bag.custom_data),
            ros_distro: &bag.distro,
        },
    })
    .expect("structs of numbers and strings with fixed keys are always YAML")
}

fn starting_time(start: Option<Stamp>) -> SinceEpoch {
    SinceEpoch { nanoseconds_since_epoch: start.map_or(0, |start| start.0) }
}

fn duration(start: Option<Stamp>, end: Option<Stamp>) -> Nanoseconds {
    Nanoseconds { nanoseconds: start.zip(end).map_or(0, |(start, end)| end.0 - start.0) }
}

/// Each topic and type once, with the QoS profiles of all its channels.
fn topics(bag: &BagSummary) -> Vec<TopicWithCount<'_>> {
    let mut topics: Vec<TopicWithCount> = Vec::new();
    for topic in &bag.topics {
        let offered = qos::parse(topic.channel.offered_qos());
        let known = topics.iter_mut().find(|known| {
            known.topic_metadata.name == topic.name
                && known.topic_metadata.r#type == topic.type_name
        });
        if let Some(known) = known {
            known.message_count += topic.messages;
            for profile in offered {
                if !known.topic_metadata.offered_qos_profiles.contains(&profile) {
                    known.topic_metadata.offered_qos_profiles.push(profile);
                }
            }
            continue;
        }
        topics.push(TopicWithCount {
            topic_metadata: TopicMetadata {
                name: &topic.name,
                r#type: &topic.type_name,
                serialization_format: &topic.channel.encoding,
                offered_qos_profiles: offered,
                type_description_hash: &topic.hash,
            },
            message_count: topic.messages,
        });
    }
    topics
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
    #[expect(dead_code, reason = "required of every version")]
    message_count: u64,
    #[serde(default)]
    compression_mode: String,
    #[serde(default)]
    custom_data: Option<CustomData>,
}

/// The fields that are needed, and all fields as they were read.
fn read(path: &Path) -> Result<(ReadInformation, Description), BagError> {
    let text =
        eddy_storage::read_to_string(path).map_err(BagError::io(path, "reading the metadata"))?;
    let document: ReadDocument = serde_saphyr::from_str(&text).map_err(|error| {
        wrong(
            path,
            "rosbag2_bagfile_information",
            qos::yaml_words(&error),
            "the fields that rosbag2 writes",
        )
    })?;
    let information = document.rosbag2_bagfile_information;
    let custom_data = information.custom_data.clone().unwrap_or_default();
    let description = Description { custom_data, ..Description::parse(&text) };
    Ok((information, description))
}

fn wrong(path: &Path, field: &'static str, found: String, expected: &'static str) -> BagError {
    BagError::Metadata { path: path.into(), field, found, expected }
}

/// The MCAP files in `directory` that `metadata.yaml` at `path` lists, and what else it says.
pub(crate) fn files(
    path: &Path,
    directory: &Path,
) -> Result<(Vec<PathBuf>, Description), BagError> {
    let (information, description) = read(path)?;
    if information.version > VERSION {
        tracing::warn!(
            "{}: version: found {}, which is newer than {VERSION}; what is new in it is ignored",
            path.display(),
            information.version
        );
    }
    let storage = information.storage_identifier.as_str();
    let are_mcap = || information.relative_file_paths.iter().all(|name| is_mcap(Path::new(name)));
    // Some versions of rosbag2 write an empty text (rosbag2 #2175).
    if storage != "mcap" && !(storage.is_empty() && are_mcap()) {
        return Err(wrong(path, "storage_identifier", format!("`{storage}`"), "mcap"));
    }
    if !matches!(information.compression_mode.to_lowercase().as_str(), "" | "none") {
        let expected =
            "an empty text; `zstd -d` decompresses the files of FILE mode, then `eddy bag reindex`";
        return Err(wrong(path, "compression_mode", information.compression_mode, expected));
    }
    // Only the file name of each path counts: bags are moved, and older versions wrote longer paths.
    let file = |name: &String| Path::new(name).file_name().map(|name| directory.join(name));
    let files: Vec<PathBuf> = information.relative_file_paths.iter().filter_map(file).collect();
    let expected = "names of files beside metadata.yaml";
    for file in &files {
        if !exists(file)? {
            let found = format!("{}, which does not exist", file.display());
            return Err(wrong(path, "relative_file_paths", found, expected));
        }
    }
    if files.is_empty() {
        return Err(wrong(path, "relative_file_paths", "no file".into(), expected));
    }
    Ok((files, description))
}

/// Whether there is something at a path.
pub(super) fn exists(path: &Path) -> Result<bool, BagError> {
    eddy_storage::exists(path).map_err(BagError::io(path, "looking for the file"))
}

/// What `metadata.yaml` of the bag at `bag` says, as far as it can be read; `None` without one.
pub(crate) fn readable(bag: &Path) -> Option<Description> {
    let text = eddy_storage::read_to_string(&bag.join(FILE_NAME)).ok()?;
    Some(Description::parse(&text))
}

#[cfg(test)]
mod tests {
    use std::{fs, sync::Arc};

    use super::*;
    use eddy_messages::QosProfile;

    use crate::format::{
        channel::{Channel, OFFERED_QOS},
        summary::{OURS, WrittenFile, WrittenTopic},
    };

    fn bag() -> BagSummary {
        let channel = Channel {
            topic: "/particles".into(),
            schema: None,
            encoding: "cdr".into(),
            metadata: BTreeMap::from([(
                OFFERED_QOS.to_owned(),
                qos::offered_profiles(&[QosProfile::default()]),
            )]),
        };
        let topic = WrittenTopic {
            name: "/particles".into(),
            type_name: "eddy_msgs/msg/ParticleFrame".into(),
            hash: "RIHS01_00".into(),
            messages: 3,
            channel: Arc::new(channel),
        };
        let file = WrittenFile {
            path: "run/run_0.mcap".into(),
            messages: 3,
            start: Some(Stamp(1_000)),
            end: Some(Stamp(33_000)),
            size: 0,
        };
        BagSummary {
            directory: "run".into(),
            files: vec![file],
            messages: 3,
            lost: 0,
            start: Some(Stamp(1_000)),
            end: Some(Stamp(33_000)),
            topics: vec![topic],
            custom_data: BTreeMap::new(),
            distro: OURS.into(),
        }
    }

    #[test]
    fn every_file_of_a_split_bag_is_listed_beside_the_custom_data() {
        let mut bag = bag();
        let second = WrittenFile { path: "run/run_1.mcap".into(), ..bag.files[0].clone() };
        bag.files.push(second);
        bag.custom_data.insert("not_recorded".into(), "7".into());
        let text = text(&bag);
        assert!(text.contains("relative_file_paths:\n  - run_0.mcap\n  - run_1.mcap\n"), "{text}");
        assert!(text.contains("  - path: run_1.mcap\n"), "{text}");
        assert!(text.contains("custom_data:\n    not_recorded: \"7\"\n"), "{text}");
    }

    #[test]
    fn the_text_is_what_rosbag2_writes() {
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
    fn unusable_metadata_is_rejected_with_field_found_and_expected() {
        let good = text(&bag());
        let cases = [
            (
                "_identifier: mcap",
                "_identifier: sqlite3",
                "storage_identifier: found `sqlite3`, expected mcap",
            ),
            (
                "compression_mode: \"\"",
                "compression_mode: FILE",
                "compression_mode: found FILE, expected an empty text; `zstd -d`",
            ),
            (
                "  - run_0.mcap",
                "  - gone.mcap",
                "gone.mcap, which does not exist, expected names of files",
            ),
            ("message_count: 3", "message_count: many", "rosbag2_bagfile_information: found"),
            (
                "  version: 9",
                "  version: 9\n  version: 8",
                "found duplicate mapping key `version` is not allowed here at line 3, column 3, expected the fields",
            ),
        ];
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join(FILE_NAME);
        fs::write(directory.path().join("run_0.mcap"), "").unwrap();
        fs::write(&path, &good).unwrap();
        assert_eq!(
            files(&path, directory.path()).unwrap().0,
            [directory.path().join("run_0.mcap")]
        );
        for (from, to, expected) in cases {
            assert!(good.contains(from), "{from} in {good}");
            fs::write(&path, good.replacen(from, to, 1)).unwrap();
            let message = files(&path, directory.path()).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        }
    }

    #[test]
    fn a_newer_version_is_read_without_what_is_new_in_it() {
        let directory = tempfile::tempdir().unwrap();
        let (path, file) = (directory.path().join(FILE_NAME), directory.path().join("run_0.mcap"));
        fs::write(&file, "").unwrap();
        let newer = text(&bag()).replacen("version: 9", "version: 11\n  clock: {source: ros}", 1);
        fs::write(&path, newer).unwrap();
        assert_eq!(files(&path, directory.path()).unwrap().0, [file]);
    }
}
