//! Frames that no model can use: the same finding wherever they are read, before anything is trained, predicted or written.

use std::{
    fs::{self, File},
    io::Write as _,
    path::{Path, PathBuf},
    sync::LazyLock,
    time::Duration,
};

use eddy_bag::{BagReader, BagWriter, Survey, WriterOptions};
use eddy_dataset::{LoadOptions, load_trajectories, survey_streams};
use eddy_exchange::{ImportFormat, ImportOverrides, import};
use eddy_frames::Stamp;
use eddy_inference::{checkpoint::Checkpoint, engine::Surrogate};
use eddy_messages::{Message, ParticleFrame, cdr};
use eddy_node::{NodeSettings, SurrogateNode};
use eddy_transport::Payload;
use proptest::prelude::*;
use tempfile::TempDir;
use zip::{ZipWriter, write::SimpleFileOptions};

use crate::support::{eddy, fail, succeed};

const PARTICLES: usize = 12;
const FRAMES: u64 = 30;
const STREAM: u64 = 7;

/// A frame of a block of water that drifts in a square of this side.
fn frame(stream: u64, sequence: u64, side: f32) -> ParticleFrame {
    let place = |p: usize| [0.3 + 0.008 * (p % 4) as f32, 0.4 + 0.008 * (p / 4) as f32];
    let drift = |p: usize| [0.1 + 0.01 * p as f32, -0.05 * (p % 3) as f32];
    let time = 0.016 * sequence as f32;
    let numbers = |of: &dyn Fn(usize) -> [f32; 2]| (0..PARTICLES).flat_map(of).collect::<Vec<_>>();
    let mut message = ParticleFrame {
        stream,
        sequence,
        dt: 0.016,
        lower: vec![0.0; 2],
        upper: vec![side; 2],
        position: numbers(&|p| [0, 1].map(|axis| side * (place(p)[axis] + time * drift(p)[axis]))),
        velocity: numbers(&|p| drift(p).map(|v| side * v)),
        material: vec![0; PARTICLES],
        ..ParticleFrame::default()
    };
    message.header.stamp = Stamp(0).advance(0.016, sequence as u32).into();
    message
}

fn frames(stream: u64, side: f32) -> Vec<ParticleFrame> {
    (0..FRAMES).map(|sequence| frame(stream, sequence, side)).collect()
}

fn write(bag: &Path, frames: &[ParticleFrame]) {
    let mut writer = BagWriter::create(bag, WriterOptions::default()).unwrap();
    let topic = writer.topic("/particles", ParticleFrame::TYPE).unwrap();
    for frame in frames {
        writer.write_stamped(topic, frame.header.stamp.into(), &cdr::encode(frame)).unwrap();
    }
    writer.finish().unwrap();
}

/// What may be wrong with a frame.
#[derive(Clone, Debug)]
enum Damage {
    Position(usize, f32),
    Velocity(usize, f32),
    Interval(f32),
    Domain(f32, f32),
    Material(usize, u8),
    Length(usize),
}

impl Damage {
    fn apply(&self, frame: &mut ParticleFrame) {
        match *self {
            Self::Position(number, value) => frame.position[number] = value,
            Self::Velocity(number, value) => frame.velocity[number] = value,
            Self::Interval(dt) => frame.dt = dt,
            Self::Domain(lower, upper) => {
                (frame.lower, frame.upper) = (vec![0.0, lower], vec![1.0, upper]);
            }
            Self::Material(particle, number) => frame.material[particle] = number,
            Self::Length(number) => frame.velocity.truncate(number),
        }
    }

    /// Whether a file of arrays can have it, in the same frame as a message.
    fn fits_arrays(&self) -> bool {
        matches!(self, Self::Position(..) | Self::Velocity(..))
    }
}

fn any_damage() -> impl Strategy<Value = Damage> {
    let not_finite = prop_oneof![Just(f32::NAN), Just(f32::INFINITY), Just(f32::NEG_INFINITY)];
    let far = prop_oneof![1.2f32..1e30, -1e30f32..-0.2, not_finite.clone()];
    let fast = prop_oneof![126.0f32..1e30, -1e30f32..-126.0, not_finite];
    let number = 0..2 * PARTICLES;
    prop_oneof![
        (number.clone(), far).prop_map(|(number, value)| Damage::Position(number, value)),
        (number.clone(), fast).prop_map(|(number, value)| Damage::Velocity(number, value)),
        prop_oneof![Just(0.0), Just(-0.016), Just(f32::NAN), Just(f32::INFINITY)]
            .prop_map(Damage::Interval),
        prop_oneof![
            Just((1.0, 1.0)),
            Just((2.0, 1.0)),
            Just((f32::NAN, 1.0)),
            Just((f32::MIN, f32::MAX))
        ]
        .prop_map(|(lower, upper)| Damage::Domain(lower, upper)),
        (0..PARTICLES, 4u8..=255).prop_map(|(particle, kind)| Damage::Material(particle, kind)),
        number.prop_map(Damage::Length),
    ]
}

/// What a node says of a frame; nothing if it takes it.
fn of_node(message: &ParticleFrame) -> String {
    static SHIPPED: LazyLock<Surrogate> = LazyLock::new(|| {
        Surrogate::load(&Checkpoint::shipped().unwrap(), std::num::NonZeroUsize::new(1)).unwrap()
    });
    let mut node = SurrogateNode::new(SHIPPED.clone(), NodeSettings::default()).unwrap();
    let mut arrivals = [(Duration::ZERO, Payload::Cdr(cdr::encode(message)))];
    let mut said = String::new();
    node.on_frames(&mut arrivals, None, &mut |_, outcome| {
        if let Err(rejection) = outcome {
            said = rejection.reason.to_string();
        }
    });
    said
}

/// What training, evaluation and calibration say.
fn of_data(bag: &Path) -> String {
    let options = LoadOptions::within(u64::MAX);
    load_trajectories(&[bag.to_owned()], options, &mut |_, _| ()).unwrap_err().to_string()
}

/// Arrays of NumPy, `[frames, particles, 2]`, in the form of `eddy bag import`.
fn write_arrays(file: &Path, frames: &[ParticleFrame]) {
    let mut zip = ZipWriter::new(File::create(file).unwrap());
    let mut array = |name: &str, shape: &str, numbers: Vec<f32>| {
        zip.start_file(format!("{name}.npy"), SimpleFileOptions::default()).unwrap();
        let header = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}\n");
        zip.write_all(b"\x93NUMPY\x01\x00").unwrap();
        zip.write_all(&(header.len() as u16).to_le_bytes()).unwrap();
        zip.write_all(header.as_bytes()).unwrap();
        zip.write_all(&numbers.into_iter().flat_map(f32::to_le_bytes).collect::<Vec<_>>()).unwrap();
    };
    let all = format!("({}, {PARTICLES}, 2)", frames.len());
    array("position", &all, frames.iter().flat_map(|frame| frame.position.clone()).collect());
    array("velocity", &all, frames.iter().flat_map(|frame| frame.velocity.clone()).collect());
    // As a program that calculates materials saves them.
    array("material", &format!("({PARTICLES},)"), vec![0.0; PARTICLES]);
    array("dt", "()", vec![frames[0].dt]);
    array("stream", "()", vec![frames[0].stream as f32]);
    array("lower", "(2,)", frames[0].lower.clone());
    array("upper", "(2,)", frames[0].upper.clone());
    zip.finish().unwrap();
}

fn import_arrays(file: &Path, output: &Path) -> Result<(), String> {
    let overrides = ImportOverrides::default();
    import(file, ImportFormat::Npz, &overrides, output, &mut || true)
        .map(drop)
        .map_err(|error| error.to_string())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn the_same_damage_is_the_same_finding_at_every_door(
        damage in any_damage(), at in 0..FRAMES as usize,
    ) {
        let folder = tempfile::tempdir().unwrap();
        let mut frames = frames(STREAM, 1.0);
        damage.apply(&mut frames[at]);
        let bag = folder.path().join("bag");
        write(&bag, &frames);
        let reason = of_node(&frames[at]);
        prop_assert!(reason.contains("found ") && reason.contains(", expected "), "{}", reason);
        let finding = format!("stream {STREAM}, frame {at}: {reason}");
        let expected = format!("{}: {finding}", bag.display());
        prop_assert_eq!(of_data(&bag), expected.clone());
        let reader = BagReader::open(&bag).unwrap();
        let found = survey_streams(&reader, "/particles", &|| false).unwrap();
        prop_assert_eq!(found.unusable[&STREAM].to_string(), expected);
        let survey = Survey::of(&reader, |_| ());
        let listed: Vec<_> = survey.findings.iter().map(|finding| finding.first.clone()).collect();
        let expected = format!("topic /particles, message {at}: {finding}");
        prop_assert!(listed.contains(&expected), "{:?}: {}", listed, expected);
        if damage.fits_arrays() {
            let (file, output) = (folder.path().join("a.npz"), folder.path().join("imported"));
            write_arrays(&file, &frames);
            let expected = format!("{}: {finding}", file.display());
            prop_assert_eq!(import_arrays(&file, &output), Err(expected));
            prop_assert!(!output.exists());
        }
    }
}

#[test]
fn an_undamaged_stream_passes_every_door() {
    let folder = tempfile::tempdir().unwrap();
    let (bag, file) = (folder.path().join("bag"), folder.path().join("a.npz"));
    let frames = frames(STREAM, 1.0);
    write(&bag, &frames);
    assert_eq!(of_node(&frames[0]), "");
    let options = LoadOptions::within(u64::MAX);
    assert_eq!(
        load_trajectories(std::slice::from_ref(&bag), options, &mut |_, _| ())
            .unwrap()
            .streams
            .len(),
        1
    );
    let reader = BagReader::open(&bag).unwrap();
    assert!(survey_streams(&reader, "/particles", &|| false).unwrap().unusable.is_empty());
    assert_eq!(Survey::of(&reader, |_| ()).finding_count(), 0);
    write_arrays(&file, &frames);
    import_arrays(&file, &folder.path().join("imported")).unwrap();
}

/// A folder with bags, and settings for a training of seconds.
struct Data(TempDir);

impl Data {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let settings = "windows.per_epoch = 32\nwindows.batch = 16\nnetwork.hidden = 8\nnetwork.encoder = 8\n\
             network.channels = [4, 4]\nvalidation.horizon = 3\nvalidation.starts = 1\n\
             [[unroll]]\nshare = 1.0\nframes = 2\n";
        fs::write(folder.path().join("small.toml"), settings).unwrap();
        Self(folder)
    }

    fn join(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn path(&self, name: &str) -> String {
        self.join(name).to_str().unwrap().to_owned()
    }

    fn train(&self, more: &[&str]) -> Vec<String> {
        let (data, settings, output) =
            (self.path("data"), self.path("small.toml"), self.path("model"));
        let words = ["train", "--data", &data, "--config", &settings, "--epochs", "1"];
        let words = [&words[..], &["--output", &output], more].concat();
        words.into_iter().map(str::to_owned).collect()
    }
}

#[test]
fn one_bad_stream_is_refused_by_every_command_and_skipped_on_request() {
    let data = Data::new();
    fs::create_dir(data.join("data")).unwrap();
    for stream in 0..4 {
        let mut frames = frames(stream, 1.0);
        if stream == 1 {
            frames[20].position[5] = 5.5;
        }
        write(&data.join("data").join(format!("bag_{stream}")), &frames);
    }
    let (all, bad) = (data.path("data"), data.path("data/bag_1"));
    let (out, report) = (data.path("out"), data.path("report"));
    let finding = "bag_1: stream 1, frame 20: position[2]: found ";
    let model = concat!(env!("CARGO_MANIFEST_DIR"), "/checkpoints/particle-mingru");
    let eval = ["eval", "--checkpoint", model, "--data", &all, "--output", &report];
    let eval = [&eval[..], &["--horizon", "3", "--starts", "1"]].concat();
    let predict = ["predict", "--input", &bad, "--output", &out];
    for message in [fail(1, data.train(&[])), fail(1, &eval), fail(1, predict)] {
        assert!(message.contains(finding) && message.contains("--skip-streams"), "{message}");
        assert!(message.contains("inside the domain 0 to 1 x 0 to 1"), "{message}");
    }
    assert!(fail(1, ["bag", "check", &bad]).contains("1 problem found"));
    for path in ["model", "report", "out"] {
        assert!(!data.join(path).exists(), "{path} was begun");
    }
    let says = |arguments: Vec<String>| {
        let output = eddy().args(arguments).output().unwrap();
        let lines = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.success(), "{lines}");
        assert!(lines.contains(&format!("skipped: {}/{finding}", all)), "{lines}");
        assert!(lines.contains("1 stream skipped, 3 used"), "{lines}");
    };
    says(data.train(&["--skip-streams"]));
    says([&eval[..], &["--skip-streams"]].concat().into_iter().map(str::to_owned).collect());
    let message = fail(1, [&predict[..], &["--skip-streams"]].concat());
    assert!(message.contains("no frames to predict from"), "{message}");
}

#[test]
fn a_domain_in_millimetres_is_refused_before_its_grid_is_allocated() {
    let data = Data::new();
    fs::create_dir(data.join("data")).unwrap();
    for stream in 0..3 {
        write(&data.join("data").join(format!("bag_{stream}")), &frames(stream, 1000.0));
    }
    let message = fail(1, data.train(&[]));
    for words in ["bag_0: stream 0: lower, upper: found 0 to 1000 x 0 to 1000, ", " cells of "] {
        assert!(message.contains(words), "`{words}` is not in: {message}");
    }
    assert!(!data.join("model").exists());
}

#[test]
fn a_simulation_that_begins_before_0_is_predicted_and_imported() {
    let data = Data::new();
    let mut early = frames(STREAM, 1.0);
    for (sequence, frame) in early.iter_mut().enumerate() {
        frame.header.stamp = Stamp(-200_000_000).advance(0.016, sequence as u32).into();
    }
    write(&data.join("early"), &early);
    let (input, output) = (data.path("early"), data.path("out"));
    succeed(["predict", "--input", &input, "--output", &output]);
    let check = |bag: &str, topic: &str, first: i64| {
        let reader = BagReader::open(bag.as_ref()).unwrap();
        let mut frames = reader.frames(topic).unwrap();
        let frame = frames.next().unwrap().unwrap();
        assert_eq!((frame.stamp, frames.log_time()), (Stamp(first), Stamp(0)), "{bag}");
        succeed(["bag", "check", bag]);
    };
    check(&input, "/particles", -200_000_000);
    let first = BagReader::open(output.as_ref()).unwrap().frames("/prediction").unwrap().next();
    check(&output, "/prediction", first.unwrap().unwrap().stamp.0);
    assert!(
        BagReader::open(output.as_ref()).unwrap().message_count() > 20,
        "as many as a live node publishes"
    );
}
