//! `eddy bag reindex`.

use std::path::Path;

use super::{report, watch_bytes};
use eddy_bag::{Recovery, Reindexing};
use eddy_cli::{Interrupt, progress_bar};

/// Rewrites metadata.yaml and adds missing summaries.
pub fn run(path: &Path, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    let bar = progress_bar(Recovery::size(path)?, "bytes", quiet);
    let found = Reindexing::open(path, &mut watch_bytes(&bar, interrupt));
    bar.finish_and_clear();
    let found = found?;
    let bar = progress_bar(found.to_copy(), "bytes", quiet);
    let outcome = found.save(&mut watch_bytes(&bar, interrupt));
    bar.finish_and_clear();
    let reindexed = outcome?;
    for file in &reindexed.summarized {
        println!("{}: summary added", file.display());
    }
    report(&reindexed.bag);
    Ok(())
}
