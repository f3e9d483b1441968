//! Processes that train together: what they must agree on, and what rank 0 decides for all. Every process draws all windows and
//! takes its part of each batch; rank 0 validates and writes the files.

#[cfg(feature = "cuda")]
use std::time::Duration;

use toml::Value;

use super::{
    Epoch, LAST_FOLDER, Run, TrainConfig, TrainError, moments::checksum, record::start_name,
    state::RunState,
};
use crate::ranks::{Group, RankError};
use eddy_inference::checkpoint::Description;

/// What rank 0 says before each group of batches.
const GO: &str = "go";
const STOP: &str = "stop";

/// Time for the loss of another process to become known after a GPU's waiting for it has ended.
#[cfg(feature = "cuda")]
const PATIENCE: Duration = Duration::from_secs(2);

/// The group of a run of several processes.
pub(super) fn join(
    config: &TrainConfig,
    description: &Description,
    run: &Run,
) -> Result<Option<Group>, TrainError> {
    let Some(options) = run.gpu.process.filter(|options| options.process.count > 1) else {
        return Ok(None);
    };
    let fact = |name: &str, value: String| (name.to_owned(), value);
    let mut facts = vec![
        fact("program", format!("eddy {}", env!("CARGO_PKG_VERSION"))),
        fact("number of processes", options.process.count.to_string()),
        fact("data", description.data.clone()),
        fact("device", run.device_name()),
        fact("--resume", run.resume.to_string()),
        fact("--from", start_name(&description.training.start)),
    ];
    let settings = Value::try_from(config).expect("settings are tables of TOML's own types");
    add_settings("", &settings, &mut facts);
    Ok(Some(Group::join(&options, &facts)?))
}

/// Adds every key with its value.
fn add_settings(path: &str, value: &Value, facts: &mut Vec<(String, String)>) {
    let Value::Table(table) = value else {
        return facts.push((path.to_owned(), value.to_string()));
    };
    for (key, value) in table {
        let path = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
        add_settings(&path, value, facts);
    }
}

/// Checks that all processes begin at the same state.
pub(super) fn same_state(
    group: &Group,
    rank: usize,
    state: &RunState,
    description: &Description,
) -> Result<(), TrainError> {
    let samples = state.samples;
    let found = format!("{samples} samples, weights {}", checksum(&state.tensors(description)));
    if group.leads() {
        group.tell(&found);
        return Ok(());
    }
    let expected = group.hear()?;
    if found == expected {
        return Ok(());
    }
    let (who, field) = (format!("rank {rank}"), "last epoch".to_owned());
    Err(RankError::Differs { who, field, found, expected }.into())
}

/// Whether all stop before the next batches. `wants` is the wish of this process; rank 0 only stops where it `may`.
pub(super) fn stops(
    group: &Group,
    wants: bool,
    may: bool,
    asked: &mut bool,
) -> Result<bool, TrainError> {
    if group.leads() {
        let stops = (wants || group.asked_to_stop()) && may;
        group.tell(if stops { STOP } else { GO });
        return Ok(stops);
    }
    if wants && !*asked {
        group.ask_to_stop();
        *asked = true;
    }
    Ok(group.hear()? == STOP)
}

/// Rank 0: tells the others the result of an epoch.
pub(super) fn tell_epoch(group: &Group, epoch: &Epoch) {
    group.tell(&toml::to_string(epoch).expect("an epoch is a table of numbers"));
}

/// Any other rank: the result of an epoch.
pub(super) fn hear_epoch(group: &Group) -> Result<Epoch, TrainError> {
    let word = group.hear()?;
    toml::from_str(&word).map_err(|_| {
        let expected = "the result of an epoch";
        TrainError::Setting { field: "word of rank 0", found: word.clone(), expected }
    })
}

/// The error, or that another process is gone, which shows as an error of the GPU that waited for it. `done` epochs are
/// complete.
pub(super) fn explain(group: &Group, error: TrainError, done: u32, run: &Run) -> TrainError {
    #[cfg(not(feature = "cuda"))]
    let _ = group;
    let reason = match error {
        TrainError::Ranks(reason @ (RankError::Lost { .. } | RankError::Failed { .. })) => reason,
        #[cfg(feature = "cuda")]
        TrainError::Cuda(_) => match group.gone(PATIENCE) {
            Some(reason) => reason,
            None => return error,
        },
        other => return other,
    };
    let (RankError::Lost { who } | RankError::Failed { who, .. }) = &reason else {
        return reason.into();
    };
    let last = run.output.join(LAST_FOLDER);
    let last = last.display();
    let kept = match done {
        0 => "no epoch is complete".to_owned(),
        _ if who.starts_with("rank 0 ") => {
            format!("the last epoch that it saved is kept in {last}, continue with --resume")
        }
        _ => format!("epoch {done} is kept in {last}, continue with --resume"),
    };
    TrainError::OtherProcess { epoch: done + 1, reason: Box::new(reason), kept }
}

/// Tells the others how this process ends.
pub(super) fn part<T>(group: Option<&Group>, outcome: &Result<T, TrainError>) {
    let Some(group) = group else { return };
    match outcome {
        Ok(_) => group.finish(),
        Err(TrainError::OtherProcess { .. }) => {}
        Err(error) => group.fail(&error.to_string()),
    }
}
