//! Long jobs as plans of tasks that several machines can share.
//!
//! 1. [`file`](Plan): the file with the tasks, checked when it is read.
//! 2. `state`: which tasks are done, failed or running, in a folder beside the file.
//! 3. [`run`](OpenPlan::run_task): one task, or all of them on this machine.
//! 4. [`arrays`](OpenPlan::arrays): tasks that can run at the same time, as batch systems take them.
//!
//! A task runs after those whose outputs are its inputs. Outputs appear whole or not at all: then a task that was killed
//! is run again, and one whose outputs exist is not.

mod arrays;
mod error;
mod file;
mod run;
mod state;
#[cfg(test)]
mod tests;

pub use arrays::Array;
pub use error::PlanError;
pub use file::{Cost, Job, OpenPlan, Plan, Task};
pub use run::Outcome;
pub use state::TaskState;

/// Compiles and runs the example of the README.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
