//! How the documents read: paragraphs are short, sentences have few numbers, and what came before is in `docs/lab`.

use std::fs;

use regex::Regex;

use crate::documented::{CARD, documents, root};

/// Most characters of a paragraph.
const LONGEST_PARAGRAPH: usize = 600;
/// Most numbers of a sentence; a table is the place for more.
const MOST_NUMBERS: usize = 3;
/// Most words of a model's card.
const LONGEST_CARD: usize = 300;

/// The paragraphs and items of lists outside tables and fenced blocks, without the addresses of links and with `code` as one word.
fn paragraphs(text: &str) -> Vec<String> {
    let item = Regex::new(r"^\s*([-*]|\d+\.) ").unwrap();
    let address = Regex::new(r"\]\([^)]*\)").unwrap();
    let code = Regex::new(r"`[^`]*`").unwrap();
    let (mut all, mut fenced) = (vec![String::new()], false);
    for line in text.lines() {
        let start = line.trim_start();
        let is_fence = start.starts_with("```");
        fenced ^= is_fence;
        if fenced || is_fence || start.is_empty() || start.starts_with(['|', '#', '!']) {
            all.push(String::new());
            continue;
        }
        if item.is_match(line) {
            all.push(String::new());
        }
        let last = all.last_mut().unwrap();
        last.push_str(line.trim());
        last.push(' ');
    }
    let plain = |text: String| code.replace_all(&address.replace_all(&text, "]"), "x").into_owned();
    all.into_iter().filter(|text| !text.is_empty()).map(plain).collect()
}

fn numbers(sentence: &str) -> usize {
    let word =
        |text: &str| text.trim_matches(|c: char| !c.is_alphanumeric() && c != '.').to_owned();
    let is_number =
        |word: &String| word.trim_start_matches('.').starts_with(|c: char| c.is_ascii_digit());
    sentence.split_whitespace().map(word).filter(is_number).count()
}

/// Paragraphs that are too long, and sentences with too many numbers.
fn faults(text: &str) -> Vec<String> {
    let end = Regex::new(r"[.!?:;] ").unwrap();
    let mut faults = Vec::new();
    for paragraph in paragraphs(text) {
        let length = paragraph.chars().count();
        let begin: String = paragraph.chars().take(60).collect();
        if length > LONGEST_PARAGRAPH {
            faults.push(format!("{length} characters, at most {LONGEST_PARAGRAPH}: {begin}"));
        }
        for sentence in end.split(&paragraph).filter(|sentence| numbers(sentence) > MOST_NUMBERS) {
            faults.push(format!("more than {MOST_NUMBERS} numbers: {sentence}"));
        }
    }
    faults
}

#[test]
fn paragraphs_are_short_and_sentences_have_few_numbers() {
    let of_page = |page: String| {
        let text = fs::read_to_string(root().join(&page)).unwrap();
        faults(&text).into_iter().map(move |fault| format!("{page}: {fault}"))
    };
    let all: Vec<_> = documents().into_iter().flat_map(of_page).collect();
    assert!(all.is_empty(), "{}", all.join("\n"));
}

#[test]
fn what_came_before_is_in_the_laboratory_s_notes() {
    let digest = Regex::new(r"`[0-9a-f]{12}`").unwrap();
    let before = Regex::new(r"(shipped|model) before\b|previous model|no longer shipped").unwrap();
    for page in documents().into_iter().filter(|page| page != CARD) {
        let text = fs::read_to_string(root().join(&page)).unwrap();
        for (what, pattern) in [("a digest", &digest), ("history", &before)] {
            let found = pattern.find(&text).map(|found| found.as_str());
            assert_eq!(found, None, "{page}: {what} belongs into docs/lab or a model's card");
        }
    }
}

#[test]
fn a_model_s_card_is_short() {
    let text = fs::read_to_string(root().join(CARD)).unwrap();
    let words = text.split_whitespace().filter(|word| word.contains(char::is_alphanumeric)).count();
    assert!(words <= LONGEST_CARD, "found {words} words, expected at most {LONGEST_CARD}");
}

#[test]
fn faults_are_found() {
    let long = "word ".repeat(130);
    let text = format!(
        "Some 1, 2 and .3. Four 4, 5, 6 and 7.\n\n| 1 | 2 | 3 | 4 |\n\n```\n1 2 3 4\n```\n- {long}\n- short"
    );
    let found = faults(&text);
    assert_eq!(found.len(), 2, "{found:?}");
    assert!(
        found[0].contains("Four 4") && found[1].contains(" characters, at most 600"),
        "{found:?}"
    );
}
