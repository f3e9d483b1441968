//! Pictures and videos of bags.

use std::{fs, process::Command};

use tempfile::tempdir;

use crate::support::{eddy, entries, fail, simulate, succeed};

#[test]
fn a_video_is_written_by_ffmpeg_and_without_it_the_error_says_what_to_do() {
    let folder = tempdir().unwrap();
    let truth = folder.path().join("truth");
    simulate(&truth, 1, 0.4);
    let (bag, out) = (truth.join("scene_0000"), folder.path().join("moving.mp4"));
    let render = || {
        let mut command = eddy();
        command.args(["bag", "render", "--size", "101"]).arg(&bag).arg("--output").arg(&out);
        command
    };
    let output = render().env("PATH", folder.path()).output().unwrap();
    let error = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1), "{error}");
    assert!(
        error.contains("ffmpeg: not found on the PATH; install ffmpeg, or choose .gif"),
        "{error}"
    );
    assert!(!out.exists());
    if Command::new("ffmpeg").arg("-version").output().is_ok() {
        let output = render().output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let video = fs::read(&out).unwrap();
        assert_eq!(&video[4..8], b"ftyp");
    }
}

#[test]
fn pictures_are_what_their_names_say() {
    let folder = tempdir().unwrap();
    let truth = folder.path().join("truth");
    simulate(&truth, 1, 0.4);
    let bag = truth.join("scene_0000");
    let render = |name: &str, more: &[&str]| {
        let out = folder.path().join(name);
        let paths = [bag.to_str().unwrap(), "--output", out.to_str().unwrap()];
        succeed(["bag", "render"].iter().chain(&paths).chain(more));
        out
    };
    let both = render("both", &["--frames", "3", "--size", "200"]);
    assert_eq!(entries(&both), ["animation.gif", "strip.png"]);
    let strip =
        png::Decoder::new(std::io::BufReader::new(fs::File::open(both.join("strip.png")).unwrap()));
    let strip = strip.read_info().unwrap();
    assert_eq!(strip.info().width, 3 * 220);
    assert!(strip.info().animation_control.is_none());

    // 26 frames, 0.4 s apart from first to last: 11 pictures at 25 a second.
    let moving = fs::File::open(both.join("animation.gif")).unwrap();
    let mut moving = gif::Decoder::new(moving).unwrap();
    let mut shown = Vec::new();
    while let Some(picture) = moving.read_next_frame().unwrap() {
        assert_eq!((picture.width, picture.delay), (220, 4));
        shown.push(picture.buffer.to_vec());
    }
    assert_eq!(shown.len(), 11);
    assert!(shown.windows(2).all(|pair| pair[0] != pair[1]), "particles move");

    let moving = render("moving.apng", &["--color", "speed", "--rate", "2", "--size", "100"]);
    let moving = png::Decoder::new(std::io::BufReader::new(fs::File::open(moving).unwrap()));
    let moving = moving.read_info().unwrap();
    assert_eq!(moving.info().animation_control.unwrap().num_frames, 6);
    let still = render("still.png", &["--stream", "0"]);
    assert!(fs::metadata(still).unwrap().len() > 1000);
    let beside = render("beside.png", &["--topic", "/particles", "/particles", "--frames", "3"]);
    let beside = png::Decoder::new(std::io::BufReader::new(fs::File::open(beside).unwrap()));
    let beside = beside.read_info().unwrap();
    let single = render("single.png", &["--frames", "3"]);
    let single = png::Decoder::new(std::io::BufReader::new(fs::File::open(single).unwrap()));
    let single = single.read_info().unwrap();
    assert_eq!([single.info().width, beside.info().width], [3 * 260; 2]);
    // Two rows of panels instead of one, and one legend.
    assert!(beside.info().height > single.info().height + 240, "{}", beside.info().height);
    let out = folder.path().join("other");
    let [bag, out] = [&bag, &out].map(|path| path.to_str().unwrap());
    let error = fail(2, ["bag", "render", bag, "--output", out, "--rate", "0"]);
    assert!(error.contains("--rate") && error.contains("expected a positive number"), "{error}");
}
