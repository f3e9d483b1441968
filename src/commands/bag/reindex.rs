//! `eddy bag reindex`.

use std::path::Path;

use super::report;
use eddy::bag::{BagError, reindex};

/// Writes metadata and missing summaries anew.
pub fn run(path: &Path) -> anyhow::Result<()> {
    let reindexed = reindex(path).map_err(|error| {
        let unfit = matches!(
            error,
            BagError::Unfinished { .. } | BagError::Truncated { .. } | BagError::Corrupt { .. }
        );
        let error = anyhow::Error::from(error);
        if unfit { error.context("eddy bag recover saves what can be read") } else { error }
    })?;
    for file in &reindexed.summarized {
        println!("{}: has a summary now", file.display());
    }
    report(&reindexed.bag);
    Ok(())
}
