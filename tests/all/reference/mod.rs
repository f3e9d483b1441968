//! The reference pages of the book and the README's plot are generated from the program, its defaults, the docs in its
//! source and measured tables. `UPDATE_REFERENCE=1 cargo test --release --test all reference` updates them.

mod commands;
mod compare;
mod configuration;
mod figure;
mod pages;
mod source;

use crate::documented::root;
use compare::page;

#[test]
fn the_figure_is_drawn_from_the_table_of_simulators() {
    page("pictures/cost_error.svg", &figure::svg());
}

#[test]
fn the_reference_of_commands_is_their_help() {
    page("reference/commands.md", &commands::page("eddy", "# Commands"));
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
