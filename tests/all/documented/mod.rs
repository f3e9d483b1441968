//! Runs every command in `README.md`, in the book and at the end of `--help` as written, except for options that make
//! them [`short`]. Each page runs from top to bottom in its own folder, which starts like a clone of the repository.
//!
//! The opening fence of a block:
//! - `sh`: commands, one after the other; one that would run forever is interrupted (SIGINT) after its first output.
//! - `sh skip="REASON"`: commands that do not run here, and why.
//! - `sh terminals`: one terminal per line, all in parallel; when the last one has ended, the others are interrupted.
//! - `LANGUAGE FILE`: saved as this file.
//! - `text`, `toml`, ...: ignored.
//!
//! The tests of `eddy-lab` follow the pages that use it ([`OF_THE_LAB`]).

mod follow;
mod lab_pages;
mod page;
mod short;
mod world;

use std::{collections::BTreeSet, fs};

use follow::follow;
pub use follow::{CARD, documents, root, spans};
use lab_pages::{CLUSTER, CORES, MANY_ROBOTS, NUMBERS, STREAMS};
use page::blocks;

/// Pages with commands of `eddy-lab`, which its tests follow.
const OF_THE_LAB: [&str; 5] = [CLUSTER, CORES, STREAMS, MANY_ROBOTS, NUMBERS];

/// One test for each page with commands.
macro_rules! pages {
    ($($test:ident: $path:literal,)*) => {
        $(#[test]
        fn $test() {
            follow($path);
        })*

        const PAGES: &[&str] = &[$($path),*];
    };
}

pages! {
    the_readme: "README.md",
    the_model_s_card: "checkpoints/particle-mingru/README.md",
    how_to_install: "docs/src/install.md",
    the_tutorial: "docs/src/tutorial.md",
    your_own_simulation: "docs/src/own_simulation.md",
    how_to_train_elsewhere: "docs/src/how-to/pytorch.md",
    how_to_use_python: "docs/src/how-to/python.md",
    how_to_record_from_a_robot: "docs/src/how-to/record.md",
    how_to_work_on_two_machines: "docs/src/how-to/two_machines.md",
    how_to_talk_to_ros: "docs/src/how-to/ros.md",
    how_to_drive_a_replay: "docs/src/how-to/replay.md",
    how_to_write_scenes: "docs/src/how-to/scenes.md",
    how_to_use_object_stores: "docs/src/how-to/stores.md",
    how_to_exchange_data: "docs/src/how-to/exchange.md",
    how_to_train: "docs/src/how-to/train.md",
    how_to_watch: "docs/src/how-to/view.md",
    how_to_evaluate: "docs/src/how-to/evaluate.md",
    how_to_estimate_errors: "docs/src/how-to/error_estimates.md",
    how_to_state_the_stiffness: "docs/src/how-to/stiffness.md",
    how_to_secure_zenoh: "docs/src/how-to/secure_zenoh.md",
    how_to_set_up_a_shell: "docs/src/how-to/shell.md",
    how_to_deploy: "docs/src/deploy/README.md",
    the_paper_s_study: "docs/src/background/paper.md",
    what_a_gpu_does: "docs/src/background/gpu.md",
}

#[test]
fn every_page_with_commands_has_its_test_and_every_block_says_what_it_is() {
    let mut with_commands = BTreeSet::new();
    for path in documents() {
        for block in blocks(&fs::read_to_string(root().join(&path)).unwrap()) {
            let language = block.words.first().map(String::as_str);
            assert!(language.is_some(), "{path}:{}: found a block without a language", block.line);
            assert!(
                !["bash", "console", "shell", "zsh"].contains(&language.unwrap()),
                "{path}:{}: found {language:?}, expected sh, so that it is run",
                block.line
            );
            if language == Some("sh") {
                with_commands.insert(path.clone());
            }
        }
    }
    let tested = PAGES.iter().chain(&OF_THE_LAB).map(|page| (*page).to_owned());
    assert_eq!(with_commands, tested.collect());
}

#[test]
fn every_command_within_a_sentence_exists() {
    let held = follow::sentences("eddy ");
    assert!(
        held > 20,
        "found {held} commands, expected more; does the parser still recognise them?"
    );
}

#[test]
fn the_examples_of_every_help() {
    // Earlier examples create the files that later ones use.
    follow::examples(
        "eddy",
        &["simulate", "train", "predict", "bag merge", "bag recover", "bag export"],
    );
}
