//! The streams that an evaluation is made on: those that no checkpoint has learned from.

use std::collections::HashSet;

use super::{Arena, EvaluationError, Settings};
use crate::dataset::{self, Bounds, Trajectory};
use eddy_inference::{checkpoint::Description, kernels::spacing::spacing};

/// The streams that are evaluated, and what they have in common.
pub(super) struct Selection {
    /// The streams.
    pub(super) streams: Vec<Trajectory>,
    /// What is the same for all predictors.
    pub(super) arena: Arena,
    /// Digest of the streams.
    pub(super) digest: String,
    /// Which streams are left out, one sentence each.
    pub(super) remarks: Vec<String>,
}

impl Selection {
    /// Looks through all streams, then leaves those out that a checkpoint has learned from.
    pub(super) fn new(
        settings: Settings,
        descriptions: &[&Description],
        mut streams: Vec<Trajectory>,
    ) -> Result<Self, EvaluationError> {
        let Some(&first) = descriptions.first() else {
            return Err(EvaluationError::request("checkpoints", 0, "at least 1"));
        };
        let all = streams.len();
        let mut remarks = Vec::new();
        let mut digest = dataset::digest(&streams, |_| ())?;
        let mut walls = Bounds::default();
        streams.iter().for_each(|stream| walls.join(&stream.bounds));
        if descriptions.iter().any(|description| description.data == digest) {
            streams = dataset::test_part(&streams);
            let remark = "this is what a checkpoint was trained on: only its test part is judged";
            remarks.push(remark.to_owned());
        }
        let of_this_set = streams.len();
        streams = unseen(streams, descriptions)?;
        if streams.is_empty() {
            return Err(EvaluationError::Seen { found: all });
        }
        if streams.len() < of_this_set {
            let known = of_this_set - streams.len();
            remarks.push(format!(
                "a checkpoint was trained on {known} of the {of_this_set} streams: they are left out"
            ));
        }
        if streams.len() < all {
            digest = dataset::digest(&streams, |_| ())?;
        }
        let mut spacings: Vec<f32> = streams.iter().map(|stream| spacing(&stream.rest)).collect();
        spacings.sort_by(f32::total_cmp);
        let spacing = spacings.get(spacings.len() / 2).copied().unwrap_or(f32::INFINITY);
        let warm_up = descriptions.iter().map(|description| description.warm_up as usize).max();
        let warm_up = warm_up.unwrap_or(1);
        // The same for all streams of a data set.
        let domain = streams.first().map_or(first.domain, |stream| stream.domain);
        let arena = Arena::new(settings, first, warm_up, domain, walls, spacing);
        arena.check(streams.iter().map(|stream| stream.frames).max().unwrap_or(0))?;
        Ok(Self { streams, arena, digest, remarks })
    }
}

/// Those that no checkpoint was fitted to or chosen by, as far as these know.
fn unseen(
    streams: Vec<Trajectory>,
    descriptions: &[&Description],
) -> Result<Vec<Trajectory>, EvaluationError> {
    let seen: HashSet<_> = descriptions.iter().flat_map(|d| &d.training.seen).collect();
    let mut unseen = Vec::new();
    for stream in streams {
        if !seen.contains(&stream.fingerprint()?) {
            unseen.push(stream);
        }
    }
    Ok(unseen)
}
