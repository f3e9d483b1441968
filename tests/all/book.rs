//! The book in `docs`: every page is in the summary, every link and anchor exists.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    path::{Component, Path, PathBuf},
};

use crate::documented::documents;

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// The text of a page without its fenced blocks and `code`.
fn prose(path: &str) -> String {
    let mut prose = String::new();
    let mut fenced = false;
    for line in fs::read_to_string(root().join(path)).unwrap().lines() {
        if line.trim_start().starts_with("```") {
            fenced = !fenced;
        } else if !fenced {
            prose.extend(line.split('`').step_by(2).collect::<Vec<_>>());
            prose.push('\n');
        }
    }
    prose
}

/// The link targets of a page, including pictures.
fn links(prose: &str) -> Vec<String> {
    let targets = prose.split("](").skip(1).filter_map(|rest| rest.split(')').next());
    targets.map(str::to_owned).collect()
}

/// The anchors that mdbook and GitHub give to a page's headings.
fn anchors(path: &str) -> BTreeSet<String> {
    let mut anchors = BTreeSet::new();
    let mut seen: BTreeMap<String, u32> = BTreeMap::new();
    let mut fenced = false;
    for line in fs::read_to_string(root().join(path)).unwrap().lines() {
        fenced ^= line.trim_start().starts_with("```");
        if fenced || !line.starts_with('#') {
            continue;
        }
        let kept = |c: char| match c {
            ' ' => Some('-'),
            c if c.is_alphanumeric() || c == '-' || c == '_' => c.to_lowercase().next(),
            _ => None,
        };
        let anchor: String = line.trim_start_matches('#').trim().chars().filter_map(kept).collect();
        let count = seen.entry(anchor.clone()).or_default();
        anchors.insert(if *count == 0 { anchor } else { format!("{anchor}-{count}") });
        *count += 1;
    }
    anchors
}

/// A path without `.` and `..`.
fn straight(path: &Path) -> PathBuf {
    path.components().fold(PathBuf::new(), |mut so_far, part| {
        match part {
            Component::ParentDir => drop(so_far.pop()),
            Component::CurDir => {}
            part => so_far.push(part),
        }
        so_far
    })
}

#[test]
fn every_page_is_in_the_summary_and_every_entry_is_a_page() {
    let listed: Vec<_> = links(&prose("docs/src/SUMMARY.md"));
    let listed: BTreeSet<_> = listed.iter().map(|link| format!("docs/src/{link}")).collect();
    let mut pages = documents();
    pages.retain(|page| page.starts_with("docs/") && page != "docs/src/SUMMARY.md");
    assert_eq!(listed, pages);
}

#[test]
fn every_relative_link_and_anchor_resolves() {
    let mut followed = 0;
    for page in documents() {
        for link in links(&prose(&page)) {
            if ["http://", "https://", "mailto:"].iter().any(|scheme| link.starts_with(scheme)) {
                continue;
            }
            let (file, anchor) = link.split_once('#').unwrap_or((&link, ""));
            let folder = Path::new(&page).parent().unwrap();
            let target =
                if file.is_empty() { page.clone().into() } else { straight(&folder.join(file)) };
            assert!(root().join(&target).exists(), "{page}: {link}: no such file");
            // mdbook copies what is below docs/src and nothing else.
            assert!(
                !page.starts_with("docs/") || target.starts_with("docs/src"),
                "{page}: {link}: found a link to a file outside the book, expected one inside or a URL"
            );
            let known = anchor.is_empty() || anchors(target.to_str().unwrap()).contains(anchor);
            assert!(known, "{page}: {link}: no such heading");
            followed += 1;
        }
    }
    assert!(
        followed > 20,
        "found only {followed} links, expected more; does the parser still recognise them?"
    );
}

#[test]
fn the_book_s_settings_are_toml_with_a_title_and_this_source() {
    let text = fs::read_to_string(root().join("docs/book.toml")).unwrap();
    let settings: toml::Table = text.parse().unwrap();
    let book = settings["book"].as_table().unwrap();
    assert_eq!((book["title"].as_str(), book["src"].as_str()), (Some("eddy"), Some("src")));
}

#[test]
fn the_readme_is_short() {
    let text = fs::read_to_string(root().join("README.md")).unwrap();
    let words = text.split_whitespace().count();
    // Without commands and addresses.
    let prose = text.split("```").step_by(2).flat_map(|text| text.split("](").enumerate());
    let prose = prose.map(|(number, text)| match text.split_once(')') {
        Some((_, rest)) if number > 0 => rest,
        _ => text,
    });
    let words_of = |text| str::split(text, |c: char| !(c.is_alphanumeric() || ".,".contains(c)));
    let is_number =
        |word: &&str| word.trim_start_matches('.').starts_with(|c: char| c.is_ascii_digit());
    let numbers = prose.flat_map(words_of).filter(is_number).count();
    assert!(
        words <= 700 && numbers <= 40,
        "found {words} words and {numbers} numbers, expected at most 700 and 40; the rest belongs in the book"
    );
}
