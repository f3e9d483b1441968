//! The page on settings files: every key with its type, default and documentation.

use eddy_learning::{model::Architecture, train::TrainConfig};
use eddy_node::{NodeSettings, PARAMETERS};

use super::source::{Item, Member, Source, bare, is_list};

/// A row of a table.
pub struct Row {
    pub key: String,
    pub values: String,
    pub docs: String,
}

/// The keys of `item`, including those of nested tables.
pub fn rows(source: &Source, item: &Item, prefix: &str) -> Vec<Row> {
    let of_member = |member: &Member| {
        let list = if is_list(&member.kind) { "[]" } else { "" };
        let key = format!("{prefix}{}{list}", member.name);
        match source.held(&member.kind) {
            Some(held) if !held.is_enum => rows(source, held, &format!("{key}.")),
            Some(held) if held.members.iter().any(|variant| !variant.fields.is_empty()) => {
                let fields = |variant: &Member| {
                    let row = |field: &Member| Row {
                        key: format!("{key}.{}.{}", variant.name, field.name),
                        values: values(source, &field.kind),
                        docs: format!("{} {}", variant.docs, field.docs),
                    };
                    variant.fields.iter().map(row).collect::<Vec<_>>()
                };
                held.members.iter().flat_map(fields).collect()
            }
            Some(held) => {
                let key = format!("{prefix}{}", member.name);
                let words =
                    held.members.iter().map(|word| format!("`{}`: {}", word.name, word.docs));
                let docs = [member.docs.clone()].into_iter().chain(words).collect::<Vec<_>>();
                vec![Row { key, values: values(source, &member.kind), docs: docs.join("<br>") }]
            }
            None => {
                let key = format!("{prefix}{}", member.name);
                vec![Row { key, values: values(source, &member.kind), docs: member.docs.clone() }]
            }
        }
    };
    item.members.iter().flat_map(of_member).collect()
}

/// The values that a field of a type may have, in words.
fn values(source: &Source, kind: &str) -> String {
    if let Some(inside) = kind.strip_prefix("Option<").and_then(|kind| kind.strip_suffix('>')) {
        return values(source, inside);
    }
    if let Some(inside) = kind.strip_prefix("Vec<").and_then(|kind| kind.strip_suffix('>')) {
        return format!("list of {}", values(source, inside));
    }
    if let Some((inside, length)) =
        kind.strip_prefix('[').and_then(|kind| kind.strip_suffix(']')?.rsplit_once("; "))
    {
        // What is written to files has two dimensions.
        let length = if length == "D" { "2" } else { length };
        return format!("{length} of {}", values(source, inside));
    }
    match kind {
        "bool" => "true or false".to_owned(),
        "f32" | "f64" => "number".to_owned(),
        "u32" | "u64" | "usize" => "whole number".to_owned(),
        "String" => "text".to_owned(),
        "PathBuf" => "path".to_owned(),
        "Link" => "link".to_owned(),
        "Fingerprints" => "text, base64".to_owned(),
        kind if kind.starts_with("BTreeMap<String, String>") => "table of texts".to_owned(),
        kind => {
            let words = source.item(bare(kind)).members.iter().map(|word| word.name.as_str());
            words.collect::<Vec<_>>().join(", ")
        }
    }
}

/// As a table cell; rustdoc links become plain code.
fn cell(text: &str) -> String {
    let plain = text.replace('|', "\\|");
    let mut out = String::new();
    let mut rest = plain.as_str();
    while let Some((before, link)) = rest.split_once("[`") {
        let (name, after) = link.split_once("`]").unwrap_or((link, ""));
        let after = after
            .strip_prefix('(')
            .and_then(|after| after.split_once(')'))
            .map_or(after, |(_, after)| after);
        out.push_str(&format!("{before}`{name}`"));
        rest = after;
    }
    out + rest
}

/// A table with three columns.
pub fn table(rows: &[Row]) -> String {
    let mut text = "| key | values | |\n|---|---|---|\n".to_owned();
    for Row { key, values, docs } in rows {
        text.push_str(&format!("| `{key}` | {values} | {} |\n", cell(docs)));
    }
    text
}

/// The value at a dotted key.
fn at<'t>(table: &'t toml::Table, key: &str) -> Option<&'t toml::Value> {
    let mut words = key.split('.');
    let first = table.get(words.next()?)?;
    words.try_fold(first, |value, word| value.get(word))
}

/// A value as in the program: f32 numbers without the digits that a conversion to f64 adds.
fn shown(value: &toml::Value) -> String {
    match value {
        toml::Value::Float(number) => (*number as f32).to_string(),
        toml::Value::Array(list) => {
            format!("[{}]", list.iter().map(shown).collect::<Vec<_>>().join(", "))
        }
        toml::Value::String(word) => word.clone(),
        other => other.to_string(),
    }
}

fn training() -> String {
    let source = Source::of(&[
        "crates/learning/src/train/config.rs",
        "crates/inference/src/checkpoint/network.rs",
        "crates/inference/src/ops/cell/mod.rs",
    ]);
    let [particle, frame] = [Architecture::Particle, Architecture::Frame]
        .map(|architecture| toml::Table::try_from(TrainConfig::defaults(architecture)).unwrap());
    let mut text =
        "| key | values | particle model | frame model | |\n|---|---|---|---|---|\n".to_owned();
    for Row { key, values, docs } in rows(&source, source.item("TrainConfig"), "") {
        let default = |table: &toml::Table| match key.split_once("[].") {
            Some((list, field)) => {
                let stages = table[list].as_array().unwrap();
                stages.iter().map(|stage| shown(&stage[field])).collect::<Vec<_>>().join(", ")
            }
            None if key == "network.assumed_stiffness" => "none".to_owned(),
            None => at(table, &key).map_or_else(|| panic!("{key} has no default"), shown),
        };
        let (particle, frame) = (default(&particle), default(&frame));
        text.push_str(&format!(
            "| `{key}` | {values} | {particle} | {frame} | {} |\n",
            cell(&docs)
        ));
    }
    text
}

fn node() -> String {
    let source = Source::of(&["src/commands/node/mod.rs", "crates/transport/src/lib.rs"]);
    let mut rows = rows(&source, &source.item("NodeFile").without("node"), "");
    let defaults = NodeSettings::default();
    rows.extend(PARAMETERS.iter().map(|spec| Row {
        key: format!("node.{}", spec.name),
        values: super::pages::values(spec),
        docs: format!("{}.<br>Default: {}.", spec.help, super::pages::value(&spec.get(&defaults))),
    }));
    table(&rows)
}

/// The whole page.
pub fn page() -> String {
    let launch = Source::of(&["crates/node/src/launch/plan.rs"]);
    let scene = Source::of(&[
        "crates/mpm/src/scene.rs",
        "crates/mpm/src/material.rs",
        "crates/mpm/src/order.rs",
        "crates/mpm/src/attractor.rs",
        "crates/mpm/src/body.rs",
        "crates/mpm/src/shape.rs",
        "crates/mpm/src/tool",
        "crates/frames/src/tool",
        "crates/mpm/src/flow.rs",
        "crates/frames/src/lib.rs",
    ]);
    let tools = Source::of(&["crates/node/src/tools/file.rs", "crates/frames/src/tool"]);
    format!(
        "# Configuration\n\n\
         Files are TOML and contain only what differs from the defaults. Unknown keys are rejected with a suggestion. `a.b` is the key `b` in the table `[a]`, `a[].b` the key `b` of each `[[a]]`.\n\n\
         ## Training\n\n`eddy train --config FILE`; command-line options override the file. Defaults depend on the `architecture`.\n\n{}\n\
         ## Node\n\n`eddy node --config FILE`; command-line options override the file, and ROS 2 parameters override both.\n\n{}\n\
         ## Launch\n\n`eddy launch FILE`\n\n{}\n\
         ## Scene\n\n`eddy simulate --scene FILE`; [Write scenes](../how-to/scenes.md) has examples.\n\n{}\n\
         ## Tools of a robot\n\n`eddy tools FILE`; [Tools of a robot](../how-to/ros.md#tools-of-a-robot) has an example.\n\n{}",
        training(),
        node(),
        table(&rows(&launch, launch.item("Plan"), "")),
        table(&rows(&scene, scene.item("Scene"), "")),
        table(&rows(&tools, tools.item("ToolsFile"), "")),
    )
}
