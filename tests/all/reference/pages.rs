//! The pages on messages, checkpoints and diagnostics.

use std::fs;

use eddy_inference::{
    checkpoint::{Checkpoint, tensor_shapes},
    error_model::{FEATURES, LEVELS},
};
use eddy_learning::model::{Architecture, Core};
use eddy_messages::{
    built_in_types,
    services::{ParameterKind, ParameterValue},
    type_support,
};
use eddy_node::{Counters, NodeSettings, PARAMETERS, ParameterSpec, Values};

use super::{
    configuration::{Row, rows, table},
    root,
    source::Source,
};

/// The page on `.msg` files and frames in shared memory.
pub fn messages() -> String {
    let mut text = "# Messages\n\n\
        The ament package `msgs/eddy_msgs` defines eddy's own messages. Nodes on rmw_zenoh match topics by their ROS 2 type hash \
        (RIHS01).\n"
        .to_owned();
    for name in
        ["ParticleFrame", "PredictionStatus", "ToolDescription", "Tool", "ToolPart", "ToolFrame"]
    {
        let file = root().join(format!("msgs/eddy_msgs/msg/{name}.msg"));
        let definition = fs::read_to_string(file).unwrap();
        let full = format!("eddy_msgs/msg/{name}");
        let hash = &type_support(&full).unwrap().hash;
        text.push_str(&format!("\n## {full}\n\n`{hash}`\n\n```text\n{definition}```\n"));
    }
    text.push_str(
        "\n## Standard messages\n\nTheir definitions, those of ROS 2 Jazzy, are built in; they are in `msgs/standard`.\n\n\
        | type | type hash |\n|---|---|\n",
    );
    for name in built_in_types().filter(|name| !name.starts_with("eddy_msgs/")) {
        text.push_str(&format!("| `{name}` | `{}` |\n", type_support(name).unwrap().hash));
    }
    let shm = Source::of(&[
        "crates/transport/src/shm/layout.rs",
        "crates/frames/src/view.rs",
        "crates/frames/src/lib.rs",
    ]);
    for (item, name, what) in [
        (
            "FrameHeader",
            "eddy::FrameHeader",
            "The user header of a frame on shm (iceoryx2), `repr(C)`. `D` is the number of dimensions: 2, 48 bytes. \
             `eddy::FrameHeader3` has 3, 56 bytes with the four that fill it.",
        ),
        (
            "Particle",
            "eddy::Particle",
            "An element of the payload slice; `repr(C)`, 20 bytes; `eddy::Particle3` 28.",
        ),
    ] {
        text.push_str(&format!("\n## {name}\n\n{what}\n\n| field | type | |\n|---|---|---|\n"));
        for field in &shm.item(item).members {
            text.push_str(&format!("| `{}` | `{}` | {} |\n", field.name, field.kind, field.docs));
        }
    }
    text
}

/// The page on `model.toml` and the tensors of each network.
pub fn checkpoint() -> String {
    let source = Source::of(&[
        "crates/inference/src/checkpoint/description.rs",
        "crates/inference/src/checkpoint/network.rs",
        "crates/inference/src/ops/cell/mod.rs",
        "crates/inference/src/ops/rules",
        "crates/frames/src/lib.rs",
    ]);
    let error_model = Source::of(&[
        "crates/inference/src/error_model/mod.rs",
        "crates/inference/src/error_model/regression.rs",
    ]);
    let shipped = Checkpoint::shipped().unwrap();
    let mut keys = rows(&source, source.item("Description"), "");
    let version = shipped.description.format_version;
    keys[0].docs = format!(
        "Version of the format: {version}. Version 1, without `rules`, is also read; its particle models have the rules `area`, \
         `shape`, `flight` and `rest`, and `area` removes all of the excess in a frame. Version 3 has `material_inputs`, and is written \
         only where that is not 4."
    );
    let mut text = format!(
        "# Checkpoint\n\nA directory with `model.toml`, the description of the network, and `model.safetensors`, its weights: f32, or f16 \
         if `weights` says so, in PyTorch's layout [out, in], after the stiffnesses if there are `stiffness_knots`. The digest covers both files. `error_model.toml`, if `eddy calibrate` has made one, changes no \
         prediction and is not covered.\n\n## model.toml\n\nEach table below `rules` is a rule that \
         corrects predictions of the particle model; a missing table switches its rule off \
         ([what each rule is worth](../background/particle_model.md#what-each-rule-is-worth)).\n\n{}\n## error_model.toml\n\n\
         [Estimates of the model's errors](../how-to/error_estimates.md). A linear function has a weight for each of these features: \
         natural logarithms of mean squares over the particles (domain lengths squared) of the position errors of recent one-step \
         predictions, of recent departures of the truth from a ballistic step, of the distance of the prediction from a ballistic \
         extrapolation of the last observed frame, and of its distance from that frame; the shares of liquid, snow and jelly.\n\n{}",
        table(&keys),
        table(&rows(&error_model, error_model.item("ErrorModel"), ""))
            .replace("FEATURES of", &format!("{FEATURES} of"))
            .replace("LEVELS.len() of", &format!("{} of", LEVELS.len()))
    );
    for architecture in [Architecture::Particle, Architecture::Frame] {
        for core in [Core::MinGru, Core::MinLstm, Core::Gru, Core::Lstm, Core::Mlp] {
            let mut description = shipped.description.clone();
            (description.architecture, description.core) = (architecture, core);
            // The stiffness adds an input, several of them a first axis.
            (description.stiffness, description.stiffness_knots) = (false, Vec::new());
            let mut sizes = description.sizes.clone();
            if architecture == Architecture::Frame {
                (sizes.encoder, sizes.hidden, sizes.layers) = (256, 1250, 1);
                sizes.particles = Some(2500);
                description.grid = None;
            }
            description.sizes = sizes;
            let name = [architecture.name(), core.name()].join(" model, ");
            text.push_str(&format!(
                "\n## Tensors: {name}\n\n{}\n\n| tensor | shape |\n|---|---|\n",
                widths(&description.sizes)
            ));
            for (tensor, shape) in tensor_shapes(&description) {
                text.push_str(&format!("| `{tensor}` | {shape:?} |\n"));
            }
        }
    }
    text
}

fn widths(sizes: &eddy_inference::checkpoint::Sizes) -> String {
    let particles =
        sizes.particles.map_or(String::new(), |particles| format!(", {particles} particles"));
    format!("For encoder {}, hidden {}, one layer{particles}.", sizes.encoder, sizes.hidden)
}

/// The values that a parameter may have.
pub fn values(spec: &ParameterSpec) -> String {
    match &spec.values {
        Values::Bool => "true or false".to_owned(),
        Values::Integer { range, unit } if *range.end() == i64::MAX => {
            format!("{} or more {unit}", range.start())
        }
        Values::Integer { range, unit } => format!("{} to {} {unit}", range.start(), range.end()),
        Values::Number { range, unit } => format!("{} to {} {unit}", range.start(), range.end()),
        Values::Name => "name".to_owned(),
        Values::Word(words) => words.iter().map(|(word, _)| *word).collect::<Vec<_>>().join(", "),
    }
}

/// A parameter's value as text.
pub fn value(value: &ParameterValue) -> String {
    match value.kind() {
        Ok(ParameterKind::Bool) => value.bool_value.to_string(),
        Ok(ParameterKind::Integer) => value.integer_value.to_string(),
        Ok(ParameterKind::Double) => value.double_value.to_string(),
        _ => value.string_value.clone(),
    }
}

/// The page on diagnostics and parameters.
pub fn diagnostics() -> String {
    let source = Source::of(&[
        "crates/node/src/surrogate/counters.rs",
        "crates/node/src/surrogate/group/standing.rs",
    ]);
    let field = |item: &str, name: &str| {
        let member = source.item(item).members.iter().find(|member| member.name == name);
        member.unwrap_or_else(|| panic!("{name} is no field of {item}")).docs.clone()
    };
    let docs = |name: &str| field("Counters", name);
    let row =
        |key: &str, docs: String| Row { key: key.to_owned(), values: "count".to_owned(), docs };
    let counters = Counters::default();
    let counted = counters.named().map(|(name, _)| row(name, docs(name)));
    let group = ["members", "owned_streams", "foreign_streams"].map(|name| {
        let key = format!("group, {}", name.replace('_', " "));
        row(&key, field("GroupCounts", name) + " Present only with a group.")
    });
    let rows = |rows: &[Row]| table(rows).split_once("|---|---|---|\n").unwrap().1.to_owned();
    let mut text = format!(
        "# Diagnostics and parameters\n\nA node publishes `diagnostic_msgs/msg/DiagnosticArray` on `/diagnostics` once a second. The level is \
         ERROR if a prediction was not finite since the last message, WARN if a frame was rejected (the message gives the reason), skipped in a free run or lost, or if \
         the error of a prediction is expected to exceed `max_expected_error`, and OK otherwise. Level \
         and message are about the last second, counters about all since the start: if all is OK and nothing is published, read \
         the counters.\n\n\
         A frame without a prediction is *rejected* if it cannot be used, *lost* if the network never saw it (in a gap of the stream, in the node's queue, in transport), or *of other members* of a group.\n\n## Values\n\n| key | values | |\n|---|---|---|\n\
         | `rate (1/s)` | number | Predictions per second since the last message. |\n\
         | `latency p50 (ms)` | number | Median time from the arrival of a frame to the publication of its predictions. |\n\
         | `latency p99 (ms)` | number | 99th percentile of the same time. |\n\
         | `model` | text | Digest of the checkpoint. |\n{}\
         | `lost_in_queue, by stream` | text | {} Present only if there are any; at most the eight streams with the most losses. |\n\
         | `largest expected error (domain lengths)` | number | Largest [expected position error](../how-to/error_estimates.md) of the predictions since the last message. Present \
         only with a calibrated checkpoint and predictions no further ahead than it was calibrated for. |\n\
         | `expected error (domain lengths) at frames ahead, by stream` | text | For at most the eight streams with the largest expected errors: that error, its number of frames ahead, its bound at 90 %, \
         and the probability that a ballistic prediction is better. |\n{}",
        rows(&counted),
        docs("dropped_by_stream"),
        rows(&group),
    );
    text.push_str("\n## Parameters\n\nEach is also a key of `[node]` in a settings file.\n\n| parameter | values | default | |\n|---|---|---|---|\n");
    let defaults = NodeSettings::default();
    for spec in PARAMETERS {
        let read_only = if spec.read_only { "; read-only at run time" } else { "" };
        let default = value(&spec.get(&defaults));
        text.push_str(&format!(
            "| `{}` | {} | {default} | {}{read_only} |\n",
            spec.name,
            values(spec),
            spec.help
        ));
    }
    text
}
