//! The integration tests: one binary, one module an area.
#![expect(clippy::unwrap_used, reason = "a test that cannot go on fails")]
#![expect(clippy::disallowed_methods, reason = "tests wait for other processes, with deadlines")]

use std::path::PathBuf;

mod bad_input;
mod bag_commands;
#[expect(dead_code, reason = "the tests of eddy-bag use the rest")]
#[path = "../../crates/bag/tests/bag/support.rs"]
mod bags;
mod book;
mod calibrate;
#[path = "../../crates/transport/tests/transport/client.rs"]
mod client;
mod documented;
mod eval;
mod exchange;
#[cfg(feature = "foxglove")]
mod foxglove;
mod graph;
mod group;
mod hostile;
mod launch;
mod launch_configs;
mod mpm;
mod outputs;
mod pipeline;
mod prose;
mod pty;
mod pytorch;
#[cfg(target_os = "linux")]
mod real_time;
mod record;
mod reference;
mod render;
mod replay;
mod robots;
mod ros;
mod scenes;
mod secure;
mod services;
mod shell;
mod shm;
mod space;
mod stated;
mod stiffness;
mod stuck;
mod support;
mod terminal;
mod tools;
mod topic;
mod train;
mod unusable_frames;
mod view;
mod workspace;

/// The program under test.
const PROGRAM: &str = env!("CARGO_BIN_EXE_eddy");
/// Programs that pages of the documentation use.
fn programs() -> [PathBuf; 1] {
    [PathBuf::from(PROGRAM)]
}
