//! `eddy bag reindex`.

use std::path::Path;

use super::{report, watch_bytes};
use eddy_bag::{BagError, Recovery, Reindexing};
use eddy_cli::{Interrupt, progress_bar};

/// Rewrites metadata.yaml and adds missing summaries.
pub fn run(path: &Path, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    let bar = progress_bar(Recovery::size(path)?, "bytes", quiet);
    let found = Reindexing::open(path, &mut watch_bytes(&bar, interrupt));
    bar.finish_and_clear();
    let found = found.map_err(with_advice)?;
    let bar = progress_bar(found.to_copy(), "bytes", quiet);
    let outcome = found.save(&mut watch_bytes(&bar, interrupt));
    bar.finish_and_clear();
    let reindexed = outcome.map_err(with_advice)?;
    for file in &reindexed.summarized {
        println!("{}: summary added", file.display());
    }
    report(&reindexed.bag);
    Ok(())
}

/// Adds advice to an error.
fn with_advice(error: BagError) -> anyhow::Error {
    let is_damaged = matches!(
        error,
        BagError::Unfinished { .. } | BagError::Truncated { .. } | BagError::Corrupt { .. }
    );
    let error = anyhow::Error::from(error);
    if is_damaged {
        error.context("damaged bag; `eddy bag recover` copies what can be read")
    } else {
        error
    }
}
