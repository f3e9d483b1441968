//! Tests of the library from outside: written bags, read, edited and repaired.
#![expect(clippy::unwrap_used, reason = "a test that cannot continue fails")]

mod described;
mod edit;
mod raw;
mod repair;
#[expect(dead_code, reason = "the tests of the program use the rest")]
mod support;
mod twice;
mod write_and_read;
