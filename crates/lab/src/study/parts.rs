//! The parts of a comparison, each of which can be run by a process of its own.

use anyhow::{Context, ensure};
use serde::{Deserialize, Serialize};

use super::{
    Comparison, DataSet, StudyRequest, Variant, learning_curves, run::Work, step_times, training,
    write,
};
use eddy_frames::progress::Progress;
use eddy_inference::checkpoint::Activation;

/// A part of a comparison. The scenes are parts of their data sets.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Part {
    /// Train a network.
    Network {
        /// Name of the data set.
        data: String,
        /// Name of the network.
        network: String,
        /// Seed.
        seed: u64,
    },
    /// Compute a learning curve.
    Curve {
        /// Name of the data set.
        data: String,
        /// Activation of the dense network.
        activation: Activation,
        /// Seed.
        seed: u64,
    },
    /// Evaluate the networks of a data set.
    Evaluation {
        /// Name of the data set.
        data: String,
    },
    /// Time training steps.
    StepTimes,
    /// Write the report.
    Report,
}

/// Runs a part, unless it is done. Returns a message; `None` if it was cancelled.
///
/// # Errors
/// The error of the part; a name that the comparison does not have.
pub fn run_part(
    request: &StudyRequest,
    part: &Part,
    progress: &dyn Progress,
) -> anyhow::Result<Option<String>> {
    let work = Work::new(request, progress)?;
    let message = match part {
        Part::Network { data, network, seed } => {
            let variant = variant(&work, network)?;
            return training::run_one(&work, &known(&work, data)?.name, variant, *seed);
        }
        Part::Curve { data, activation, seed } => {
            ensure!(
                request.comparison == Comparison::Activations,
                "curve: found in study {}, expected in study activations",
                request.comparison.name()
            );
            return learning_curves::run_one(&work, &known(&work, data)?.name, *activation, *seed);
        }
        Part::Evaluation { data } => {
            work.evaluate(known(&work, data)?)?;
            "evaluated".to_owned()
        }
        Part::StepTimes => {
            step_times::run(&work)?;
            "measured".to_owned()
        }
        Part::Report => write::write(&work)?.page.display().to_string(),
    };
    Ok((!work.stops()).then_some(message))
}

fn variant<'a>(work: &'a Work, name: &str) -> anyhow::Result<&'a Variant> {
    let found = work.variants.iter().find(|variant| variant.name == name);
    found.with_context(|| format!("network: found {name}, expected one of this comparison"))
}

fn known<'a>(work: &'a Work, name: &str) -> anyhow::Result<&'a DataSet> {
    let found = work.data_sets.iter().find(|set| set.name == name);
    found.with_context(|| format!("data: found {name}, expected a data set of this comparison"))
}
