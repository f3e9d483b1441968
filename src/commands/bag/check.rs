//! `eddy bag check`.

use std::path::Path;

use anyhow::bail;

use super::survey;
use eddy_bag::BagReader;

/// Prints all problems of a bag.
pub fn run(path: &Path, quiet: bool) -> anyhow::Result<()> {
    let bag = BagReader::open(path)?;
    let mut survey = survey(&bag, quiet);
    survey.check_files(&bag);
    for finding in &survey.findings {
        println!("{finding}");
    }
    let listed = survey.findings.len() as u64;
    let findings = listed + survey.further_findings;
    if survey.further_findings > 0 {
        println!("... and {} more", survey.further_findings);
    }
    if findings > 0 {
        let more = survey.further_findings > 0;
        let listed = if more { format!(" (first {listed} listed)") } else { String::new() };
        bail!("{}: {findings} problems found{listed}", path.display());
    }
    println!("{}: {} messages, no problems found", path.display(), bag.message_count());
    Ok(())
}
