//! Runs every command in the pages that use `eddy-lab` and at the end of its `--help`, as the tests of `eddy` do with the other
//! pages.

#[path = "../../../../tests/all/documented/follow.rs"]
mod follow;
#[path = "../../../../tests/all/documented/lab_pages.rs"]
mod lab_pages;
#[path = "../../../../tests/all/documented/page.rs"]
mod page;
#[path = "../../../../tests/all/documented/short.rs"]
mod short;
#[path = "../../../../tests/all/documented/world.rs"]
mod world;

use follow::follow;
pub use follow::root;

#[test]
fn how_to_run_on_a_cluster() {
    follow(lab_pages::CLUSTER);
}

#[test]
fn how_to_compare_cores() {
    follow(lab_pages::CORES);
}

#[test]
fn how_to_serve_many_streams() {
    follow(lab_pages::STREAMS);
}

#[test]
fn how_to_share_streams() {
    follow(lab_pages::MANY_ROBOTS);
}

#[test]
fn where_the_numbers_come_from() {
    follow(lab_pages::NUMBERS);
}

#[test]
fn every_command_within_a_sentence_exists() {
    let held = follow::sentences("eddy-lab ");
    assert!(
        held > 20,
        "found {held} commands, expected more; does the parser still recognise them?"
    );
}

#[test]
fn the_examples_of_every_help() {
    follow::examples("eddy-lab", &["plan simulate"]);
}
