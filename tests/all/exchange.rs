//! Frames to and from the files of other programs.

use std::{
    fs,
    io::Write,
    path::{Path, PathBuf},
};

use eddy_bag::{
    BagReader, BagWriter, WriterOptions,
    custom_data::{CustomData, GRAVITY, STIFFNESS},
};
use eddy_exchange::{
    ExchangeError, ExportFormat, FrameSelection, ImportFormat, ImportOverrides, Streams, export,
    import,
};
use eddy_frames::{Domain, Frame, Material, Stamp};
use eddy_messages::{FrameCdr, Message, ParticleFrame, PointCloud2, cdr, cloud};
use proptest::prelude::*;
use tempfile::{TempDir, tempdir};
use zip::{ZipArchive, ZipWriter, write::SimpleFileOptions};

use crate::support::{entries, fail, simulate, succeed};

const WIDE: Domain = Domain { lower: [-2.0, 0.5], upper: [2.0, 1.5] };

/// A frame of `particles` that fall to the right.
fn frame(stream: u64, sequence: u64, particles: usize) -> Frame {
    let place = |i: usize| [0.01 * i as f32 + 0.02 * sequence as f32, 0.75];
    Frame {
        stream,
        sequence,
        stamp: Stamp(0).advance(0.016, sequence as u32),
        dt: 0.016,
        domain: WIDE,
        position: (0..particles).map(place).collect(),
        velocity: vec![[1.25, -0.5]; particles],
        material: (0..particles).map(|i| Material::ALL[i % Material::COUNT]).collect(),
    }
}

/// The frame in a box, with its particles in a plane that is not along its walls.
fn in_space(frame: &Frame) -> Frame<3> {
    let lifted = |[x, y]: &[f32; 2]| [*x, *y, 0.25 * x];
    Frame {
        domain: Domain { lower: [-2.0, 0.5, -0.75], upper: [2.0, 1.5, 0.75] },
        position: frame.position.iter().map(lifted).collect(),
        velocity: frame.velocity.iter().map(lifted).collect(),
        material: frame.material.clone(),
        stream: frame.stream,
        sequence: frame.sequence,
        stamp: frame.stamp,
        dt: frame.dt,
    }
}

fn write_bag<const D: usize>(path: &Path, frames: &[Frame<D>]) {
    write_bag_of(path, frames, CustomData::default());
}

/// A bag of matter whose stiffness may be stated.
fn write_bag_of<const D: usize>(path: &Path, frames: &[Frame<D>], custom_data: CustomData) {
    let mut bag = BagWriter::create(path, WriterOptions::default()).unwrap();
    bag.extend_custom_data(custom_data);
    let topic = bag.topic("/particles", ParticleFrame::TYPE).unwrap();
    for frame in frames {
        bag.write(topic, frame.stamp, frame.stamp, &frame.to_cdr()).unwrap();
    }
    bag.finish().unwrap();
}

fn frames_in<const D: usize>(bag: &Path) -> Vec<Frame<D>> {
    let frames = BagReader::open(bag).unwrap().frames_of("/particles").unwrap();
    frames.map(Result::unwrap).collect()
}

fn streams<const D: usize>(bag: &Path) -> Streams<D> {
    let choice = FrameSelection {
        bags: vec![bag.into()],
        topic: "/particles".into(),
        ..FrameSelection::default()
    };
    assert_eq!(choice.dimension().unwrap(), D);
    Streams::find(&choice, &mut || true).unwrap()
}

fn try_export(bag: &Path, format: ExportFormat, to: &Path) -> Result<(), ExchangeError> {
    try_export_of::<2>(bag, format, to)
}

fn try_export_of<const D: usize>(
    bag: &Path,
    format: ExportFormat,
    to: &Path,
) -> Result<(), ExchangeError> {
    export(&streams::<D>(bag), None, format, to, &mut || true)
}

fn try_import(
    from: &Path,
    format: ImportFormat,
    given: ImportOverrides,
    to: &Path,
) -> Result<(), ExchangeError> {
    import(from, format, &given, to, &mut || true).map(drop)
}

/// What a bag states about the stiffness of its matter.
fn stated(stiffness: &str) -> CustomData {
    CustomData::from([(STIFFNESS.to_owned(), stiffness.to_owned())])
}

fn custom_data_in(bag: &Path) -> CustomData {
    BagReader::open(bag).unwrap().custom_data().clone()
}

/// A folder with a bag of two streams, 3 and 8, of four frames each.
fn two_streams() -> (TempDir, PathBuf) {
    let folder = tempdir().unwrap();
    let bag = folder.path().join("bag");
    let frames: Vec<Frame> = (0..4).flat_map(|k| [frame(3, k, 5), frame(8, k, 5)]).collect();
    write_bag(&bag, &frames);
    (folder, bag)
}

/// One stream whose numbers are any that a plausible frame can have.
fn any_stream() -> impl Strategy<Value = Vec<Frame>> {
    let number = || -1.0f32..1.0;
    (1..6usize, 1..5usize, any::<bool>(), 0..1000u64, 1..u64::MAX / 2).prop_flat_map(
        move |(particles, frames, changes, stream, first)| {
            let vectors = || prop::collection::vec([number(), number()], particles * frames);
            let kinds = if changes { particles * frames } else { particles };
            let materials = prop::collection::vec(0..Material::COUNT as u8, kinds);
            (vectors(), vectors(), materials, 1e-6f32..10.0).prop_map(
                move |(position, velocity, material, dt)| {
                    let of_frame = |k: usize| {
                        let range = k * particles..(k + 1) * particles;
                        let kinds = if changes { range.clone() } else { 0..particles };
                        Frame {
                            stream,
                            sequence: first + k as u64,
                            stamp: Stamp(7).advance(dt, k as u32),
                            dt,
                            domain: WIDE,
                            position: position[range.clone()]
                                .iter()
                                .map(|[x, y]| [2.3 * x, 1.0 + 0.58 * y])
                                .collect(),
                            velocity: velocity[range]
                                .iter()
                                .map(|[x, y]| [7.9 * x / dt, 1.9 * y / dt])
                                .collect(),
                            material: material[kinds]
                                .iter()
                                .map(|&kind| Material::try_from(kind).unwrap())
                                .collect(),
                        }
                    };
                    (0..frames).map(of_frame).collect()
                },
            )
        },
    )
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]

    #[test]
    fn frames_come_back_from_npz_as_they_went_in(
        frames in any_stream(),
        stiffness in prop::option::of(1e-30f32..1e30),
        gravity in prop::option::of(-1e30f32..1e30),
    ) {
        let folder = tempdir().unwrap();
        let (bag, file) = (folder.path().join("bag"), folder.path().join("stream.npz"));
        let mut custom_data = stiffness.map_or_else(CustomData::new, |e| stated(&e.to_string()));
        custom_data.extend(gravity.map(|g| (GRAVITY.to_owned(), g.to_string())));
        write_bag_of(&bag, &frames, custom_data.clone());
        try_export(&bag, ExportFormat::Npz, &file).unwrap();
        let out = folder.path().join("out");
        try_import(&file, ImportFormat::Npz, ImportOverrides::default(), &out).unwrap();
        let out = out.join(format!("stream_{:04}", frames[0].stream));
        prop_assert_eq!(frames_in(&out), frames);
        prop_assert_eq!(custom_data_in(&out), custom_data);
    }

    #[test]
    fn frames_in_space_come_back_from_npz_and_gns(frames in any_stream()) {
        let frames: Vec<Frame<3>> = frames.iter().map(in_space).collect();
        let folder = tempdir().unwrap();
        let (bag, file) = (folder.path().join("bag"), folder.path().join("stream.npz"));
        let out = folder.path().join("out");
        write_bag(&bag, &frames);
        try_export_of::<3>(&bag, ExportFormat::Npz, &file).unwrap();
        try_import(&file, ImportFormat::Npz, ImportOverrides::default(), &out).unwrap();
        let out = out.join(format!("stream_{:04}", frames[0].stream));
        prop_assert_eq!(&frames_in::<3>(&out), &frames);
        if frames.len() < 2 {
            return Ok(());
        }
        let mut frames = frames;
        for k in 1..frames.len() {
            frames[k].material = frames[0].material.clone();
        }
        let bag = folder.path().join("constant");
        write_bag(&bag, &frames);
        let (set, out) = (folder.path().join("set"), folder.path().join("positions"));
        try_export_of::<3>(&bag, ExportFormat::Gns, &set).unwrap();
        try_import(&set, ImportFormat::Gns, ImportOverrides::default(), &out).unwrap();
        let back = frames_in::<3>(&out.join("stream_0000"));
        prop_assert_eq!(back.len(), frames.len());
        for (back, frame) in back.iter().zip(&frames) {
            prop_assert_eq!(&back.position, &frame.position);
            prop_assert_eq!(&back.material, &frame.material);
            prop_assert_eq!((back.dt, back.domain), (frame.dt, frame.domain));
        }
    }

    #[test]
    fn positions_and_materials_come_back_from_gns(mut frames in any_stream()) {
        for k in 1..frames.len() {
            frames[k].material = frames[0].material.clone();
        }
        let folder = tempdir().unwrap();
        let (bag, set) = (folder.path().join("bag"), folder.path().join("set"));
        write_bag(&bag, &frames);
        try_export(&bag, ExportFormat::Gns, &set).unwrap();
        let out = folder.path().join("out");
        let outcome = try_import(&set, ImportFormat::Gns, ImportOverrides::default(), &out);
        if frames.len() == 1 {
            // There is nothing to take velocities from.
            let error = outcome.unwrap_err().to_string();
            prop_assert!(error.contains("velocity: found none, and one frame"), "{}", error);
            return Ok(());
        }
        outcome.unwrap();
        let back: Vec<Frame> = frames_in(&out.join("stream_0000"));
        prop_assert_eq!(back.len(), frames.len());
        for (back, frame) in back.iter().zip(&frames) {
            prop_assert_eq!(&back.position, &frame.position);
            prop_assert_eq!(&back.material, &frame.material);
            prop_assert_eq!((back.dt, back.domain), (frame.dt, frame.domain));
        }
    }
}

#[test]
fn imported_bags_state_the_stiffness_that_is_given() {
    let (folder, bag) = two_streams();
    let (set, out) = (folder.path().join("set.npz"), folder.path().join("out"));
    try_export(&bag, ExportFormat::Gns, &set).unwrap();
    let custom_data = stated("1e4");
    let (dt, domain) = (Some(0.016), Some(WIDE.into()));
    let given = ImportOverrides { dt, domain, material: None, custom_data: custom_data.clone() };
    try_import(&set, ImportFormat::Gns, given.clone(), &out).unwrap();
    for bag in entries(&out) {
        assert_eq!(custom_data_in(&out.join(bag)), custom_data);
    }
    // Rather than what the file states.
    let (other, file) = (folder.path().join("other"), folder.path().join("other.npz"));
    write_bag_of(&other, &[frame(3, 0, 5)], stated("2e5"));
    try_export(&other, ExportFormat::Npz, &file).unwrap();
    let out = folder.path().join("other_out");
    try_import(&file, ImportFormat::Npz, given, &out).unwrap();
    assert_eq!(custom_data_in(&out.join("stream_0003")), custom_data);
    write_bag_of(&other.with_file_name("wrong"), &[frame(3, 0, 5)], stated("soft"));
    let wrong = try_export(&other.with_file_name("wrong"), ExportFormat::Npz, &out.join("no.npz"));
    let wrong = wrong.unwrap_err().to_string();
    assert!(
        wrong.contains("eddy_stiffness: found \"soft\", expected a positive number"),
        "{wrong}"
    );
    let set = set.to_str().unwrap();
    let soft = ["--format", "gns", "--output", "no", "--custom-data", "eddy_stiffness=soft"];
    let said = fail(2, [&["bag", "import", set], &soft[..]].concat());
    assert!(said.contains("found eddy_stiffness=soft, expected a positive number"), "{said}");
}

#[test]
fn velocities_that_a_file_lacks_are_differences_of_positions() {
    let (folder, bag) = two_streams();
    let (set, out) = (folder.path().join("set.npz"), folder.path().join("out"));
    try_export(&bag, ExportFormat::Gns, &set).unwrap();
    let given =
        ImportOverrides { dt: Some(0.5), domain: Some(WIDE.into()), ..ImportOverrides::default() };
    try_import(&set, ImportFormat::Gns, given, &out).unwrap();
    assert_eq!(entries(&out), ["stream_0000", "stream_0001"]);
    for frame in frames_in::<2>(&out.join("stream_0001")) {
        for [x, y] in frame.velocity {
            // 0.02 a frame of 0.5 s; positions are near 0.1, so that f32 leaves 1e-8 of them.
            assert!((x - 0.04).abs() < 1e-6 && y == 0.0, "{x}, {y}");
        }
    }
}

#[test]
fn every_format_holds_every_frame() {
    let (folder, bag) = two_streams();
    let to = |name: &str| folder.path().join(name);
    try_export(&bag, ExportFormat::Csv, &to("table.csv")).unwrap();
    let table = fs::read_to_string(to("table.csv")).unwrap();
    let mut lines = table.lines();
    assert_eq!(lines.next(), Some("stream,sequence,time,particle,material,x,y,vx,vy"));
    assert_eq!(lines.next(), Some("3,0,0,0,liquid,0,0.75,1.25,-0.5"));
    assert_eq!(table.lines().last(), Some("8,3,0.048,4,sand,0.099999994,0.75,1.25,-0.5"));
    assert_eq!(table.lines().count(), 1 + 2 * 4 * 5);

    let numbers = |ending: &str| (0..4).map(|k| format!("{k:06}.{ending}")).collect::<Vec<_>>();
    try_export(&bag, ExportFormat::Vtu, &to("vtu")).unwrap();
    let names = ["stream_0003", "stream_0003.pvd", "stream_0008", "stream_0008.pvd"];
    assert_eq!(entries(&to("vtu")), names);
    assert_eq!(entries(&to("vtu/stream_0008")), numbers("vtu"));
    let collection = fs::read_to_string(to("vtu/stream_0008.pvd")).unwrap();
    assert!(collection.contains(r#"timestep="0.048" part="0" file="stream_0008/000003.vtu""#));

    try_export(&bag, ExportFormat::Ply, &to("ply")).unwrap();
    assert_eq!(entries(&to("ply/stream_0003")), numbers("ply"));
    let cloud = fs::read(to("ply/stream_0003/000003.ply")).unwrap();
    let end = b"end_header\n";
    let body = cloud.windows(end.len()).position(|bytes| bytes == end).unwrap() + end.len();
    assert_eq!(cloud.len() - body, 5 * (6 * 4 + 1));

    try_export(&bag, ExportFormat::Npz, &to("npz")).unwrap();
    assert_eq!(entries(&to("npz")), ["stream_0003.npz", "stream_0008.npz"]);
    try_export(&bag, ExportFormat::Gns, &to("gns")).unwrap();
    assert_eq!(entries(&to("gns")), ["metadata.json", "train.npz", "valid.npz"]);
}

#[test]
fn a_stream_that_loses_particles_is_refused_where_it_does_not_fit() {
    let folder = tempdir().unwrap();
    let (bag, out) = (folder.path().join("bag"), folder.path().join("out"));
    write_bag(&bag, &[frame(3, 0, 5), frame(3, 1, 5), frame(3, 2, 4)]);
    for format in [ExportFormat::Npz, ExportFormat::Gns] {
        let error = try_export(&bag, format, &out).unwrap_err().to_string();
        let expected = "stream 3: particles: found 4 at sequence 2, expected 5";
        assert!(error.contains(expected), "{error}");
        assert_eq!(entries(folder.path()), ["bag"], "nothing is left of the attempt");
    }
    for format in [ExportFormat::Vtu, ExportFormat::Ply, ExportFormat::Csv] {
        try_export(&bag, format, &out).unwrap();
        let removed = if out.is_dir() { fs::remove_dir_all(&out) } else { fs::remove_file(&out) };
        removed.unwrap();
    }
}

#[test]
fn streams_of_two_lengths_make_no_gns_file_until_they_are_cut() {
    let folder = tempdir().unwrap();
    let bag = folder.path().join("bag");
    write_bag(
        &bag,
        &[frame(0, 0, 5), frame(1, 0, 5), frame(0, 1, 5), frame(1, 1, 5), frame(1, 2, 5)],
    );
    let (bag, out) = (bag.to_str().unwrap(), folder.path().join("out.npz"));
    let out = out.to_str().unwrap();
    let arguments = ["bag", "export", bag, "--format", "gns", "--output", out];
    let error = fail(1, arguments);
    assert!(error.contains("stream 1: frames: found 3, expected 2 as in stream 0"), "{error}");
    let error = fail(1, arguments.into_iter().chain(["--frames", "3"]));
    assert!(error.contains("stream 0: found 2 frames, expected at least 3"), "{error}");
    succeed(arguments.into_iter().chain(["--frames", "2"]));
}

#[test]
fn an_output_that_exists_is_never_written_over() {
    let (folder, bag) = two_streams();
    let out = folder.path().join("out.png");
    fs::write(&out, "precious").unwrap();
    let (bag, name) = (bag.to_str().unwrap(), out.to_str().unwrap());
    for format in ["npz", "vtu", "ply", "gns", "csv"] {
        let error = fail(1, ["bag", "export", bag, "--format", format, "--output", name]);
        assert!(error.contains("out.png: already exists"), "{error}");
    }
    let error = fail(1, ["bag", "render", bag, "--output", name]);
    assert!(error.contains("out.png: already exists"), "{error}");
    let error = fail(1, ["bag", "import", bag, "--format", "npz", "--output", name]);
    assert!(error.contains("out.png: already exists"), "{error}");
    assert_eq!(fs::read_to_string(&out).unwrap(), "precious");
    assert_eq!(entries(folder.path()), ["bag", "out.png"]);
}

#[test]
fn what_is_not_there_is_named_with_what_is() {
    let (folder, bag) = two_streams();
    let (bag, out) = (bag.to_str().unwrap(), folder.path().join("out"));
    let out = out.to_str().unwrap();
    let export = ["bag", "export", bag, "--format", "vtu", "--output", out];
    let error = fail(1, export.into_iter().chain(["--topic", "/prediction"]));
    assert!(error.contains("/prediction") && error.contains("/particles"), "{error}");
    let error = fail(1, export.into_iter().chain(["--stream", "4"]));
    assert!(error.contains("stream: found 3, 8, expected 4"), "{error}");
    let file = format!("{out}.npz");
    let error = fail(1, ["bag", "export", bag, "--format", "npz", "--output", &file]);
    assert!(error.contains("found 2 streams, expected 1 for a single file"), "{error}");
    let error = fail(1, ["bag", "import", "nowhere.npz", "--format", "npz", "--output", out]);
    assert!(error.contains("nowhere.npz: opening the file"), "{error}");
    fail(2, ["bag", "export", bag, "--format", "pickle"]);
    assert_eq!(entries(folder.path()), ["bag"]);
}

/// Copies an archive, leaving an array out or putting another one in.
fn changed(archive: &Path, without: &str, with: Option<(&str, &str, &[u8])>) -> PathBuf {
    let path = archive.with_file_name("changed.npz");
    let mut from = ZipArchive::new(fs::File::open(archive).unwrap()).unwrap();
    let mut to = ZipWriter::new(fs::File::create(&path).unwrap());
    for index in 0..from.len() {
        let entry = from.by_index(index).unwrap();
        if entry.name().unwrap() != format!("{without}.npy") {
            to.raw_copy_file(entry).unwrap();
        }
    }
    if let Some((name, header, data)) = with {
        to.start_file(format!("{name}.npy"), SimpleFileOptions::default()).unwrap();
        to.write_all(b"\x93NUMPY\x01\x00").unwrap();
        to.write_all(&(header.len() as u16).to_le_bytes()).unwrap();
        to.write_all(header.as_bytes()).unwrap();
        to.write_all(data).unwrap();
    }
    to.finish().unwrap();
    path
}

#[test]
fn archives_that_cannot_be_used_are_refused_with_the_reason() {
    let folder = tempdir().unwrap();
    let (bag, file) = (folder.path().join("bag"), folder.path().join("stream.npz"));
    write_bag(&bag, &[frame(3, 0, 5), frame(3, 1, 5)]);
    try_export(&bag, ExportFormat::Npz, &file).unwrap();
    let header = |descr: &str, shape: &str| {
        format!("{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n")
    };
    type Change<'a> = Option<(&'a str, String, Vec<u8>)>;
    let cases: [(&str, Change<'_>, &str); 10] = [
        (
            "stiffness",
            Some(("stiffness", header("'<f4'", "()"), (-3f32).to_le_bytes().to_vec())),
            "stiffness: found -3, expected a positive number",
        ),
        ("position", None, "position: found velocity, material"),
        (
            "position",
            Some(("position", header("'|O'", "(2,)"), b"cos\nsystem\n".to_vec())),
            "object arrays are pickles",
        ),
        (
            "position",
            Some(("position", header("'<f4'", "(2, 5, 4)"), vec![0; 160])),
            "found shape [2, 5, 4], expected [frames, particles, 2 or 3]",
        ),
        (
            "position",
            Some(("position", header("'<f4'", "(0, 5, 2)"), vec![])),
            "found 0 frames of 5 particles",
        ),
        (
            "velocity",
            Some(("velocity", header("'<f4'", "(2, 4, 2)"), vec![0; 64])),
            "velocity: found shape [2, 4, 2], expected [2, 5, 2]",
        ),
        (
            "velocity",
            Some(("velocity", header("'<f4'", "(2, 5, 2)"), f32::NAN.to_le_bytes().repeat(20))),
            "frame 0: velocity[0]: found NaN",
        ),
        ("material", None, "material: found none, expected materials in the file, or --material"),
        (
            "material",
            Some(("material", header("'|u1'", "(5,)"), vec![9; 5])),
            "material: found 9, expected 0 (liquid)",
        ),
        ("upper", Some(("upper", header("'<f4'", "(2,)"), vec![0; 8])), "expected finite corners"),
    ];
    for (without, with, expected) in cases {
        let with = with.as_ref().map(|(name, header, data)| (*name, header.as_str(), &data[..]));
        let path = changed(&file, without, with);
        let out = folder.path().join("out");
        let error = try_import(&path, ImportFormat::Npz, ImportOverrides::default(), &out);
        let error = error.unwrap_err().to_string();
        assert!(error.contains("changed.npz") && error.contains(expected), "{error}");
        assert!(!out.exists());
    }
}

#[test]
fn a_domain_of_another_dimension_is_refused() {
    let folder = tempdir().unwrap();
    let (bag, file) = (folder.path().join("bag"), folder.path().join("stream.npz"));
    write_bag(&bag, &[frame(3, 0, 5), frame(3, 1, 5)].map(|frame| in_space(&frame)));
    try_export_of::<3>(&bag, ExportFormat::Npz, &file).unwrap();
    let given = ImportOverrides { domain: Some(WIDE.into()), ..ImportOverrides::default() };
    let out = folder.path().join("out");
    let error = try_import(&file, ImportFormat::Npz, given, &out).unwrap_err().to_string();
    let expected = "domain: found -2 to 2 x 0.5 to 1.5, expected 3 dimensions as position has";
    assert!(error.contains("stream.npz") && error.contains(expected), "{error}");

    let corner =
        ("lower", "{'descr': '<f4', 'fortran_order': False, 'shape': (2,), }\n", &[0; 8][..]);
    let path = changed(&file, "lower", Some(corner));
    let error = try_import(&path, ImportFormat::Npz, ImportOverrides::default(), &out);
    let error = error.unwrap_err().to_string();
    assert!(
        error.contains("lower: found [0.0, 0.0], expected 3 numbers as position has"),
        "{error}"
    );
    assert!(!out.exists());
}

#[test]
fn missing_arrays_can_be_given_instead() {
    let folder = tempdir().unwrap();
    let (bag, file) = (folder.path().join("bag"), folder.path().join("stream.npz"));
    write_bag(&bag, &[frame(3, 0, 5), frame(3, 1, 5)]);
    try_export(&bag, ExportFormat::Npz, &file).unwrap();
    let path = changed(&file, "material", None);
    let out = folder.path().join("out");
    let [path, to] = [&path, &out].map(|path| path.to_str().unwrap());
    let import = ["bag", "import", path, "--format", "npz", "--output", to, "--material", "snow"];
    let domain = ["--dt", "0.25", "--domain", "-3", "-3", "3", "3"];
    succeed(import.into_iter().chain(domain));
    for frame in frames_in(&out.join("stream_0003")) {
        assert_eq!(frame.material, [Material::Snow; 5]);
        assert_eq!(frame.domain, Domain { lower: [-3.0; 2], upper: [3.0; 2] });
        assert_eq!(frame.dt, 0.25);
    }
}

#[test]
fn a_cut_archive_is_refused_wherever_it_is_cut() {
    let folder = tempdir().unwrap();
    let (bag, file) = (folder.path().join("bag"), folder.path().join("stream.npz"));
    write_bag(&bag, &[frame(3, 0, 5), frame(3, 1, 5)]);
    try_export(&bag, ExportFormat::Npz, &file).unwrap();
    let bytes = fs::read(&file).unwrap();
    let out = folder.path().join("out");
    for end in (0..bytes.len()).step_by(7) {
        fs::write(&file, &bytes[..end]).unwrap();
        let error = try_import(&file, ImportFormat::Npz, ImportOverrides::default(), &out);
        let error = error.unwrap_err().to_string();
        assert!(error.contains("stream.npz: found no complete zip archive"), "{end}: {error}");
    }
    // A changed number is found by the checksum.
    let mut wrong = bytes.clone();
    let number = 0.75f32.to_le_bytes();
    let at = wrong.windows(4).position(|bytes| bytes == number).unwrap();
    wrong[at] ^= 1;
    fs::write(&file, &wrong).unwrap();
    let error = try_import(&file, ImportFormat::Npz, ImportOverrides::default(), &out).unwrap_err();
    assert!(error.to_string().contains("position"), "{error}");
    assert!(!out.exists());
}

#[test]
fn a_gns_file_of_pickles_is_refused_with_the_reason() {
    let folder = tempdir().unwrap();
    let empty = folder.path().join("empty.npz");
    ZipWriter::new(fs::File::create(&empty).unwrap()).finish().unwrap();
    let header = "{'descr': '|O', 'fortran_order': False, 'shape': (2,), }\n";
    let pickles = changed(&empty, "", Some(("simulation_trajectory_0", header, b"\x80\x04.")));
    let out = folder.path().join("out");
    let [path, to] = [&pickles, &out].map(|path| path.to_str().unwrap());
    let error = fail(1, ["bag", "import", path, "--format", "gns", "--output", to]);
    for words in ["simulation_trajectory_0", "object arrays are pickles", "structured array"] {
        assert!(error.contains(words), "{error}");
    }
    assert!(!out.exists());
}

#[test]
fn an_interrupted_export_leaves_nothing() {
    let (folder, bag) = two_streams();
    let streams = streams::<2>(&bag);
    for format in [
        ExportFormat::Npz,
        ExportFormat::Vtu,
        ExportFormat::Ply,
        ExportFormat::Gns,
        ExportFormat::Csv,
    ] {
        let mut frames = 0;
        let outcome = export(&streams, None, format, &folder.path().join("out"), &mut || {
            frames += 1;
            frames < 6
        });
        assert!(matches!(outcome, Err(ExchangeError::Interrupted)), "{format:?}: {outcome:?}");
        assert_eq!(entries(folder.path()), ["bag"], "{format:?}");
    }
}

#[cfg(not(feature = "hdf5"))]
#[test]
fn a_program_without_hdf5_says_how_to_get_it() {
    let (folder, bag) = two_streams();
    let (bag, out) = (bag.to_str().unwrap(), folder.path().join("out"));
    let out = out.to_str().unwrap();
    for format in ["hdf5", "vtkhdf"] {
        let error = fail(1, ["bag", "export", bag, "--format", format, "--output", out]);
        assert!(error.contains("--features hdf5"), "{error}");
    }
    assert_eq!(entries(folder.path()), ["bag"]);
}

#[cfg(feature = "hdf5")]
#[test]
fn positions_and_materials_come_back_from_hdf5() {
    let (folder, bag) = two_streams();
    let (set, out) = (folder.path().join("set"), folder.path().join("out"));
    try_export(&bag, ExportFormat::Hdf5, &set).unwrap();
    assert_eq!(entries(&set), ["metadata.json", "train.h5", "valid.h5"]);
    try_import(&set, ImportFormat::Hdf5, ImportOverrides::default(), &out).unwrap();
    for (number, stream) in [(0, 3), (1, 8)] {
        let back = frames_in(&out.join(format!("stream_{number:04}")));
        for (k, back) in back.iter().enumerate() {
            let frame = frame(stream, k as u64, 5);
            assert_eq!((&back.position, &back.material), (&frame.position, &frame.material));
            assert_eq!((back.stamp, back.dt, back.domain), (frame.stamp, frame.dt, frame.domain));
        }
        assert_eq!(back.len(), 4);
    }
    let cut = set.join("train.h5");
    let bytes = fs::read(&cut).unwrap();
    fs::write(&cut, &bytes[..bytes.len() / 2]).unwrap();
    let again = folder.path().join("again");
    let error =
        try_import(&cut, ImportFormat::Hdf5, ImportOverrides::default(), &again).unwrap_err();
    assert!(error.to_string().contains("train.h5: HDF5: "), "{error}");
    assert!(!again.exists());
}

#[test]
fn recorded_pressure_and_energy_are_exported() {
    let folder = tempdir().unwrap();
    let truth = folder.path().join("truth");
    let name = truth.to_str().unwrap();
    let usual = ["simulate", "--preset", "fluid", "--duration", "0.1", "--output", name];
    succeed(usual.iter().chain(&["--fields"]));
    let error = fail(1, usual);
    assert!(error.contains("fields"), "the directory is of another request: {error}");
    let bag = truth.join("scene_0000");
    let reader = BagReader::open(&bag).unwrap();
    let particles = reader.frames("/particles").unwrap().next().unwrap().unwrap().len();
    let mut clouds = 0;
    for message in reader.messages_of("/particles/fields", PointCloud2::TYPE).unwrap() {
        let cloud: PointCloud2 = cdr::decode(&message.unwrap().data).unwrap();
        for name in ["pressure", "energy"] {
            let values = cloud::property(&cloud, name).unwrap();
            assert_eq!(values.len(), particles);
            assert!(values.iter().all(|value| value.is_finite() && *value >= 0.0), "{name}");
        }
        clouds += 1;
    }
    assert_eq!(clouds, reader.frames("/particles").unwrap().count());
    let vtu = folder.path().join("vtu");
    try_export(&bag, ExportFormat::Vtu, &vtu).unwrap();
    for frame in ["000000", "000005"] {
        let grid = fs::read_to_string(vtu.join(format!("stream_0000/{frame}.vtu"))).unwrap();
        for name in ["density", "strain", "pressure", "energy"] {
            assert!(grid.contains(&format!(r#"Name="{name}""#)), "{name}");
        }
        // NaN, as base64.
        assert!(!grid.contains("AADAfwAAwH8AAMB/"), "every particle has its properties");
    }
    simulate(&folder.path().join("without"), 1, 0.1);
    let (bag, vtu) = (folder.path().join("without/scene_0000"), folder.path().join("vtu_without"));
    try_export(&bag, ExportFormat::Vtu, &vtu).unwrap();
    let grid = fs::read_to_string(vtu.join("stream_0000/000000.vtu")).unwrap();
    assert!(grid.contains(r#"Name="strain""#) && !grid.contains(r#"Name="pressure""#));
}

#[test]
fn predictions_are_exported_with_their_distance_from_the_truth() {
    let folder = tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let truth: Vec<Frame> = (0..2).map(|k| frame(3, k, 2)).collect();
    write_bag(folder.path().join("truth").as_path(), &truth);
    // The prediction of frame 1 is a quarter of a domain length too low, frame 2 has no truth.
    let position = |frame: &Frame| frame.position.iter().map(|[x, _]| [*x, 0.5]).collect();
    let predicted: Vec<Frame> = (1..3)
        .map(|k| frame(3, k, 2))
        .map(|frame| Frame { position: position(&frame), ..frame })
        .collect();
    for (name, with_truth) in [("alone", false), ("both", true)] {
        let mut bag =
            BagWriter::create(&folder.path().join(name), WriterOptions::default()).unwrap();
        let topics = [("/particles", &truth[..0]), ("/prediction", &predicted[..])];
        let topics = if with_truth { [("/particles", &truth[..]), topics[1]] } else { topics };
        for (topic, frames) in topics.into_iter().filter(|(_, frames)| !frames.is_empty()) {
            let topic = bag.topic(topic, ParticleFrame::TYPE).unwrap();
            for frame in frames {
                bag.write(topic, frame.stamp, frame.stamp, &frame.to_cdr()).unwrap();
            }
        }
        bag.finish().unwrap();
    }
    let export = |bag: &str, out: &str, more: &[&str]| {
        let (bag, out) = (at(bag), at(out));
        let usual = ["bag", "export", &bag, "--topic", "/prediction", "--output", &out];
        usual.iter().chain(more).map(|word| (*word).to_owned()).collect::<Vec<_>>()
    };
    let grid = |out: &str, number: u32| {
        fs::read_to_string(folder.path().join(format!("{out}/stream_0003/{number:06}.vtu")))
            .unwrap()
    };
    succeed(export("alone", "without", &["--format", "vtu"]));
    assert!(!grid("without", 0).contains(r#"Name="error""#));
    let elsewhere = at("truth");
    succeed(export("alone", "beside", &["--format", "vtu", "--truth", &elsewhere]));
    succeed(export("both", "within", &["--format", "vtu"]));
    for out in ["beside", "within"] {
        // The number of bytes, then 0.25 twice; NaN twice.
        for (number, values) in [(0, "CAAAAAAAAAAAAIA+AACAPg=="), (1, "CAAAAAAAAAAAAMB/AADAfw==")] {
            let expected = format!(r#"Name="error"  format="binary">{values}<"#);
            let grid = grid(out, number);
            assert!(grid.contains(&expected), "{out} {number}: {grid}");
        }
    }
    let error = fail(2, export("both", "none", &["--format", "npz", "--truth", &elsewhere]));
    assert!(error.contains("--truth: expected the format vtu or vtkhdf"), "{error}");
    write_bag(&folder.path().join("others"), &[frame(4, 0, 2)]);
    let error = fail(1, export("alone", "none", &["--format", "vtu", "--truth", &at("others")]));
    assert!(error.contains("others: found streams [4], expected 3 as in "), "{error}");
}
