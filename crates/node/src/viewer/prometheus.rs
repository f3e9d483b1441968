//! Counters and rates in Prometheus' text format, version 0.0.4
//! (<https://prometheus.io/docs/instrumenting/exposition_formats/>).

use std::fmt::{Display, Write as _};

use super::{Hub, NodeStatus, PageInfo};
use crate::GroupCounts;

/// The content type of the format.
pub(super) const CONTENT_TYPE: &str = "text/plain; version=0.0.4; charset=utf-8";

/// The metrics of the program that serves the page; those of its node, if there is one, are at most a second old.
pub(super) fn render(hub: &Hub, info: &PageInfo) -> String {
    let mut text = Text(String::new());
    let (browsers, [observed, predicted, shown]) = hub.counts();
    let labels = [("command", info.command), ("version", env!("CARGO_PKG_VERSION"))];
    let model = info.model.as_deref().map(|model| ("model", model));
    let labels: Vec<_> = labels.into_iter().chain(model).collect();
    text.metric("eddy_info", "gauge", "Build and model information; always 1.");
    text.sample("eddy_info", &labels, 1);
    for (name, kind, help, value) in [
        ("eddy_page_browsers", "gauge", "Connected browsers.", browsers as u64),
        ("eddy_page_observed_total", "counter", "Observed frames received by the page.", observed),
        (
            "eddy_page_predicted_total",
            "counter",
            "Predicted frames received by the page.",
            predicted,
        ),
        ("eddy_page_shown_total", "counter", "Frames encoded for browsers.", shown),
    ] {
        text.metric(name, kind, help);
        text.sample(name, &[], value);
    }
    if let Some(status) = hub.node_status() {
        node(&mut text, &status);
    }
    text.0
}

fn node(text: &mut Text, status: &NodeStatus) {
    text.metric(
        "eddy_predictions_per_second",
        "gauge",
        "Predictions per second in the last second.",
    );
    text.sample("eddy_predictions_per_second", &[], status.rate);
    let help = "Time from the arrival of a frame to the publication of its predictions in the last second.";
    text.metric("eddy_latency_seconds", "gauge", help);
    for (quantile, latency) in ["0.5", "0.99"].into_iter().zip(status.latency) {
        text.sample("eddy_latency_seconds", &[("quantile", quantile)], latency.as_secs_f64());
    }
    text.metric("eddy_streams", "gauge", "Streams with state in the node.");
    text.sample("eddy_streams", &[], status.streams);
    text.metric("eddy_frames_lost_total", "counter", "Frames lost before the model saw them.");
    text.sample("eddy_frames_lost_total", &[], status.lost);
    if let Some(GroupCounts { members, owned_streams, foreign_streams }) = status.group {
        for (name, help, value) in [
            ("eddy_group_members", "Members of the node's group.", members),
            ("eddy_group_owned_streams", "Streams that the node predicts.", owned_streams),
            (
                "eddy_group_foreign_streams",
                "Streams of other members in the last second.",
                foreign_streams,
            ),
        ] {
            text.metric(name, "gauge", help);
            text.sample(name, &[], value);
        }
    }
    for &(name, count) in &status.counters {
        let metric = format!("eddy_{name}_total");
        text.metric(&metric, "counter", &format!("Node counter {name}, as in /diagnostics."));
        text.sample(&metric, &[], count);
    }
}

struct Text(String);

impl Text {
    fn metric(&mut self, name: &str, kind: &str, help: &str) {
        let _ = write!(self.0, "# HELP {name} {help}\n# TYPE {name} {kind}\n"); // a string takes everything
    }

    fn sample(&mut self, name: &str, labels: &[(&str, &str)], value: impl Display) {
        let escaped =
            |value: &str| value.replace('\\', "\\\\").replace('"', "\\\"").replace('\n', "\\n");
        let labels: Vec<_> =
            labels.iter().map(|(name, value)| format!("{name}=\"{}\"", escaped(value))).collect();
        let labels =
            if labels.is_empty() { String::new() } else { format!("{{{}}}", labels.join(",")) };
        let _ = writeln!(self.0, "{name}{labels} {value}"); // as above
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn every_counter_of_a_node_is_a_metric() {
        let hub = Hub::default();
        let info =
            PageInfo { command: "node", title: "a".to_owned(), model: Some("a\"b\\c".to_owned()) };
        assert!(!render(&hub, &info).contains("eddy_received_total"), "no node has reported");
        hub.report(NodeStatus {
            rate: 62.5,
            latency: [Duration::from_micros(700), Duration::from_millis(2)],
            streams: 3,
            lost: 4,
            group: Some(GroupCounts { members: 3, owned_streams: 33, foreign_streams: 67 }),
            counters: vec![("received", 5), ("too_fast", 6)],
            rejected: None,
            warnings: Vec::new(),
        });
        let text = render(&hub, &info);
        for line in [
            "# TYPE eddy_received_total counter",
            "eddy_received_total 5",
            "eddy_too_fast_total 6",
            "eddy_predictions_per_second 62.5",
            "eddy_latency_seconds{quantile=\"0.5\"} 0.0007",
            "eddy_latency_seconds{quantile=\"0.99\"} 0.002",
            "eddy_streams 3",
            "eddy_frames_lost_total 4",
            "eddy_group_members 3",
            "eddy_group_owned_streams 33",
            "eddy_group_foreign_streams 67",
        ] {
            assert!(text.lines().any(|found| found == line), "{line} is missing in\n{text}");
        }
        assert!(text.contains(r#"model="a\"b\\c""#), "{text}");
        assert!(text.ends_with('\n'));
    }
}
