//! `eddy bag check`.

use std::path::Path;

use anyhow::bail;

use super::survey;
use eddy_bag::BagReader;

/// Says everything that is wrong with a bag.
pub fn run(path: &Path, quiet: bool) -> anyhow::Result<()> {
    let bag = BagReader::open(path)?;
    let mut survey = survey(&bag, quiet);
    survey.check_files(&bag);
    for finding in &survey.findings {
        println!("{finding}");
    }
    let findings = survey.findings.len() as u64 + survey.further_findings;
    if survey.further_findings > 0 {
        println!("... and {} more", survey.further_findings);
    }
    if findings > 0 {
        bail!("{}: findings: found {findings}, expected 0", path.display());
    }
    println!("{}: {} messages, nothing wrong", path.display(), bag.message_count());
    Ok(())
}
