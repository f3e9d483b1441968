//! Makes the corpus's first inputs: one that is whole for each thing that a kind may be. What a run finds
//! is added to them by hand, under a name that says what it was.

use std::{collections::BTreeMap, fs, path::Path};

use eddy_bag::{BagWriter, Compression, WriterOptions};
use eddy_frames::{Domain, Frame, Material, Stamp};
use eddy_inference::{
    checkpoint::{Architecture, Checkpoint, Core, Description, Sizes, Weights, tensor_shapes},
    engine::Surrogate,
};
use eddy_messages::{
    Clock, DiagnosticArray, DiagnosticStatus, FrameCdr, KeyValue, Message, ParticleFrame,
    PredictionStatus, RosString, StreamState, cdr, services,
};
use mcap::records::MessageHeader;
use serde::Serialize;

use super::corpus;

fn keep(target: &str, name: &str, bytes: impl AsRef<[u8]>) {
    fs::create_dir_all(corpus(target)).unwrap();
    fs::write(corpus(target).join(name), bytes).unwrap();
}

fn frame<const D: usize>(sequence: u64) -> Frame<D> {
    let vectors = |of: [[f32; 3]; 2]| of.map(|all| std::array::from_fn(|axis| all[axis])).to_vec();
    Frame {
        stream: 3,
        sequence,
        stamp: Stamp(sequence as i64 * 16_000_000),
        dt: 0.016,
        domain: Domain { lower: [0.0; D], upper: [1.0; D] },
        position: vectors([[0.25, 0.5, 0.75], [0.5, 0.75, 0.25]]),
        velocity: vectors([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0]]),
        material: vec![Material::Liquid, Material::Snow],
    }
}

#[test]
#[ignore = "writes the corpus"]
fn write_the_first_inputs() {
    messages();
    bags();
    attachments_and_names();
    samples();
    checkpoints();
    texts();
}

fn messages() {
    keep("cdr", "particle_frame", frame::<2>(1).to_cdr());
    keep("cdr", "particle_frame_in_space", frame::<3>(1).to_cdr());
    let status = PredictionStatus {
        header: Default::default(),
        stream: 1,
        source_sequence: 2,
        horizon: 3,
        state: StreamState::Tracking as u8,
        latency: 0.001,
        model: "0123456789ab".to_owned(),
    };
    encoded("prediction_status", &status);
    let values = vec![KeyValue { key: "rate".to_owned(), value: "62.5".to_owned() }];
    let status = DiagnosticStatus { name: "eddy_node".to_owned(), values, ..Default::default() };
    encoded("diagnostics", &DiagnosticArray { status: vec![status], ..Default::default() });
    encoded("clock", &Clock::default());
    encoded("string", &RosString { data: "eddy".to_owned() });
    let parameter = services::Parameter { name: "horizon".to_owned(), ..Default::default() };
    let names = services::ParameterNames { names: vec!["horizon".to_owned(); 2] };
    encoded("parameter_names", &names);
    encoded("set_parameters", &services::SetParametersRequest { parameters: vec![parameter] });
    let descriptors = vec![services::ParameterDescriptor::default()];
    encoded("descriptors", &services::DescribeParametersResponse { descriptors });
}

fn encoded<M: Serialize>(name: &str, message: &M) {
    keep("cdr", name, cdr::encode(message));
}

fn bags() {
    let folder = tempfile::tempdir().unwrap();
    for (name, compression) in
        [("none", Compression::None), ("lz4", Compression::Lz4), ("zstd", Compression::Zstd)]
    {
        let options = WriterOptions { compression, chunk_size: 200, ..Default::default() };
        let path = folder.path().join(name);
        let mut bag = BagWriter::create(&path, options).unwrap();
        let particles = bag.topic("/particles", ParticleFrame::TYPE).unwrap();
        let words = bag.topic("/words", RosString::TYPE).unwrap();
        for number in 0..6 {
            let frame = frame::<2>(number);
            bag.write(particles, frame.stamp, frame.stamp, &frame.to_cdr()).unwrap();
        }
        bag.write(words, Stamp(7), Stamp(8), &[0, 1, 0, 0, 1, 0, 0, 0, 0]).unwrap();
        let file = bag.finish().unwrap().files[0].path.clone();
        keep("mcap", name, fs::read(file).unwrap());
        keep("metadata", name, fs::read(path.join("metadata.yaml")).unwrap());
    }
    let loose = mcap::WriteOptions::new().use_chunks(false);
    keep("mcap", "loose", foreign(&folder.path().join("loose"), loose));
    let bare = mcap::WriteOptions::new().emit_summary_records(false).chunk_size(Some(100));
    keep("mcap", "bare", foreign(&folder.path().join("bare"), bare));
    keep("mcap", "record_that_claims_too_much", record_that_claims_too_much());
    keep("mcap", "id_declared_twice", id_declared_twice());
    let whole = fs::read(corpus("mcap").join("none")).unwrap();
    // Chunk index, chunk and message index, each with another time (MCAP specification, "Records").
    for (name, opcode, field) in [
        ("chunk_index_that_ends_too_early", 8, 8),
        ("chunk_that_begins_too_late", 6, 0),
        ("message_index_with_another_time", 7, 6),
    ] {
        let mut bytes = whole.clone();
        let body = records(&whole).into_iter().find(|(found, _)| *found == opcode).unwrap().1;
        bytes[body + field..body + field + 8].copy_from_slice(&1_u64.to_le_bytes());
        keep("mcap", name, bytes);
    }
}

/// Opcode and start of the body of each record of a file, without those in chunks.
fn records(bytes: &[u8]) -> Vec<(u8, usize)> {
    let (mut records, mut start) = (Vec::new(), 8);
    while let Some(length) = bytes.get(start + 1..start + 9) {
        records.push((bytes[start], start + 9));
        start += 9 + u64::from_le_bytes(length.try_into().unwrap()) as usize;
    }
    records
}

/// A file without chunks that declares a channel as two topics, with a message each.
fn id_declared_twice() -> Vec<u8> {
    let record = |opcode: u8, body: &[u8]| {
        [&[opcode][..], &(body.len() as u64).to_le_bytes(), body].concat()
    };
    let text = |text: &str| [&(text.len() as u32).to_le_bytes()[..], text.as_bytes()].concat();
    let channel = |topic: &str| {
        record(4, &[&[1, 0, 0, 0][..], &text(topic), &text("json"), &[0; 4]].concat())
    };
    let message = record(5, &[&[1, 0][..], &[0; 20], b"1"].concat());
    let parts = [channel("/left"), message.clone(), channel("/right"), message];
    let ends = [record(15, &[0; 4]), record(2, &[0; 20])].concat();
    let magic = &b"\x89MCAP0\r\n"[..];
    [magic, &record(1, &[0; 8]), &parts.concat(), &ends, magic].concat()
}

/// A file with a chunk of nine bytes, in which a record says that it is 512 MiB long.
fn record_that_claims_too_much() -> Vec<u8> {
    let record = |opcode: u8, body: &[u8]| {
        [&[opcode][..], &(body.len() as u64).to_le_bytes(), body].concat()
    };
    let content = [&[5][..], &(1_u64 << 29).to_le_bytes()].concat();
    // A frame of zstd with one block as it is (RFC 8878, 3.1.1).
    let frame = [&[0x28, 0xb5, 0x2f, 0xfd, 0x20, 9, 9 << 3 | 1, 0, 0][..], &content].concat();
    // Two times, size, no checksum.
    let (times, size, crc) = ([0; 16], 9_u64.to_le_bytes(), [0; 4]);
    let name = [&4_u32.to_le_bytes()[..], b"zstd"].concat();
    let length = (frame.len() as u64).to_le_bytes();
    let chunk = [&times[..], &size, &crc, &name, &length, &frame].concat();
    [&b"\x89MCAP0\r\n"[..], &record(1, &[0; 8]), &record(6, &chunk)].concat()
}

/// A file of another program, with an attachment and a metadata record.
fn foreign(file: &Path, options: mcap::WriteOptions) -> Vec<u8> {
    let mut writer = options.create(fs::File::create(file).unwrap()).unwrap();
    let schema = writer.add_schema("acme_msgs/msg/Imu", "ros2idl", b"module acme {};").unwrap();
    let channel_id = writer.add_channel(schema, "/imu", "cdr", &BTreeMap::new()).unwrap();
    for time in 0..6 {
        let header =
            MessageHeader { channel_id, sequence: time, log_time: time.into(), publish_time: 1 };
        writer.write_to_known_channel(&header, &[0, 1, 0, 0, 42]).unwrap();
    }
    let attachment = mcap::Attachment {
        log_time: 1,
        create_time: 2,
        name: "calibration".to_owned(),
        media_type: "text/plain".to_owned(),
        data: b"f = 500".into(),
    };
    writer.attach(&attachment).unwrap();
    let metadata = [("place".to_owned(), "hall".to_owned())].into();
    writer.write_metadata(&mcap::records::Metadata { name: "about".to_owned(), metadata }).unwrap();
    writer.finish().unwrap();
    fs::read(file).unwrap()
}

fn attachments_and_names() {
    keep("attachment", "whole", b"\x01\0\0\0\0\0\0\0\x02\x01\0\0\0\0\0\0\x100123456789abcdef");
    let token = "@ros2_lv/0/1234567890abcdef1234567890abcdef/0/1/MP/%/%/node/%left%particles/eddy_msgs::msg::dds_::ParticleFrame_/RIHS01_00/2::,10:,:,:,,";
    keep("names", "token", token);
    keep("names", "link", "zenoh:/left/particles");
}

fn samples() {
    let mut bits = Vec::new();
    for long in [3_u64, 1, 16_000_000] {
        bits.extend_from_slice(&long.to_le_bytes());
    }
    for number in [0.016_f32, 0.0, 0.0, 1.0, 1.0] {
        bits.extend_from_slice(&number.to_le_bytes());
    }
    for material in [0_u32, 3] {
        for number in [0.25_f32, 0.5, 0.0, -1.0] {
            bits.extend_from_slice(&number.to_le_bytes());
        }
        bits.extend_from_slice(&material.to_le_bytes());
    }
    keep("shm", "two_particles", bits);
}

fn checkpoints() {
    for core in Core::ALL {
        let sizes = Sizes { encoder: 2, hidden: 3, layers: 1, particles: Some(2) };
        let description = Description::untrained(Architecture::Frame, core, sizes);
        untrained(&format!("{core:?}").to_lowercase(), description);
    }
    let sizes = Sizes { encoder: 1, hidden: 1, layers: 1, particles: None };
    let mut description = Description::untrained(Architecture::Particle, Core::MinGru, sizes);
    // With channels of a useful number it would be too large to be changed to some effect.
    description.grid.as_mut().unwrap().channels = vec![1; 3];
    untrained("particle", description);
}

fn untrained(name: &str, description: Description) {
    let folder = tempfile::tempdir().unwrap();
    let tensors = tensor_shapes(&description).into_iter().map(|(name, shape)| {
        let values = vec![0.125; shape.iter().product()];
        (name, Weights { shape, values })
    });
    let checkpoint = Checkpoint::new(description, tensors.collect());
    checkpoint.save(folder.path()).unwrap();
    Surrogate::load(&Checkpoint::load(folder.path()).unwrap(), None).unwrap();
    let read = |name: &str| fs::read(folder.path().join(name)).unwrap();
    let bytes = [read("model.toml"), vec![0], read("model.safetensors")].concat();
    keep("checkpoint", name, bytes);
}

fn texts() {
    let configs = Path::new(env!("CARGO_MANIFEST_DIR")).join("launch_configs");
    let files = |folder: &Path| {
        let files = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
        files.filter(|file| file.extension().is_some_and(|end| end == "toml")).collect::<Vec<_>>()
    };
    let folders = [
        ("launch", "toml"),
        ("node", "toml"),
        ("scenes", "scene"),
        ("study", "toml"),
        ("train", "toml"),
    ];
    for (folder, target) in folders {
        for file in files(&configs.join(folder)) {
            let name = file.file_stem().unwrap().to_str().unwrap();
            keep(target, name, fs::read(&file).unwrap());
        }
    }
    keep("scene", "empty", "");
}
