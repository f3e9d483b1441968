//! What the program writes to terminals and into pipes.

use std::{
    io::pipe,
    process::{Command, Stdio},
};

use eddy_bag::{BagReader, BagWriter, WriterOptions};
use eddy_messages::{FrameCdr, Message, ParticleFrame, RosString};

use crate::{
    pty::{OnTerminal, lines},
    support::{
        World, helps_list_global_options_apart, simulate, talking_eddy, unique, wait_for, word,
    },
};

const SAMPLE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/bags/sample");

/// The program with a standard output that nobody reads any more.
fn unread(arguments: &[&str]) -> Command {
    let (reader, writer) = pipe().unwrap();
    drop(reader);
    let mut command = talking_eddy();
    command.args(arguments).stdout(writer).stderr(Stdio::piped());
    command
}

#[test]
fn a_pipe_that_has_closed_is_no_failure() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let (cut, man, report) = (path("cut"), path("man"), path("report"));
    simulate(&folder.path().join("truth"), 1, 0.3);
    let (truth, rest) = (path("truth"), ["--horizon", "2", "--starts", "1"]);
    let model = concat!(env!("CARGO_MANIFEST_DIR"), "/checkpoints/particle-mingru");
    let eval = ["eval", "--checkpoint", model, "--data", &truth, "--output", &report];
    let commands: &[&[&str]] = &[
        &["--help"],
        &["bag", "info", SAMPLE],
        &["bag", "info", SAMPLE, "--json"],
        &["bag", "check", SAMPLE],
        &["bag", "cut", SAMPLE, "--start", "0.2", "--output", &cut],
        &["completions", "bash"],
        &["devices"],
        &["man", &man],
        &[&eval[..], &rest].concat(),
        &["eval", "--compare", &report, &report],
        // Without its warning that there is none.
        &["topic", "list", "--from", "shm", "--wait", "0", "--log-level", "error"],
    ];
    for arguments in commands {
        let output = unread(arguments).output().unwrap();
        let errors = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{arguments:?}: {}: {errors}", output.status);
        assert_eq!(errors, "", "{arguments:?}");
    }
}

#[test]
fn a_recording_whose_reader_is_gone_goes_on_and_closes_its_bag() {
    let world = World::new("unread");
    let (topics, bag) = (format!("^{}/", world.prefix), world.bag());
    let arguments = ["record", "--regex", &topics, "--from", "shm", "--max-messages", "3"];
    let arguments = [&arguments[..], &["--output", bag.to_str().unwrap()]].concat();
    let mut child = unread(&arguments).spawn().unwrap();
    let mut words = world.words("shm", "words");
    wait_for("the recorder listens", || (words.subscribers() > 0).then_some(()));
    for number in ["one", "two", "three"] {
        words.publish_cdr(&word(number)).unwrap();
    }
    let status = wait_for("the recorder ends", || child.try_wait().unwrap());
    assert!(status.success(), "{status}");
    assert_eq!(BagReader::open(&bag).unwrap().message_count(), 3);
    assert_eq!(RosString::TYPE, BagReader::open(&bag).unwrap().topics()[0].type_name);
}

#[test]
fn logs_have_colours_on_a_terminal_only() {
    let link = format!("shm:/{}", unique("colour"));
    let arguments = ["topic", "hz", &link, "--duration", "1.5"];
    let output = talking_eddy().args(arguments).env_remove("NO_COLOR").output().unwrap();
    let logged = String::from_utf8_lossy(&output.stderr);
    assert!(logged.contains(" WARN ") && !logged.contains('\x1b'), "{logged}");
    let mut terminal = OnTerminal::start(talking_eddy().args(arguments), 80);
    terminal.wait();
    let logged = terminal.shown();
    assert!(logged.contains("\x1b[33m WARN"), "{logged}");
}

#[test]
fn help_fits_the_terminal_and_lists_global_options_apart() {
    for (columns, words) in [(80, "node"), (60, "record"), (120, "simulate")] {
        let mut help = OnTerminal::start(talking_eddy().args([words, "--help"]), columns);
        assert!(help.wait().success());
        help.wait_for("Examples:", 0);
        let most = usize::from(columns).min(100);
        for line in lines(&help.shown()) {
            assert!(line.chars().count() <= most, "{words}: {line}");
        }
    }
    helps_list_global_options_apart();
}

#[test]
fn the_line_of_the_demo_fits_a_terminal_and_shows_error_and_skill() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("demo");
    let mut command = talking_eddy();
    command.args(["demo", "--seconds", "3", "--port", "0", "--output", output.to_str().unwrap()]);
    let mut demo = OnTerminal::start(&command, 80);
    assert!(demo.wait().success());
    demo.wait_for("report: ", 0);
    let status: Vec<String> =
        lines(&demo.shown()).into_iter().filter(|line| line.starts_with("t = ")).collect();
    assert!(status.iter().all(|line| line.chars().count() < 80), "{status:?}");
    assert!(
        status.iter().any(|line| line.contains("error") && line.contains("skill")),
        "{status:?}"
    );
}

#[test]
fn a_node_shows_its_rate_and_answers_keys() {
    let world = World::new("status");
    let (input, output) = (world.link("shm", "particles"), world.link("shm", "prediction"));
    let mut command = talking_eddy();
    command.args(["node", "--input", &input.to_string(), "--output", &output.to_string()]);
    let mut node = OnTerminal::start(&command, 80);
    let begun = node.wait_for("waiting for frames on shm:", 0);
    let mut frames = world.publisher("shm", "particles", ParticleFrame::TYPE);
    wait_for("the node listens", || (frames.subscribers() > 0).then_some(()));
    let bag = BagReader::open(SAMPLE.as_ref()).unwrap();
    for frame in bag.frames("/particles").unwrap().take(8) {
        frames.publish_frame(&frame.unwrap()).unwrap();
    }
    let shown = node.wait_for("1 stream | 0 lost", begun);
    node.press(b"r");
    node.wait_for("reset 1 stream", shown);
    node.press(b"\x03");
    assert!(node.wait().success());
    let status: Vec<String> =
        lines(&node.shown()).into_iter().filter(|line| line.contains("predictions/s |")).collect();
    assert!(status.iter().all(|line| line.chars().count() < 80), "{status:?}");
}

#[test]
fn the_topics_of_a_bag_fit_the_terminal() {
    let folder = tempfile::tempdir().unwrap();
    let bag = folder.path().join("bag");
    let mut writer = BagWriter::create(&bag, WriterOptions::default()).unwrap();
    let frame = BagReader::open(SAMPLE.as_ref()).unwrap().frames("/particles").unwrap().next();
    let frame = frame.unwrap().unwrap();
    let name = "/robot1/predictor/of/the/left/arm/prediction";
    for topic in [name, "/particles"] {
        let topic = writer.topic(topic, ParticleFrame::TYPE).unwrap();
        writer.write(topic, frame.stamp, frame.stamp, &frame.to_cdr()).unwrap();
    }
    writer.finish().unwrap();
    for columns in [60, 80, 200] {
        let command = ["bag", "info", bag.to_str().unwrap()];
        let mut info = OnTerminal::start(talking_eddy().args(command), columns);
        assert!(info.wait().success());
        info.wait_for("sizes of topics", 0);
        let shown = lines(&info.shown());
        let table = shown.iter().skip_while(|line| !line.contains("topic"));
        let table: Vec<_> = table.take_while(|line| !line.starts_with("sizes")).collect();
        let most = usize::from(columns);
        assert!(table.iter().all(|line| line.chars().count() <= most), "{columns}: {shown:?}");
        let titles = table.iter().filter(|line| line.contains("type")).count();
        assert_eq!(titles, 1, "{shown:?}");
        assert_eq!(table[0].contains("type"), columns == 200, "{shown:?}");
    }
}
