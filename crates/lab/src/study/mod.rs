//! The paper's comparisons: which networks are trained, and what came out.
//!
//! 1. [`config`](StudyConfig): data, networks, budget; the paper's and a quick one.
//! 2. [`plan`](Comparison): the networks of each comparison, and the folders of a study.
//! 3. [`results`](Trained): what a training and a learning curve came to, kept so that a study goes on where it
//!    was stopped.
//! 4. [`networks`](Networks), [`page`](StudyReport): tables and plots of it.
//! 5. [`run`]: a comparison from nothing to its report: scenes ([`eddy_evaluation::dataset::simulate`]), networks (`training`)
//!    or `learning_curves`, evaluation ([`eddy_evaluation`]), `step_times`, and the files of the report (`write`).
//! 6. `command_lines`: what to type to do the same step by step.

mod command_lines;
mod config;
mod learning_curves;
mod networks;
mod page;
mod plan;
mod results;
mod run;
mod step_times;
#[cfg(test)]
mod tests;
mod training;
mod write;

pub use config::{DataConfig, InvalidStudy, JudgingConfig, StudyConfig};
pub use networks::Networks;
pub use page::StudyReport;
pub use plan::{Comparison, Folders, Variant};
pub use results::{Curve, ResultError, Speed, Trained};
pub use run::{StudyOutcome, StudyRequest, run};
