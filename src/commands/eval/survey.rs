//! What there is to judge on.

use std::collections::HashSet;

use anyhow::ensure;

use eddy::{
    checkpoint::Description,
    dataset::{self, Bounds, Trajectory},
    eval::{Arena, Settings},
};

/// The streams that are judged on, and what they have in common.
pub(super) struct Survey {
    /// The streams.
    pub(super) streams: Vec<Trajectory>,
    /// What is the same for everyone.
    pub(super) arena: Arena,
    /// Digest of the streams.
    pub(super) digest: String,
}

impl Survey {
    /// Looks through all streams, then leaves those aside that a checkpoint has learned from. There
    /// is at least one description.
    pub(super) fn new(
        settings: Settings,
        descriptions: &[&Description],
        mut streams: Vec<Trajectory>,
    ) -> anyhow::Result<Self> {
        let all = streams.len();
        let mut digest = dataset::digest(&streams, |_| ())?;
        let mut walls = Bounds::default();
        streams.iter().for_each(|stream| walls.join(&stream.bounds));
        if descriptions.iter().any(|description| description.data == digest) {
            streams = dataset::test_part(&streams);
            println!("this is what a checkpoint was trained on: only its test part is judged");
        }
        let of_this_set = streams.len();
        streams = unseen(streams, descriptions)?;
        ensure!(
            !streams.is_empty(),
            "--data: found {all} streams that a checkpoint was trained on, all in its training or validation part, \
             expected some that it has not seen"
        );
        if streams.len() < of_this_set {
            let known = of_this_set - streams.len();
            println!(
                "a checkpoint was trained on {known} of the {of_this_set} streams: they are left out"
            );
        }
        if streams.len() < all {
            digest = dataset::digest(&streams, |_| ())?;
        }
        let mut spacings: Vec<f32> =
            streams.iter().map(|s| eddy::kernels::spacing::spacing(&s.rest)).collect();
        spacings.sort_by(f32::total_cmp);
        let spacing = spacings.get(spacings.len() / 2).copied().unwrap_or(f32::INFINITY);
        let warm_up = descriptions.iter().map(|description| description.warm_up as usize).max();
        let warm_up = warm_up.unwrap_or(1);
        let first = descriptions[0];
        // The same for all streams of a data set.
        let domain = streams.first().map_or(first.domain, |stream| stream.domain);
        let arena = Arena::new(settings, first, warm_up, domain, walls, spacing);
        arena.check(streams.iter().map(|stream| stream.frames).max().unwrap_or(0))?;
        Ok(Self { streams, arena, digest })
    }
}

/// Those that no checkpoint was fitted to or chosen by, as far as these know.
fn unseen(
    streams: Vec<Trajectory>,
    descriptions: &[&Description],
) -> anyhow::Result<Vec<Trajectory>> {
    let seen: HashSet<_> = descriptions.iter().flat_map(|d| &d.training.seen).collect();
    let mut unseen = Vec::new();
    for stream in streams {
        if !seen.contains(&stream.fingerprint()?) {
            unseen.push(stream);
        }
    }
    Ok(unseen)
}
