//! The reference pages of the book and the README's plot are generated from the program, its defaults, the docs in its
//! source and measured tables. `UPDATE_REFERENCE=1 cargo test --release --test all reference` updates them.

mod configuration;
mod figure;
mod pages;
mod source;

use std::{fs, path::Path};

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Compares a page with its expected content, or writes it.
fn page(name: &str, expected: &str) {
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
         UPDATE_REFERENCE=1 cargo test --release --test all reference updates it",
        first.unwrap_or_else(|| "one is longer than the other".to_owned())
    );
}

#[test]
fn the_figure_is_drawn_from_the_table_of_simulators() {
    page("pictures/cost_error.svg", &figure::svg());
}

#[test]
fn the_reference_of_commands_is_their_help() {
    page("reference/commands.md", &pages::commands());
}

#[test]
fn the_reference_of_configuration_is_that_of_the_structs_files_are_read_into() {
    page("reference/configuration.md", &configuration::page());
}

#[test]
fn the_reference_of_messages_is_their_definitions() {
    page("reference/messages.md", &pages::messages());
}

#[test]
fn the_reference_of_checkpoints_is_that_of_their_description_and_weights() {
    page("reference/checkpoint.md", &pages::checkpoint());
}

#[test]
fn the_reference_of_diagnostics_is_that_of_the_counters_and_parameters() {
    page("reference/diagnostics.md", &pages::diagnostics());
}
