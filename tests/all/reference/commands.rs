//! The pages on commands.

use crate::support::{commands, succeed};

/// `--help` of every command of `program`, below a heading and an introduction.
pub fn page(program: &str, introduction: &str) -> String {
    let mut text = format!(
        "{introduction}\n\nThe output of `--help` for each command; `-h` prints a shorter version.\n"
    );
    let everywhere = ["  -h, --help", "  -V, --version"];
    for words in commands() {
        let help = succeed(words.iter().map(String::as_str).chain(["--help"]));
        let name = [&[program.to_owned()], words.as_slice()].concat().join(" ");
        // Global options are listed only for the program itself.
        let help = match words.is_empty() {
            true => help,
            false => without(&without_section(&help, "Global options:"), &everywhere),
        };
        text.push_str(&format!("\n## {name}\n\n```text\n{}\n```\n", help.trim_end()));
    }
    for topic in topics() {
        let help = succeed(["help", &topic]);
        let help = help.trim_end();
        text.push_str(&format!("\n## {program} help {topic}\n\n```text\n{help}\n```\n"));
    }
    text
}

/// What the first screen says that help explains beside commands.
fn topics() -> Vec<String> {
    let help = succeed(["--help"]);
    let topics = help.split_once("`eddy help TOPIC` one of ").map(|(_, topics)| topics);
    let topics = topics.and_then(|topics| topics.lines().next()).unwrap_or_default();
    let topics = topics.trim_end_matches('.').split(", ").map(str::to_owned);
    topics.filter(|topic| !topic.is_empty()).collect()
}

/// Help without the section below a heading.
fn without_section(help: &str, heading: &str) -> String {
    let Some((before, section)) = help.split_once(&format!("{heading}\n")) else {
        return help.to_owned();
    };
    // The next line that is not indented is the next section.
    let lines = section.lines().skip_while(|line| line.is_empty() || line.starts_with(' '));
    before.to_owned() + &lines.map(|line| format!("{line}\n")).collect::<String>()
}

/// Help without some options.
fn without(help: &str, options: &[&str]) -> String {
    let mut kept = String::new();
    let mut leaving_out = false;
    for line in help.lines() {
        let begins = line.trim_start().starts_with('-') && !line.starts_with("           ");
        if begins {
            leaving_out = options.iter().any(|option| line.starts_with(option));
        } else if !line.is_empty() && !line.starts_with("      ") {
            leaving_out = false;
        }
        if !leaving_out {
            kept.push_str(line);
            kept.push('\n');
        }
    }
    kept
}
