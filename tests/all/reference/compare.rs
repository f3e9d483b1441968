//! Compares generated pages with those in the book, or writes them.

use std::fs;

use crate::documented::root;

/// Compares a page with its expected content, or writes it.
pub fn page(name: &str, expected: &str) {
    let file = root().join("docs/src").join(name);
    if std::env::var_os("UPDATE_REFERENCE").is_some() {
        fs::write(&file, expected).unwrap();
        return;
    }
    let found = fs::read_to_string(&file).unwrap_or_default();
    let differs = |(number, (found, expected)): (usize, (&str, &str))| {
        (found != expected)
            .then(|| format!("line {}: found `{found}`, expected `{expected}`", number + 1))
    };
    let first = found.lines().zip(expected.lines()).enumerate().find_map(differs);
    assert!(
        found == expected,
        "docs/src/{name} is out of date: {}; \
         UPDATE_REFERENCE=1 cargo test --release --workspace --test {} reference updates it",
        first.unwrap_or_else(|| "one is longer than the other".to_owned()),
        env!("CARGO_CRATE_NAME")
    );
}
