//! The paper's comparisons.
//!
//! 1. [`config`](StudyConfig): data, networks, budget; the paper's and a quick one.
//! 2. [`plan`](Comparison): the networks of each comparison, and the folders of a study.
//! 3. [`results`](Trained): results of trainings and learning curves, saved so that a study can be resumed.
//! 4. [`networks`](Networks), [`page`](StudyReport): tables and plots.
//! 5. [`run()`]: a whole comparison: scenes ([`eddy_dataset::simulate`]), networks (`training`)
//!    or `learning_curves`, evaluation ([`eddy_evaluation`]), `step_times`, and the files of the report (`write`).
//! 6. [`parts`](Part): the parts of a comparison, for plans whose tasks run on several machines.
//! 7. `command_lines`: the equivalent commands, step by step.

mod command_lines;
mod config;
mod learning_curves;
mod networks;
mod page;
mod parts;
mod plan;
mod results;
mod run;
mod step_times;
#[cfg(test)]
pub(crate) mod tests;
mod training;
mod write;

pub use config::{DataSet, SceneChoice, StudyConfig};
pub use networks::Networks;
pub use page::StudyReport;
pub use parts::{Part, run_part};
pub use plan::{Comparison, Folders, Variant};
pub use results::{Curve, Losses, ResultError, Speed, Trained};
pub use run::{StudyRequest, run};
pub(crate) use {plan::runs, run::solvers, write::files as report_files};
