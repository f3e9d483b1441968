//! Holds the table of layers in `src/lib.rs`: a module uses only modules of lower layers.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
};

/// Crates that may appear in some modules only, and those modules.
const CONFINED: [(&str, &[&str]); 21] = [
    ("burn", &["model", "train", "eval"]),
    ("mcap", &["bag"]),
    ("foxglove", &["transport/foxglove"]),
    ("zenoh", &["transport/zenoh"]),
    ("iceoryx2", &["transport/shm"]),
    ("ros2_client", &["transport/dds"]),
    ("rustdds", &["transport/dds"]),
    ("comfy_table", &["eval", "commands"]),
    ("clap_complete", &["cli", "commands"]),
    ("clap_mangen", &["commands"]),
    ("strsim", &["near"]),
    ("npyz", &["exchange"]),
    ("zip", &["exchange"]),
    ("hdf5", &["exchange"]),
    ("png", &["picture"]),
    ("gif", &["picture"]),
    ("embedded_graphics", &["picture"]),
    ("maud", &["page"]),
    ("plotters", &["page"]),
    ("axum", &["viewer"]),
    ("tokio", &["viewer"]),
];

fn source() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("src")
}

/// Module name to layer, read from the table in `src/lib.rs`.
fn table() -> BTreeMap<String, u32> {
    let text = fs::read_to_string(source().join("lib.rs")).unwrap();
    let mut layers = BTreeMap::new();
    for row in text.lines().filter_map(|line| line.strip_prefix("//! | L")) {
        let (layer, modules) = row.split_once('|').unwrap();
        for module in modules.split('`').skip(1).step_by(2) {
            layers.insert(module.to_owned(), layer.trim().parse().unwrap());
        }
    }
    layers
}

/// Every source file with the module it belongs to.
fn files() -> Vec<(String, PathBuf)> {
    fn collect(folder: &Path, files: &mut Vec<PathBuf>) {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                collect(&path, files);
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                files.push(path);
            }
        }
    }
    let mut paths = Vec::new();
    collect(&source(), &mut paths);
    let module = |path: &Path| {
        let inside = path.strip_prefix(source()).unwrap();
        let first = inside.components().next().unwrap().as_os_str().to_str().unwrap();
        first.trim_end_matches(".rs").to_owned()
    };
    paths.into_iter().map(|path| (module(&path), path)).collect()
}

/// The modules that a file names after `crate::` or `eddy::`, also in braces.
fn used(text: &str) -> Vec<String> {
    let mut names = Vec::new();
    for root in ["crate::", "eddy::"] {
        for (at, _) in text.match_indices(root) {
            let before = text[..at].chars().next_back();
            if before.is_some_and(|c| c.is_alphanumeric() || c == '_') {
                continue;
            }
            let rest = &text[at + root.len()..];
            match rest.strip_prefix('{') {
                Some(group) => names.extend(group_members(group)),
                None => names.extend(identifier(rest)),
            }
        }
    }
    names
}

/// The first words of a `{...}` group's members at its outer level.
fn group_members(group: &str) -> Vec<String> {
    let mut names = Vec::new();
    let mut depth = 0;
    let mut member_begins = true;
    for (at, c) in group.char_indices() {
        match c {
            '{' => depth += 1,
            '}' if depth == 0 => break,
            '}' => depth -= 1,
            ',' if depth == 0 => member_begins = true,
            c if member_begins && depth == 0 && !c.is_whitespace() => {
                names.extend(identifier(&group[at..]));
                member_begins = false;
            }
            _ => {}
        }
    }
    names
}

fn identifier(text: &str) -> Option<String> {
    let end = text.find(|c: char| !(c.is_alphanumeric() || c == '_')).unwrap_or(text.len());
    (end > 0).then(|| text[..end].to_owned())
}

#[test]
fn every_module_is_in_the_table() {
    let layers = table();
    for (module, path) in files() {
        let entry = ["main", "lib"].contains(&module.as_str());
        assert!(entry || layers.contains_key(&module), "{} is in no layer", path.display());
    }
}

#[test]
fn a_module_uses_only_lower_layers() {
    let layers = table();
    for (module, path) in files() {
        let Some(&layer) = layers.get(&module) else { continue };
        for name in used(&fs::read_to_string(&path).unwrap()) {
            let Some(&other) = layers.get(&name) else { continue };
            let program = ["cli", "commands"];
            let beside = program.contains(&module.as_str()) && program.contains(&name.as_str());
            assert!(
                name == module || other < layer || beside,
                "{}: {module} (L{layer}) uses {name} (L{other})",
                path.display()
            );
        }
    }
}

#[test]
fn crates_stay_in_their_rooms() {
    for (_, path) in files() {
        let text = fs::read_to_string(&path).unwrap();
        let inside = path.strip_prefix(source()).unwrap().to_str().unwrap().to_owned();
        for (name, rooms) in CONFINED {
            let named = [format!("use {name}::"), format!(" {name}::"), format!("({name}::")];
            let uses = named.iter().any(|form| text.contains(form.as_str()));
            let allowed = rooms.iter().any(|room| inside.starts_with(room));
            assert!(!uses || allowed, "{inside} uses {name}, which belongs to {rooms:?}");
        }
    }
}

#[test]
fn uses_are_found_in_every_form() {
    let text = "use crate::{\n  bag::{A, B},\n  frame::Frame,\n};\nfn f(x: eddy::msg::Time) { macro_crate::x }";
    assert_eq!(used(text), ["bag", "frame", "msg"]);
}
