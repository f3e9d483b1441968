//! The `eddy` program: parses the command line and hands over to one of [`commands`].

mod cli;
mod commands;

fn main() {}
