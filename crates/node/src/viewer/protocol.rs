//! The messages between page and program, in JSON: `hello`, `metrics` and `outcome` to the page, [`ClientMessage`] from
//! it. Displayed frames travel as bytes ([`wire`](super::wire)).

use serde::Deserialize;
use serde_json::{Map, Value, json};

use super::{
    ControlState, Controls, Curves, Hub, NodeStatus, PageCommand,
    curves::Summary,
    mailbox::Mailbox,
    wire::{LARGEST_ERROR, SMALLEST_ERROR},
};
use crate::{PARAMETERS, ParameterSpec, Values};
use eddy_frames::Material;
use eddy_frames::palette::{self, Rgb};

/// What a page is about.
#[derive(Clone, Debug, Default)]
pub struct PageInfo {
    /// The command that serves it: `demo`, `node` or `replay`.
    pub command: &'static str,
    /// The title.
    pub title: String,
    /// Digest of the model, if there is one.
    pub model: Option<String>,
}

/// A message from a page.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(untagged)]
pub(super) enum ClientMessage {
    /// This number of frames was drawn; as many may follow.
    Drawn {
        drawn: u32,
    },
    /// Display this stream, or the current one. A string, because JavaScript numbers are exact up to 2^53 only.
    Select {
        // Required, even if null.
        #[serde(deserialize_with = "Option::deserialize")]
        select: Option<String>,
    },
    Command(PageCommand),
}

impl ClientMessage {
    pub(super) fn parse(text: &str) -> serde_json::Result<Self> {
        // Only objects: serde would accept an array as the fields of a variant.
        let object: Map<String, Value> = serde_json::from_str(text)?;
        Self::deserialize(Value::Object(object))
    }
}

/// The first message to a page. `instance` differs after a restart of the program.
pub(super) fn hello(info: &PageInfo, controls: &dyn Controls, instance: &str) -> String {
    let materials: Vec<Value> = Material::ALL
        .iter()
        .map(
            |&material| json!({ "name": material.name(), "color": palette::of_material(material) }),
        )
        .collect();
    let scale: Vec<Rgb> = palette::scale().to_vec();
    let settings: Map<String, Value> =
        PARAMETERS.iter().map(|spec| (spec.name.to_owned(), setting(spec))).collect();
    json!({
        "type": "hello",
        "version": env!("CARGO_PKG_VERSION"),
        "instance": instance,
        "command": info.command,
        "title": info.title,
        "model": info.model,
        "controls": controls.available(),
        "settings": settings,
        "materials": materials,
        "scale": scale,
        "errors": [SMALLEST_ERROR, LARGEST_ERROR],
    })
    .to_string()
}

fn setting(spec: &ParameterSpec) -> Value {
    let range = match &spec.values {
        Values::Integer { range, .. } => json!([range.start(), range.end()]),
        _ => Value::Null,
    };
    json!({ "help": spec.help, "range": range })
}

/// Metrics and state for one page, several times a second.
pub(super) fn metrics(hub: &Hub, mailbox: &Mailbox, state: &ControlState, sent: u64) -> String {
    let (browsers, [observed, predicted, shown]) = hub.counts();
    let (stream, curves) = hub.curves(mailbox);
    let streams: Vec<String> = hub.streams().iter().map(u64::to_string).collect();
    json!({
        "type": "metrics",
        "state": state,
        "node": hub.node_status().map(|status| node_metrics(&status, stream)),
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
        "name": stream.and_then(|stream| hub.name(stream)),
        "stream": stream.map(|stream| stream.to_string()),
        "following": mailbox.stream().is_none(),
        "skill": curves.as_ref().and_then(|curves| curves.now).map(|now| skill(&now)),
        "curves": curves.map(|curves| curve_rows(&curves)),
    })
    .to_string()
}

/// The state of a node, with the warnings about the shown stream.
fn node_metrics(status: &NodeStatus, shown: Option<u64>) -> Value {
    let warnings = status.warnings.iter().filter(|(stream, _)| Some(*stream) == shown);
    let warnings: Vec<&str> = warnings.map(|(_, warning)| &**warning).collect();
    let counters: Vec<Value> =
        status.counters.iter().map(|(name, count)| json!([name, count])).collect();
    json!({
        "rate": status.rate,
        "latency": status.latency.map(|latency| latency.as_secs_f64()),
        "streams": status.streams,
        "lost": status.lost,
        "counters": counters,
        "rejected": status.rejected,
        "warnings": warnings,
    })
}

fn skill(now: &Summary) -> Value {
    let baseline = now.baseline.map(|(best, _)| best.name());
    json!({
        "horizon": now.horizon,
        "value": now.skill(),
        "error": now.error,
        "baseline": baseline,
        "baseline_error": now.baseline.map(|(_, error)| error),
    })
}

/// `time`: rows of time, model, baseline. `horizon`: rows of horizon, model, baseline. Errors in domain lengths.
fn curve_rows(Curves { time, by_horizon, .. }: &Curves) -> Value {
    let time: Vec<Value> =
        time.iter().map(|point| json!([point.time, point.error, point.baseline])).collect();
    let error = |summary: &Summary| summary.baseline.map(|(_, error)| error);
    let rows: Vec<Value> =
        by_horizon.iter().map(|one| json!([one.horizon, one.error, error(one)])).collect();
    let best = by_horizon.last().and_then(|last| last.baseline).map(|(best, _)| best.name());
    json!({ "time": time, "horizon": rows, "baseline": best })
}

/// The outcome of a command, and the state of the controls since.
pub(super) fn outcome(
    command: &PageCommand,
    outcome: &Result<String, String>,
    state: &ControlState,
) -> String {
    let (done, message) = match outcome {
        Ok(message) => (true, message),
        Err(message) => (false, message),
    };
    json!({
        "type": "outcome", "of": command.name(), "done": done, "message": message, "state": state,
    })
    .to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_of_a_page_are_parsed_and_others_rejected() {
        let parse = |text: &str| ClientMessage::parse(text).ok();
        assert_eq!(parse(r#"{"drawn":1}"#), Some(ClientMessage::Drawn { drawn: 1 }));
        assert_eq!(
            parse(r#"{"select":"18446744073709551615"}"#),
            Some(ClientMessage::Select { select: Some(u64::MAX.to_string()) })
        );
        let pause = ClientMessage::Command(PageCommand::Pause);
        assert_eq!(parse(r#"{"do":"pause"}"#), Some(pause));
        assert_eq!(
            parse(r#"{"do":"horizon","frames":5}"#),
            Some(ClientMessage::Command(PageCommand::Horizon { frames: 5 }))
        );
        for text in ["", "{}", r#"{"do":"rm"}"#, r#"{"do":"horizon","frames":-1}"#, "[1]"] {
            assert_eq!(parse(text), None, "{text}");
        }
    }
}
