//! `eddy-lab` from outside. Some tests also run `eddy`: `cargo test --release --workspace --test lab` builds both.
#![expect(clippy::unwrap_used, reason = "a test that cannot go on fails")]
#![expect(clippy::disallowed_methods, reason = "tests wait for other processes, with deadlines")]

mod bench;
mod documented;
mod plan;
mod reference;
mod study;
#[expect(dead_code, reason = "the tests of eddy use the rest")]
#[path = "../../../../tests/all/support.rs"]
mod support;

use std::path::PathBuf;

/// The program under test.
const PROGRAM: &str = env!("CARGO_BIN_EXE_eddy-lab");

/// The program `eddy`, which cargo puts beside this one.
fn eddy() -> PathBuf {
    let eddy = PathBuf::from(PROGRAM).with_file_name("eddy");
    assert!(eddy.exists(), "{}: not found, expected a test of the whole workspace", eddy.display());
    eddy
}

/// Programs that pages of the documentation use.
fn programs() -> [PathBuf; 2] {
    [eddy(), PathBuf::from(PROGRAM)]
}

#[test]
fn every_help_lists_global_options_apart() {
    support::helps_list_global_options_apart();
}
