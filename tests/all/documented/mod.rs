//! Runs every command in `README.md`, in the book and at the end of `--help` as written, except for the changes in
//! [`tables::CHEAPER`] and the commands in [`tables::NOT_HERE`]. Each page runs from top to bottom in its own folder, which
//! starts like a clone of the repository.
//!
//! The opening fence of a block:
//! - `sh`: commands, one after the other; one that would run forever is interrupted (SIGINT) after its first output.
//! - `sh terminals`: one terminal per line, all in parallel; when the last one has ended, the others are interrupted.
//! - `LANGUAGE FILE`: saved as this file.
//! - `text`, `toml`, ...: ignored.

mod page;
mod tables;
mod world;

use std::{collections::BTreeSet, fs, path::Path};

use page::{Block, blocks, commands};
use tables::NOT_HERE;
use world::World;

use crate::{
    shell,
    support::{eddy, succeed},
};

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
    the_tutorial: "docs/src/tutorial.md",
    how_to_train_elsewhere: "docs/src/how-to/pytorch.md",
    how_to_use_python: "docs/src/how-to/python.md",
    how_to_record_from_a_robot: "docs/src/how-to/record.md",
    how_to_run_on_a_cluster: "docs/src/how-to/cluster.md",
    how_to_compare_cores: "docs/src/how-to/cores.md",
    how_to_serve_many_streams: "docs/src/how-to/streams.md",
    how_to_share_streams: "docs/src/how-to/many_robots.md",
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
    where_the_numbers_come_from: "docs/src/background/numbers.md",
    what_a_gpu_does: "docs/src/background/gpu.md",
}

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Follows the instructions of a page.
fn follow(path: &str) {
    let mut world = World::new();
    for Block { line, words, text } in blocks(&fs::read_to_string(root().join(path)).unwrap()) {
        let place = format!("{path}:{line}");
        let words: Vec<_> = words.iter().map(String::as_str).collect();
        match words[..] {
            [] => panic!("{place}: found a block without a language, expected sh, text, toml, ..."),
            ["sh"] => world.one_after_another(&place, &commands(&text)),
            ["sh", "terminals"] => world.together(&place, &commands(&text)),
            ["sh", other] => panic!("{place}: found `{other}`, expected `terminals`"),
            [_, file, ..] => world.save(file, &text),
            [_] => {}
        }
    }
}

/// The Markdown files at the top of the repository that users read, and those of the book.
pub fn documents() -> BTreeSet<String> {
    fn collect(folder: &Path, found: &mut BTreeSet<String>) {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                collect(&path, found);
            } else if path.extension().is_some_and(|extension| extension == "md") {
                found.insert(path.strip_prefix(root()).unwrap().to_str().unwrap().to_owned());
            }
        }
    }
    let mut found = BTreeSet::from(["CONTRIBUTING.md".to_owned(), "README.md".to_owned()]);
    collect(&root().join("docs/src"), &mut found);
    found
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
    assert_eq!(with_commands, PAGES.iter().map(|page| (*page).to_owned()).collect());
}

/// The code spans in the prose of a page.
pub fn spans(text: &str) -> Vec<String> {
    let mut fenced = false;
    let prose = text.lines().filter(|line| {
        let fence = line.trim_start().starts_with("```");
        fenced ^= fence;
        !fenced && !fence
    });
    let prose = prose.collect::<Vec<_>>().join(" ");
    prose.split('`').skip(1).step_by(2).map(str::to_owned).collect()
}

/// These commands are parts of sentences, and some would take hours: only the existence of the command and its options is
/// tested.
#[test]
fn every_command_within_a_sentence_exists() {
    let mut held = 0;
    for path in documents() {
        for span in spans(&fs::read_to_string(root().join(&path)).unwrap()) {
            // A command with a placeholder or an ellipsis is incomplete.
            let whole = !span.contains("...")
                && !span.split(' ').any(|word| word.chars().all(char::is_uppercase));
            let Some(words) = span.strip_prefix("eddy ").filter(|_| whole) else { continue };
            let output = eddy().args(words.split_whitespace()).arg("--help").output().unwrap();
            let errors = String::from_utf8_lossy(&output.stderr);
            assert!(output.status.success(), "{path}: `{span}`: {errors}");
            held += 1;
        }
    }
    assert!(
        held > 20,
        "found only {held} commands, expected more; does the parser still recognise them?"
    );
}

#[test]
fn what_does_not_run_here_stands_somewhere() {
    let mut written = BTreeSet::new();
    for path in PAGES {
        for block in blocks(&fs::read_to_string(root().join(path)).unwrap()) {
            written.extend(commands(&block.text));
        }
    }
    for (command, reason) in NOT_HERE {
        assert!(written.contains(*command), "no page has `{command}` ({reason})");
    }
}

/// The examples at the end of a command's help.
fn examples(command: &[String]) -> Vec<String> {
    let help = succeed(command.iter().map(String::as_str).chain(["--help"]));
    let (_, lines) = help.split_once("\nExamples:\n").unwrap_or_default();
    commands(lines)
}

#[test]
fn the_examples_of_every_help() {
    let mut world = World::new();
    // Earlier examples create the files that later ones use.
    let order =
        ["simulate", "train", "predict", "bag merge", "bag recover", "bag export", "plan simulate"];
    let place = |words: &[String]| {
        let name = words.join(" ");
        order.iter().position(|first| *first == name).unwrap_or(order.len())
    };
    let mut all: Vec<_> = shell::commands().into_iter().collect();
    all.sort_by_key(|words| place(words));
    for words in &all {
        let holds_others =
            all.iter().any(|other| other.len() > words.len() && other.starts_with(words));
        let name = words.join(" ");
        let lines = examples(words);
        assert!(holds_others || !lines.is_empty(), "eddy {name} --help: no examples");
        for line in lines {
            assert!(line.contains(&format!("eddy {name}")), "eddy {name} --help: {line}");
            if ["record", "topic", "service", "param"].contains(&words[0].as_str()) {
                let company = "eddy replay bags/sample --loop".to_owned();
                world.together(&name, &[company, "eddy node".to_owned(), line]);
            } else {
                world.one_after_another(&name, &[line]);
            }
        }
    }
}
