//! `eddy bag check`.

use std::path::Path;

use anyhow::bail;

use super::survey;
use crate::commands::counted;
use eddy_bag::{BagReader, Survey};
use eddy_cli::terminal::on_one_line;

/// Prints all problems of a bag.
pub fn run(path: &Path, quiet: bool) -> anyhow::Result<()> {
    let bag = BagReader::open(path)?;
    let mut survey = survey(&bag, quiet);
    survey.check_files(&bag);
    for finding in &survey.findings {
        println!("{}", on_one_line(&finding.to_string()));
    }
    if survey.further_findings > 0 {
        println!("... and {} more", survey.further_findings);
    }
    print_remarks(&bag, &survey);
    match survey.finding_count() {
        0 => {}
        1 => bail!("{}: 1 problem found", path.display()),
        findings => bail!("{}: {findings} problems found", path.display()),
    }
    let messages = counted(bag.message_count(), "message");
    println!("{}: {messages}, no problems found", path.display());
    Ok(())
}

/// Prints what is no damage: which streams restart, and in which the number of particles changes.
fn print_remarks(bag: &BagReader, survey: &Survey) {
    for (topic, found) in bag.topics().iter().zip(&survey.topics) {
        for (stream, found) in &found.streams {
            let (least, most) = found.particles;
            if least < most {
                let name = on_one_line(&topic.name);
                println!(
                    "topic {name}, stream {stream}: {least} to {most} particles; networks need the same ones in all frames of a stream"
                );
            }
        }
        for (stream, found) in found.streams.iter().filter(|(_, stream)| stream.restarts > 0) {
            let times = counted(found.restarts, "time");
            let name = on_one_line(&topic.name);
            println!("topic {name}, stream {stream}: restarts {times}, as in a loop");
        }
    }
}
