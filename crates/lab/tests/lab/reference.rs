//! The reference page of `eddy-lab` is generated from the program.
//! `UPDATE_REFERENCE=1 cargo test --release --workspace --test lab reference` updates it.

#[path = "../../../../tests/all/reference/commands.rs"]
mod commands;
#[path = "../../../../tests/all/reference/compare.rs"]
mod compare;

/// The page up to the first command.
const INTRODUCTION: &str = "# The laboratory\n\n\
    `eddy-lab` is a program of its own for what robots do not need: benchmarks, the comparisons of the paper, and plans of long \
    jobs.\n`cargo run --release -p eddy-lab --` builds and runs it.";

#[test]
fn the_reference_of_the_laboratory_is_its_help() {
    compare::page("reference/lab.md", &commands::page("eddy-lab", INTRODUCTION));
}
