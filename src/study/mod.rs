//! The paper's comparisons: which networks are trained, and what came out.
//!
//! 1. [`config`](StudyConfig): data, networks, budget; the paper's and a quick one.
//! 2. [`plan`](Comparison): the networks of each comparison, and the folders of a study.
//! 3. [`results`](Trained): what a training and a learning curve came to, kept so that a study goes on where it
//!    was stopped.
//! 4. [`networks`](Networks), [`page`](StudyReport): tables and plots of it.

mod config;
mod networks;
mod page;
mod plan;
mod results;

pub use config::{DataConfig, InvalidStudy, JudgingConfig, StudyConfig};
pub use networks::Networks;
pub use page::StudyReport;
pub use plan::{Comparison, Folders, Variant};
pub use results::{Curve, ResultError, Speed, Trained};
