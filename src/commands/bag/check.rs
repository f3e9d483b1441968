//! `eddy bag check`.

use std::path::{Path, PathBuf};

use anyhow::bail;

use super::{bags_at, survey};
use crate::commands::counted;
use eddy_bag::{BagReader, Survey};
use eddy_cli::{Interrupt, terminal::on_one_line};

/// Prints all problems of all bags.
pub fn run(paths: &[PathBuf], quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    let bags = bags_at(paths)?;
    if let [only] = &bags[..] {
        return check(only, quiet);
    }
    let mut damaged = 0;
    for bag in &bags {
        if interrupt.requested() {
            bail!("interrupted");
        }
        // The others are checked all the same.
        if let Err(error) = check(bag, quiet) {
            println!("{}", on_one_line(&format!("{error:#}")));
            damaged += 1;
        }
    }
    match damaged {
        0 => Ok(()),
        _ => bail!("{damaged} of {} bags have problems", bags.len()),
    }
}

/// Prints all problems of a bag. The error says how many there are.
fn check(path: &Path, quiet: bool) -> anyhow::Result<()> {
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
    let findings = survey.finding_count();
    if findings > 0 {
        let advice = match bag.damage() {
            Some(_) => "; `eddy bag recover` copies what can be read",
            None => "",
        };
        bail!("{}: {} found{advice}", path.display(), counted(findings, "problem"));
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
