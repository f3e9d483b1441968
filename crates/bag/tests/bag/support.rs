//! Bags for tests, and operations on them.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
};

use eddy_bag::{
    BagError, BagReader, BagWriter, Channel, Compression, CopyOptions, Recovered, Recovery,
    Reindexed, Reindexing, Split, Survey, WriterOptions,
};
use eddy_frames::Stamp;
use eddy_messages::{Message, RosString, cdr};
use mcap::records::MessageHeader;
use tempfile::TempDir;

/// The CDR of a string.
pub fn word(text: &str) -> Vec<u8> {
    cdr::encode(&RosString { data: text.into() })
}

/// Everything that is wrong with a bag.
pub fn findings(path: &Path) -> Vec<String> {
    let bag = BagReader::open(path).unwrap();
    let mut survey = Survey::of(&bag, |_| ());
    survey.check_files(&bag);
    survey.findings.iter().map(ToString::to_string).collect()
}

/// The properties of a message that must not change: topic, sequence number, both times, data, channel.
pub type Whole = (String, u32, i64, i64, Vec<u8>, Channel);

pub fn messages(path: &Path) -> Vec<Whole> {
    let messages = BagReader::open(path).unwrap().messages().map(Result::unwrap);
    messages
        .map(|m| {
            let (log, publish) = (m.log_time.0, m.publish_time.0);
            (m.topic.to_string(), m.sequence, log, publish, m.data, (*m.channel).clone())
        })
        .collect()
}

pub fn copying(on_message: &mut dyn FnMut() -> bool) -> CopyOptions<'_> {
    let custom_data = BTreeMap::new();
    CopyOptions { writer: WriterOptions::default(), custom_data, on_message }
}

pub fn recover(path: &Path, output: &Path) -> Result<Recovered, BagError> {
    Recovery::open(path, &mut |_| true)?.save(output, copying(&mut || true))
}

pub fn reindex(path: &Path) -> Result<Reindexed, BagError> {
    Reindexing::open(path, &mut |_| true)?.save(&mut |_| true)
}

/// A recording of another program: unknown types, IDL definitions, sequence numbers and QoS of its own, a topic without
/// messages.
pub fn write_foreign(path: &Path, times: &[u64], options: mcap::WriteOptions) {
    let mut writer = options.create(fs::File::create(path).unwrap()).unwrap();
    let imu = writer.add_schema("acme_msgs/msg/Imu", "ros2idl", b"module acme {};").unwrap();
    let of_words = writer.add_schema(RosString::TYPE, "ros2msg", b"string data").unwrap();
    let about = |hash: &str| {
        BTreeMap::from([
            ("offered_qos_profiles".to_owned(), "- history: 3\n  depth: 0\n".to_owned()),
            ("topic_type_hash".to_owned(), hash.to_owned()),
            ("driver".to_owned(), "v7".to_owned()),
        ])
    };
    let channels = [
        writer.add_channel(imu, "/imu", "cdr", &about("RIHS01_77")).unwrap(),
        writer.add_channel(of_words, "/words", "cdr", &about("")).unwrap(),
        writer.add_channel(0, "/untyped", "json", &BTreeMap::new()).unwrap(),
    ];
    writer.add_channel(of_words, "/silent", "cdr", &about("")).unwrap();
    for (number, &log_time) in (0..).zip(times) {
        let header = MessageHeader {
            channel_id: channels[number as usize % 3],
            sequence: 1_000 + 7 * number,
            log_time,
            publish_time: log_time / 2,
        };
        writer.write_to_known_channel(&header, &word(&number.to_string())).unwrap();
    }
    writer.finish().unwrap();
}

pub fn small_chunks() -> mcap::WriteOptions {
    mcap::WriteOptions::new().chunk_size(Some(200))
}

/// A folder with `whole.mcap`.
pub struct Folder(pub TempDir);

impl Folder {
    pub fn new() -> Self {
        let folder = Self(tempfile::tempdir().unwrap());
        let times: Vec<u64> = (0..60).map(|number| 1_000_000_000 + number * 50_000_000).collect();
        write_foreign(&folder.join("whole.mcap"), &times, small_chunks());
        folder
    }

    pub fn join(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    pub fn path(&self, name: &str) -> String {
        self.join(name).to_str().unwrap().to_owned()
    }

    pub fn names(&self) -> Vec<String> {
        let entries = fs::read_dir(self.0.path()).unwrap();
        let mut names: Vec<_> =
            entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }
}

/// A split bag of 30 messages, and its files.
pub fn write_split(path: &Path, split: Split) -> Vec<PathBuf> {
    let compression = Compression::None;
    let options = WriterOptions { compression, chunk_size: 300, split };
    let mut bag = BagWriter::create(path, options).unwrap();
    let topic = bag.topic("/words", RosString::TYPE).unwrap();
    for number in 0..30 {
        if number == 20 {
            bag.topic("/later", RosString::TYPE).unwrap();
        }
        let time = Stamp(number * 100_000_000);
        bag.write(topic, time, time, &word(&format!("{number:0100}"))).unwrap();
    }
    let summary = bag.finish().unwrap();
    assert_eq!((summary.messages, summary.lost), (30, 0));
    summary.files.into_iter().map(|file| file.path).collect()
}

/// A file with chunks of several messages, an attachment and two metadata records, one of them rosbag2's.
pub fn write_with_auxiliary(path: &Path, times: std::ops::Range<u64>) {
    let mut writer = small_chunks().create(fs::File::create(path).unwrap()).unwrap();
    let channel = writer.add_channel(0, "/a", "cdr", &BTreeMap::new()).unwrap();
    for (sequence, log_time) in (0..).zip(times) {
        let header = MessageHeader { channel_id: channel, sequence, log_time, publish_time: 0 };
        writer.write_to_known_channel(&header, &word("a")).unwrap();
        if sequence == 20 {
            writer.attach(&calibration()).unwrap();
            for name in ["rosbag2", "place"] {
                writer.write_metadata(&about(name)).unwrap();
            }
        }
    }
    writer.finish().unwrap();
}

pub fn calibration() -> mcap::Attachment<'static> {
    mcap::Attachment {
        log_time: 1,
        create_time: 2,
        name: "camera.yaml".to_owned(),
        media_type: "text/yaml".to_owned(),
        data: b"f: 500".into(),
    }
}

pub fn about(name: &str) -> mcap::records::Metadata {
    let metadata = [("hall".to_owned(), "3".to_owned())].into();
    mcap::records::Metadata { name: name.to_owned(), metadata }
}

/// The attachments and metadata records of a bag of one file, read by mcap's own reader.
pub fn auxiliary(bag: &Path) -> (Vec<mcap::Attachment<'static>>, Vec<mcap::records::Metadata>) {
    let reader = BagReader::open(bag).unwrap();
    let bytes = fs::read(reader.files().next().unwrap()).unwrap();
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    let attachments = summary.attachment_indexes.iter().map(|index| {
        let found = mcap::read::attachment(&bytes, index).unwrap();
        let data = found.data.into_owned().into();
        mcap::Attachment { data, ..found }
    });
    let metadata = summary.metadata_indexes.iter();
    let metadata = metadata.map(|index| mcap::read::metadata(&bytes, index).unwrap());
    (attachments.collect(), metadata.collect())
}
