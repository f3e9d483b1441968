//! `eddy bag reindex`.

use std::path::Path;

use super::{report, watch_bytes};
use crate::commands::{Interrupt, progress_bar};
use eddy_bag::{BagError, Recovery, Reindexing};

/// Writes metadata and missing summaries anew.
pub fn run(path: &Path, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    let bar = progress_bar(Recovery::size(path)?, "bytes", quiet);
    let found = Reindexing::open(path, &mut watch_bytes(&bar, interrupt));
    bar.finish_and_clear();
    let found = found.map_err(advised)?;
    let bar = progress_bar(found.to_copy(), "bytes", quiet);
    let outcome = found.save(&mut watch_bytes(&bar, interrupt));
    bar.finish_and_clear();
    let reindexed = outcome.map_err(advised)?;
    for file in &reindexed.summarized {
        println!("{}: has a summary now", file.display());
    }
    report(&reindexed.bag);
    Ok(())
}

/// The error with what helps against it.
fn advised(error: BagError) -> anyhow::Error {
    let unfit = matches!(
        error,
        BagError::Unfinished { .. } | BagError::Truncated { .. } | BagError::Corrupt { .. }
    );
    let error = anyhow::Error::from(error);
    if unfit { error.context("eddy bag recover saves what can be read") } else { error }
}
