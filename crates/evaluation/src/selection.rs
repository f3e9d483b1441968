//! The streams of an evaluation: those that no checkpoint was trained on.

use std::collections::HashSet;

use super::{Context, EvaluationError, Settings};
use eddy_dataset::{Bounds, Trajectory};
use eddy_inference::{checkpoint::Description, kernels::spacing::spacing};

/// The streams to evaluate on, and their evaluation context.
pub(super) struct Selection {
    /// The streams to evaluate on.
    pub(super) streams: Vec<Trajectory>,
    /// Settings, walls and units.
    pub(super) context: Context,
    /// Digest of the streams.
    pub(super) digest: String,
    /// Which streams are excluded, one sentence each.
    pub(super) remarks: Vec<String>,
}

impl Selection {
    /// Reads all streams and excludes those that a checkpoint was trained on. `stiffness` is that of all streams, if it is given.
    pub(super) fn new(
        settings: Settings,
        descriptions: &[&Description],
        mut streams: Vec<Trajectory>,
        stiffness: Option<f32>,
    ) -> Result<Self, EvaluationError> {
        let Some(&first) = descriptions.first() else {
            return Err(EvaluationError::request("checkpoints", 0, "at least 1"));
        };
        let all = streams.len();
        let mut remarks = Vec::new();
        let mut digest = eddy_dataset::digest(&streams, |_| ())?;
        let mut walls = Bounds::default();
        streams.iter().for_each(|stream| walls.join(&stream.bounds));
        if descriptions.iter().any(|description| description.data == digest) {
            streams = eddy_dataset::test_part(&streams);
            let remark =
                "a checkpoint was trained on this data set: only its test part is evaluated";
            remarks.push(remark.to_owned());
        }
        let of_this_set = streams.len();
        streams = unseen(streams, descriptions)?;
        if streams.is_empty() {
            return Err(EvaluationError::Seen);
        }
        set_or_check_stiffness(descriptions, &mut streams, stiffness)?;
        if streams.len() < of_this_set {
            let excluded = of_this_set - streams.len();
            remarks.push(format!(
                "a checkpoint was trained on {excluded} of the {of_this_set} streams: they are excluded"
            ));
        }
        if streams.len() < all {
            digest = eddy_dataset::digest(&streams, |_| ())?;
        }
        let mut spacings: Vec<f32> = streams.iter().map(|stream| spacing(&stream.rest)).collect();
        spacings.sort_by(f32::total_cmp);
        let spacing = spacings.get(spacings.len() / 2).copied().unwrap_or(f32::INFINITY);
        let warm_up = descriptions.iter().map(|description| description.warm_up as usize).max();
        let warm_up = warm_up.unwrap_or(1);
        // All streams of a data set have the same domain.
        let domain = streams.first().map_or(first.domain, |stream| stream.domain);
        let mut context = Context::new(settings, first, warm_up, domain, walls, spacing);
        context.has_tools = streams.iter().any(|stream| stream.tools.is_some());
        context.check(streams.iter().map(|stream| stream.frames).max().unwrap_or(0))?;
        Ok(Self { streams, context, digest, remarks })
    }
}

/// Gives all streams their stiffness, or checks that it is known, if a checkpoint is conditioned on it and assumes none.
fn set_or_check_stiffness(
    descriptions: &[&Description],
    streams: &mut [Trajectory],
    given: Option<f32>,
) -> Result<(), EvaluationError> {
    let is_conditioned = descriptions.iter().any(|description| description.stiffness);
    let rejected = |found: f32, expected| {
        Err(EvaluationError::Stiffness { found: found.to_string(), expected })
    };
    match given {
        Some(found) if !(found.is_finite() && found > 0.0) => rejected(found, "a positive number"),
        Some(found) if !is_conditioned => {
            rejected(found, "nothing: no checkpoint is conditioned on it")
        }
        Some(stiffness) => {
            streams.iter_mut().for_each(|stream| stream.stiffness = Some(stiffness));
            Ok(())
        }
        None if descriptions.iter().any(|d| d.stiffness && d.assumed_stiffness.is_none()) => {
            let mut all = streams.iter().map(Trajectory::known_stiffness);
            all.try_for_each(|known| known.map(drop)).map_err(EvaluationError::UnknownStiffness)
        }
        None => Ok(()),
    }
}

/// The streams that are in no checkpoint's training or validation part, as recorded in the checkpoints.
fn unseen(
    streams: Vec<Trajectory>,
    descriptions: &[&Description],
) -> Result<Vec<Trajectory>, EvaluationError> {
    let seen: HashSet<_> = descriptions.iter().flat_map(|d| d.training.seen.iter()).collect();
    let mut unseen = Vec::new();
    for stream in streams {
        if !seen.contains(stream.fingerprint()?.as_str()) {
            unseen.push(stream);
        }
    }
    Ok(unseen)
}
