//! Follows pages, sentences and examples.

use std::{collections::BTreeSet, fs, path::Path};

use super::{
    page::{Block, blocks, commands},
    world::World,
};
use crate::support::{self, eddy, succeed};

/// The repository.
pub fn root() -> &'static Path {
    let package = Path::new(env!("CARGO_MANIFEST_DIR"));
    let is_root = |folder: &&Path| folder.join("docs/src/SUMMARY.md").exists();
    package.ancestors().find(is_root).expect("the package is in the repository")
}

/// Follows the instructions of a page.
pub fn follow(path: &str) {
    let mut world = World::new();
    for Block { line, words, skip, text } in blocks(&fs::read_to_string(root().join(path)).unwrap())
    {
        let place = format!("{path}:{line}");
        let words: Vec<_> = words.iter().map(String::as_str).collect();
        if skip.is_some() {
            continue;
        }
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

/// The card of the shipped model.
pub const CARD: &str = "checkpoints/particle-mingru/README.md";

/// The Markdown files outside the book that users read, and those of the book.
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
    let others = ["CONTRIBUTING.md", "README.md", "checkpoints/README.md", CARD];
    let mut found = BTreeSet::from(others.map(str::to_owned));
    collect(&root().join("docs/src"), &mut found);
    found
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

/// Checks the commands within sentences that begin so, and returns their number. Some would take hours: only the existence of the
/// command and its options is tested.
pub fn sentences(program: &str) -> usize {
    let mut held = 0;
    for path in documents() {
        for span in spans(&fs::read_to_string(root().join(&path)).unwrap()) {
            // A command with a placeholder or an ellipsis is incomplete.
            let whole = !span.contains("...")
                && !span.split(' ').any(|word| word.chars().all(char::is_uppercase));
            let Some(words) = span.strip_prefix(program).filter(|_| whole) else { continue };
            let output = eddy().args(words.split_whitespace()).arg("--help").output().unwrap();
            let errors = String::from_utf8_lossy(&output.stderr);
            assert!(output.status.success(), "{path}: `{span}`: {errors}");
            held += 1;
        }
    }
    held
}

/// The examples at the end of a command's help.
fn listed(command: &[String]) -> Vec<String> {
    let help = succeed(command.iter().map(String::as_str).chain(["--help"]));
    let (_, lines) = help.split_once("\nExamples:\n").unwrap_or_default();
    commands(lines)
}

/// What examples of a help need and tests do not have: a GPU, a store.
const ELSEWHERE: [&str; 3] = ["--device cuda", "s3://", "gs://"];

/// Runs the examples at the end of every help of `program`, those of the commands in `order` first.
pub fn examples(program: &str, order: &[&str]) {
    let mut world = World::new();
    let place = |words: &[String]| {
        let name = words.join(" ");
        order.iter().position(|first| *first == name).unwrap_or(order.len())
    };
    let mut all: Vec<_> = support::commands().into_iter().collect();
    all.sort_by_key(|words| place(words));
    for words in &all {
        let holds_others =
            all.iter().any(|other| other.len() > words.len() && other.starts_with(words));
        let name = words.join(" ");
        let lines = listed(words);
        assert!(holds_others || !lines.is_empty(), "{program} {name} --help: no examples");
        for line in lines {
            assert!(line.contains(&format!("{program} {name}")), "{program} {name} --help: {line}");
            if ELSEWHERE.iter().any(|what| line.contains(what)) {
                continue;
            }
            if ["record", "topic", "service", "param"].contains(&words[0].as_str()) {
                let company = "eddy replay bags/sample --loop".to_owned();
                world.together(&name, &[company, "eddy node".to_owned(), line]);
            } else {
                world.one_after_another(&name, &[line]);
            }
        }
    }
}
