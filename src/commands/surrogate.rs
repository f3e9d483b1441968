//! Which surrogate a command works with.

use std::{num::NonZeroUsize, path::Path};

use anyhow::Context;
use eddy::{checkpoint::Checkpoint, engine::Surrogate};

/// The checkpoint at `path`, or the shipped particle model.
pub(super) fn checkpoint(path: Option<&Path>) -> anyhow::Result<Checkpoint> {
    match path {
        Some(path) => Ok(Checkpoint::load(path)?),
        None => Checkpoint::shipped().context("the shipped checkpoint"),
    }
}

/// The surrogate of [`checkpoint`], ready to predict; on as many threads as there are cores if not
/// given.
pub(super) fn load(
    path: Option<&Path>,
    threads: Option<NonZeroUsize>,
) -> anyhow::Result<Surrogate> {
    let checkpoint = checkpoint(path)?;
    let name = path.map_or("the shipped checkpoint".into(), |path| path.display().to_string());
    Surrogate::load(&checkpoint, threads).context(name)
}
