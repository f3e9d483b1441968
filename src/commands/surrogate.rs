//! The surrogate of a command.

use std::{num::NonZeroUsize, path::Path};

use anyhow::Context;
use eddy_inference::{checkpoint::Checkpoint, engine::Surrogate};

/// The surrogate of the checkpoint at `path`, or of the shipped particle model; one thread per core by default.
pub(super) fn load(
    path: Option<&Path>,
    threads: Option<NonZeroUsize>,
) -> anyhow::Result<Surrogate> {
    let checkpoint = Checkpoint::load_or_shipped(path)?;
    let name = path.map_or("the shipped checkpoint".into(), |path| path.display().to_string());
    Surrogate::load(&checkpoint, threads).context(name)
}
