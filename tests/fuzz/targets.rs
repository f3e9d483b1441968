//! Fuzz targets, one for each kind of external input: none may panic or use unbounded memory or time. Both runs call them:
//! `main.rs`, the short one, and `fuzz_targets/`, the long one.

use std::{
    collections::BTreeMap,
    fs,
    num::NonZeroUsize,
    path::{Path, PathBuf},
};

use serde::{Serialize, de::DeserializeOwned};

use eddy_bag::{
    BagReader, CopyOptions, Recovery, Reindexing, Selection, Survey, WriterOptions, extract,
};
use eddy_frames::{AnyFrame, Frame, Stamp, with_frame};
use eddy_inference::{
    checkpoint::{Architecture, Checkpoint},
    engine::Surrogate,
};
use eddy_learning::train::TrainConfig;
use eddy_messages::{
    Clock, DiagnosticArray, FrameCdr, ParticleFrame, PredictionStatus, RosString, cdr, services,
};
use eddy_mpm::Scene;
use eddy_node::{NodeSettings, launch::Plan};
use eddy_settings::{self as config, Overrides};
use eddy_transport::foreign;

/// A fuzz target: its name, also of its folder in `tests/fuzz/corpus`, and its function.
pub type Target = (&'static str, fn(&[u8]));

/// All targets.
pub const TARGETS: [Target; 9] = [
    ("cdr", messages),
    ("mcap", bag),
    ("metadata", metadata),
    ("attachment", foreign::attachment),
    ("names", names),
    ("shm", foreign::shm_sample),
    ("checkpoint", checkpoint),
    ("toml", settings),
    ("scene", scene),
];

/// Runs a target on an input.
///
/// # Panics
/// When there is no such target, or the input reveals a bug.
pub fn read(kind: &str, bytes: &[u8]) {
    let (_, target) = TARGETS.iter().find(|(name, _)| *name == kind).expect("one of TARGETS");
    target(bytes);
}

/// Decodes CDR as each external message, request and response.
fn messages(bytes: &[u8]) {
    reads::<ParticleFrame>(bytes);
    reads::<PredictionStatus>(bytes);
    reads::<DiagnosticArray>(bytes);
    reads::<Clock>(bytes);
    reads::<RosString>(bytes);
    reads::<services::Empty>(bytes);
    reads::<services::TriggerResponse>(bytes);
    reads::<services::ParameterNames>(bytes);
    reads::<services::GetParametersResponse>(bytes);
    reads::<services::GetParameterTypesResponse>(bytes);
    reads::<services::SetParametersRequest>(bytes);
    reads::<services::SetParametersResponse>(bytes);
    reads::<services::SetParametersAtomicallyResponse>(bytes);
    reads::<services::ListParametersRequest>(bytes);
    reads::<services::ListParametersResponse>(bytes);
    reads::<services::DescribeParametersResponse>(bytes);
    if let Ok(frame) = AnyFrame::from_cdr(bytes) {
        with_frame!(&frame, frame => frame.check()).expect("decoded frames are valid");
        assert_eq!(AnyFrame::from_cdr(&frame.to_cdr()).as_ref(), Ok(&frame));
        let readers = [Frame::<2>::from_cdr(bytes).is_ok(), Frame::<3>::from_cdr(bytes).is_ok()];
        let is_plane = matches!(frame, AnyFrame::Two(_));
        assert_eq!(readers, [is_plane, !is_plane], "who knows one dimension takes that one");
    }
}

/// Checks that decoded messages survive a round trip.
fn reads<M: Serialize + DeserializeOwned>(bytes: &[u8]) {
    if let Ok(message) = cdr::decode::<M>(bytes) {
        let written = cdr::encode(&message);
        let again: M = cdr::decode(&written).expect("encoded messages can be decoded");
        assert_eq!(cdr::encode(&again), written);
    }
}

/// A temporary folder of this process.
struct Folder(PathBuf);

impl Folder {
    fn new() -> Self {
        // In memory if possible, for thousands of files.
        let shared = Path::new("/dev/shm");
        let parent = if shared.is_dir() { shared.to_owned() } else { std::env::temp_dir() };
        let folder = parent.join(format!("eddy_fuzz_{}", std::process::id()));
        let _ = fs::remove_dir_all(&folder);
        fs::create_dir_all(&folder).expect("the folder for temporary files can be written to");
        Self(folder)
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

/// Reads an MCAP file in every way: as a bag, to check, copy, recover and reindex it.
fn bag(bytes: &[u8]) {
    let folder = Folder::new();
    let at = |name: &str| folder.0.join(name);
    let file = at("input.mcap");
    fs::write(&file, bytes).expect("the folder can be written to");
    if let Ok(bag) = BagReader::open(&file) {
        let times: Vec<_> = bag.messages().flatten().map(|message| message.log_time).collect();
        let read = times.len();
        for topic in bag.topics() {
            if let Ok(frames) = bag.frames(&topic.name) {
                frames.for_each(drop);
            }
        }
        let mut survey = Survey::of(&bag, |_| ());
        survey.check_files(&bag);
        if let Some(&middle) = times.get(read / 2) {
            let count = |from, until| {
                let part = Selection { topics: None, from, until };
                bag.select(&part).flatten().count()
            };
            let after = Some(Stamp(middle.0.saturating_add(1)));
            let parts = count(None, Some(middle)) + count(after, None);
            assert!(
                parts == read || middle == Stamp(i64::MAX) || survey.finding_count() > 0,
                "messages are lost without a finding: {parts} of {read}"
            );
        }
        let on_message: &mut dyn FnMut() -> bool = &mut || true;
        let options = CopyOptions {
            writer: WriterOptions::default(),
            custom_data: BTreeMap::new(),
            on_message,
        };
        if let Ok(copy) = extract(&bag, &Selection::default(), &at("copy"), options) {
            assert_eq!(copy.messages, read as u64, "a copy has every message");
        }
    }
    if let Ok(recovery) = Recovery::open(&file, &mut |_| true) {
        let on_message: &mut dyn FnMut() -> bool = &mut || true;
        let options = CopyOptions {
            writer: WriterOptions::default(),
            custom_data: BTreeMap::new(),
            on_message,
        };
        if let Ok(saved) = recovery.save(&at("saved"), options) {
            let bag = BagReader::open(&at("saved")).expect("recovered bags can be opened");
            assert!(bag.damage().is_none(), "recovered bags are undamaged: {:?}", bag.damage());
            assert_eq!(bag.messages().filter(Result::is_ok).count() as u64, saved.bag.messages);
        }
    }
    let reindexing = Reindexing::open(&file, &mut |_| true);
    if reindexing.and_then(|reindexing| reindexing.save(&mut |_| true)).is_ok() {
        let bag = BagReader::open(&file).expect("reindexed bags can be opened");
        assert!(bag.damage().is_none(), "reindexed bags are undamaged: {:?}", bag.damage());
    }
}

/// Reads a `metadata.yaml` beside a bag file.
fn metadata(bytes: &[u8]) {
    let folder = Folder::new();
    fs::write(folder.0.join("metadata.yaml"), bytes).expect("the folder can be written to");
    fs::write(folder.0.join("bag_0.mcap"), b"").expect("the folder can be written to");
    if let Ok(bag) = BagReader::open(&folder.0) {
        Survey::of(&bag, |_| ());
    }
    let _ = Recovery::open(&folder.0, &mut |_| true);
}

/// Parses names from other programs and users.
fn names(bytes: &[u8]) {
    foreign::names(&String::from_utf8_lossy(bytes));
}

/// Reads a checkpoint: the description up to the first zero byte, then the weights.
fn checkpoint(bytes: &[u8]) {
    let (description, weights) = halves(bytes);
    let description = String::from_utf8_lossy(description);
    if let Ok(checkpoint) = Checkpoint::parse(Path::new("input"), &description, weights) {
        checkpoint.digest();
        // Rejects networks that are too large or cannot stream.
        let _ = Surrogate::load(&checkpoint, Some(NonZeroUsize::MIN));
    }
}

fn halves(bytes: &[u8]) -> (&[u8], &[u8]) {
    let middle = bytes.iter().position(|byte| *byte == 0).unwrap_or(bytes.len());
    (&bytes[..middle], bytes.get(middle + 1..).unwrap_or_default())
}

/// Reads all kinds of settings files.
fn settings(bytes: &[u8]) {
    let (file, text) = (Path::new("input.toml"), String::from_utf8_lossy(bytes));
    if let Ok(plan) = config::parse::<Plan>(file, &text) {
        let _ = plan.check();
    }
    let _ = config::parse::<NodeSettings>(file, &text);
    if let Ok(overrides) = Overrides::parse(file, &text) {
        for architecture in [Architecture::Frame, Architecture::Particle] {
            if let Ok(config) = overrides.over(&TrainConfig::defaults(architecture)) {
                let _ = config.check();
            }
        }
    }
}

/// Reads and checks a scene file.
fn scene(bytes: &[u8]) {
    let (file, text) = (Path::new("input.toml"), String::from_utf8_lossy(bytes));
    if let Ok(scene) = config::parse::<Scene>(file, &text)
        && scene.check().is_ok()
    {
        let _ = (scene.memory(), scene.estimate(), scene.materials(), scene.fastest());
    }
}
