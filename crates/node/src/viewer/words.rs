//! What is said in JSON: who is there, figures, curves.

use serde::Deserialize;
use serde_json::{Map, Value, json};

use super::{
    Command, Controls, Curves, Hub, Report, State,
    curves::Summary,
    mailbox::Mailbox,
    wire::{LARGEST_ERROR, SMALLEST_ERROR},
};
use eddy_evaluation::picture::{Rgb, material_color, scale_colors};
use eddy_frames::Material;

/// Who shows something.
#[derive(Clone, Debug, Default)]
pub struct Program {
    /// The command: `demo`, `node` or `replay`.
    pub command: &'static str,
    /// What is shown, in a few words.
    pub title: String,
    /// Digest of the model that predicts, if one does.
    pub model: Option<String>,
}

/// What a page says.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(untagged)]
pub(super) enum Said {
    /// It has drawn a frame: there is room for the next.
    Drawn { drawn: u32 },
    /// It wants to see this stream, the current one if `None`. A string: numbers of JavaScript end at 2^53.
    Select {
        // Said, if only to say none.
        #[serde(deserialize_with = "Option::deserialize")]
        select: Option<String>,
    },
    /// It wants something done.
    Command(Command),
}

impl Said {
    /// Understands an object of JSON.
    pub(super) fn parse(text: &str) -> serde_json::Result<Self> {
        // A list would be taken for the fields of the first that has as many.
        let object: Map<String, Value> = serde_json::from_str(text)?;
        Self::deserialize(Value::Object(object))
    }
}

/// The first words to a page. `instance` is another one after a restart.
pub(super) fn hello(program: &Program, controls: &dyn Controls, instance: &str) -> String {
    let materials: Vec<Value> = Material::ALL
        .iter()
        .map(|&material| json!({ "name": material.name(), "color": material_color(material) }))
        .collect();
    let scale: Vec<Rgb> = scale_colors().to_vec();
    json!({
        "type": "hello",
        "version": env!("CARGO_PKG_VERSION"),
        "instance": instance,
        "command": program.command,
        "title": program.title,
        "model": program.model,
        "controls": controls.offered(),
        "materials": materials,
        "scale": scale,
        "errors": [SMALLEST_ERROR, LARGEST_ERROR],
    })
    .to_string()
}

/// The figures for one page.
pub(super) fn figures(hub: &Hub, mailbox: &Mailbox, state: &State, sent: u64) -> String {
    let (browsers, [observed, predicted, shown]) = hub.counts();
    let (stream, curves) = hub.curves(mailbox);
    let streams: Vec<String> = hub.streams().iter().map(u64::to_string).collect();
    json!({
        "type": "figures",
        "state": state,
        "node": hub.last_report().map(|report| node(&report)),
        "observed": observed,
        "predicted": predicted,
        "page": {
            "browsers": browsers,
            "shown": shown,
            "sent": sent,
            "dropped": mailbox.dropped(),
            "skipped": hub.skipped(),
        },
        "streams": streams,
        "stream": stream.map(|stream| stream.to_string()),
        "following": mailbox.stream().is_none(),
        "curves": curves.map(|curves| drawn(&curves)),
    })
    .to_string()
}

fn node(report: &Report) -> Value {
    let counters: Vec<Value> =
        report.counters.iter().map(|(name, count)| json!([name, count])).collect();
    json!({
        "rate": report.rate,
        "latency": report.latency.map(|latency| latency.as_secs_f64()),
        "streams": report.streams,
        "lost": report.lost,
        "counters": counters,
    })
}

/// `time` has rows of time, model, baseline; `ahead` rows of frames ahead, model, baseline; errors in domain lengths.
fn drawn(Curves { time, ahead }: &Curves) -> Value {
    let time: Vec<Value> =
        time.iter().map(|point| json!([point.time, point.error, point.baseline])).collect();
    let error = |summary: &Summary| summary.baseline.map(|(_, error)| error);
    let rows: Vec<Value> =
        ahead.iter().map(|one| json!([one.frames, one.error, error(one)])).collect();
    let best = ahead.last().and_then(|last| last.baseline).map(|(best, _)| best.name());
    json!({ "time": time, "ahead": rows, "baseline": best })
}

/// What became of a command, and how what is controlled is set since.
pub(super) fn outcome(
    command: &Command,
    outcome: &Result<String, String>,
    state: &State,
) -> String {
    let (done, said) = match outcome {
        Ok(said) => (true, said),
        Err(said) => (false, said),
    };
    json!({ "type": "outcome", "of": command.name(), "done": done, "said": said, "state": state })
        .to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_page_says_is_understood_and_nothing_else() {
        let said = |text: &str| Said::parse(text).ok();
        assert_eq!(said(r#"{"drawn":1}"#), Some(Said::Drawn { drawn: 1 }));
        assert_eq!(
            said(r#"{"select":"18446744073709551615"}"#),
            Some(Said::Select { select: Some(u64::MAX.to_string()) })
        );
        assert_eq!(said(r#"{"do":"pause"}"#), Some(Said::Command(Command::Pause)));
        assert_eq!(
            said(r#"{"do":"horizon","frames":5}"#),
            Some(Said::Command(Command::Horizon { frames: 5 }))
        );
        for text in ["", "{}", r#"{"do":"rm"}"#, r#"{"do":"horizon","frames":-1}"#, "[1]"] {
            assert_eq!(said(text), None, "{text}");
        }
    }
}
