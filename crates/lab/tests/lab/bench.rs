//! Tables of this machine: that they come out, not what is in them.

use std::{io::pipe, process::Stdio};

use serde_json::Value;

use crate::support::{Stalls, fail, is_a_page_of_its_own, succeed, talking_eddy as talking_lab};

/// Runs a benchmark. Returns its report and the page it writes, which loads nothing from elsewhere.
fn report_and_page(arguments: &[&str]) -> (Value, String) {
    let folder = tempfile::tempdir().unwrap();
    let page = folder.path().join("bench.html");
    let output = ["--json", "--html", page.to_str().unwrap()];
    let json = succeed(arguments.iter().chain(&output));
    let text = std::fs::read_to_string(&page).unwrap();
    is_a_page_of_its_own(&text);
    (serde_json::from_str(&json).unwrap(), text)
}

#[test]
fn a_predicted_frame_is_timed_on_the_engine_and_in_burn() {
    let arguments = ["bench", "inference", "--particles", "30", "--core", "mingru"];
    let quickly = ["--threads", "1,2", "--device", "flex", "--seconds", "0.01"];
    let table = succeed(arguments.iter().chain(&quickly));
    let header = ["model", "core", "weights", "floor, 2", "engine, 1", "engine, 2", "flex"];
    assert!(header.iter().all(|title| table.contains(title)), "{table}");

    let (report, text) = report_and_page(&[&arguments[..], &quickly].concat());
    for words in ["eddy-lab bench inference", "bench inference --particles 30", "Machine"] {
        assert!(text.contains(words), "{words}");
    }
    let timings = report["timings"].as_array().unwrap();
    let named = |timing: &Value| format!("{} {}", timing["architecture"], timing["engine"]);
    let expected = [
        r#""frame" "engine""#,
        r#""frame" "engine""#,
        r#""frame" "flex""#,
        r#""particle" "engine""#,
        r#""particle" "engine""#,
        r#""particle" "flex""#,
    ];
    assert_eq!(timings.iter().map(named).collect::<Vec<_>>(), expected);
    for timing in timings {
        assert!(timing["p50"].as_f64().unwrap() <= timing["p99"].as_f64().unwrap(), "{timing}");
    }
}

#[test]
fn bags_are_timed_and_what_was_written_is_removed() {
    let folder = tempfile::tempdir().unwrap();
    let directory = folder.path().to_str().unwrap();
    let json = succeed([
        "bench",
        "bag",
        "--particles",
        "500",
        "--hertz",
        "50",
        "--seconds",
        "0.2",
        "--json",
        "--directory",
        directory,
    ]);
    let report: Value = serde_json::from_str(&json).unwrap();
    assert!(report["disk"].as_f64().unwrap() > 0.0);
    let timings = report["timings"].as_array().unwrap();
    let names: Vec<_> =
        timings.iter().map(|timing| timing["compression"].as_str().unwrap()).collect();
    assert_eq!(names, ["none", "lz4", "zstd"]);
    for timing in timings {
        assert!(timing["write"].as_f64().unwrap() > 0.0 && timing["read"].as_f64().unwrap() > 0.0);
        assert_eq!(
            (&timing["published"], &timing["recorded"]),
            (&10.into(), &10.into()),
            "{timing}"
        );
    }
    assert_eq!(std::fs::read_dir(directory).unwrap().count(), 0);
}

#[test]
fn frames_on_their_way_are_timed_beside_the_middleware_alone() {
    let arguments = ["bench", "transport", "--transport", "shm,zenoh", "--particles", "100"];
    let (report, text) = report_and_page(&[&arguments[..], &["--messages", "5"]].concat());
    assert!(text.contains("<svg viewBox") && text.contains("zenoh, bytes"), "{text}");
    let timings = report["timings"].as_array().unwrap();
    let named = |timing: &Value| format!("{} {}", timing["transport"], timing["way"]);
    let expected = [
        r#""shm" "frame""#,
        r#""shm" "bare""#,
        r#""shm" "untouched""#,
        r#""shm" "bare-untouched""#,
        r#""zenoh" "frame""#,
        r#""zenoh" "bytes""#,
        r#""zenoh" "bare""#,
    ];
    assert_eq!(timings.iter().map(named).collect::<Vec<_>>(), expected);
    for timing in timings {
        assert_eq!(timing["messages"], 5, "{timing}");
        let of = |key: &str| timing[key].as_f64().unwrap();
        assert!(0.0 < of("p50") && of("p50") <= of("p99"), "{timing}");
    }
}

#[test]
fn a_node_is_timed_with_all_its_streams() {
    let arguments = ["bench", "node", "--streams", "3", "--particles", "100", "--hertz", "20"];
    let json = succeed(arguments.iter().chain(&["--seconds", "2", "--json"]));
    let report: Value = serde_json::from_str(&json).unwrap();
    let timing = &report["timing"];
    assert_eq!((&timing["frames"], &timing["received"]), (&120.into(), &120.into()), "{timing}");
    assert_eq!(timing["predictions"], timing["expected"], "{timing}");
    for what in ["model", "node", "way"] {
        assert!(timing[what]["p50"].as_f64().unwrap() > 0.0, "{timing}");
    }
}

#[test]
fn nodes_that_share_streams_are_timed() {
    let arguments = ["bench", "group", "--nodes", "3", "--streams", "20", "--particles", "50"];
    let more = ["--hertz", "10", "--seconds", "2", "--json"];
    let stalls = Stalls::watch();
    let report: Value = serde_json::from_str(&succeed(arguments.iter().chain(&more))).unwrap();
    let timing = &report["timing"];
    let counts = ["frames", "lost", "twice"].map(|count| timing[count].as_u64().unwrap());
    let most = if stalls.are_long() { 40 } else { 0 };
    assert!(counts[0] == 400 && counts[1] <= most && counts[2] == 0, "{report}");
    assert!(timing["way"]["p50"].as_f64().unwrap() > 0.0, "{report}");
    #[cfg(target_os = "linux")]
    assert!(timing["processor"]["nodes"].as_f64().unwrap() > 0.0, "{report}");

    // A node is killed after 2 s: its streams warm up elsewhere.
    let more = ["--hertz", "10", "--seconds", "4", "--kill", "--json"];
    let report: Value = serde_json::from_str(&succeed(arguments.iter().chain(&more))).unwrap();
    let timing = &report["timing"];
    assert_eq!((&timing["frames"], &timing["twice"]), (&800.into(), &0.into()), "{report}");
    assert!((1..200).contains(&timing["lost"].as_u64().unwrap()), "{report}");
    let limit = 1.5 + stalls.delay().as_secs_f64();
    assert!(timing["silence"].as_f64().unwrap() < limit, "{report}");
    assert!(fail(2, ["bench", "group", "--nodes", "1", "--kill"]).contains("nodes: found 1"));
}

#[test]
fn a_benchmark_without_threads_or_time_is_wrong_usage() {
    let message = fail(2, ["bench", "inference", "--threads", "0"]);
    assert!(message.contains("--threads"), "{message}");
    let message = fail(2, ["bench", "inference", "--seconds", "0"]);
    assert!(message.contains("seconds: found 0, expected more than 0"), "{message}");
    let message = fail(2, ["bench", "solver", "--particles", "5"]);
    assert!(message.contains("particles: found 5"), "{message}");
}

#[test]
fn frames_arrive_at_every_browser_that_reads_and_nobody_waits_for_one_that_does_not() {
    let arguments = ["bench", "view", "--particles", "1000", "--hertz", "50", "--seconds", "0.5"];
    let rows: Value = serde_json::from_str(&succeed(arguments.iter().chain(&["--json"]))).unwrap();
    for row in rows.as_array().unwrap() {
        let [published, arrived] =
            ["published", "arrived"].map(|what| row["timing"][what].as_f64());
        assert!(published.unwrap() > 5.0, "{row}");
        assert_eq!(arrived.is_some_and(|arrived| arrived > 1.0), row["readers"] != 0, "{row}");
    }
    assert!(fail(2, ["bench", "view", "--particles", "0"]).contains("particles: found 0"));
}

#[test]
fn the_lateness_of_replayed_frames_is_told_beside_that_of_a_timer() {
    let arguments = ["bench", "replay", "--particles", "100", "--hertz", "500", "--seconds", "0.3"];
    let json = succeed(arguments.iter().chain(&["--json"]));
    let report: Value = serde_json::from_str(&json).unwrap();
    for what in ["replay", "timer"] {
        let [p50, p99] = ["p50", "p99"].map(|p| report["timing"][what][p].as_f64().unwrap());
        assert!(0.0 < p50 && p50 <= p99, "{report}");
    }
    assert!(fail(2, ["bench", "replay", "--hertz", "0"]).contains("hertz: found 0"));
}

#[test]
fn a_pipe_that_has_closed_is_no_failure() {
    let (reader, writer) = pipe().unwrap();
    drop(reader);
    let mut command = talking_lab();
    command.args(["bench", "solver", "--particles", "1000", "--threads", "1"]);
    command.args(["--seconds", "0.01"]).stdout(writer).stderr(Stdio::piped());
    let output = command.output().unwrap();
    assert!(output.status.success(), "{}", output.status);
    assert_eq!(String::from_utf8_lossy(&output.stderr), "");
}
