//! Rules of the workspace: crates depend on each other in one direction, and an external dependency belongs to one crate.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    path::{Path, PathBuf},
};

use eddy_frames::Material;
use toml::Table;

use crate::documented::spans;

/// External dependencies and the crate that each belongs to; tokio runs the live page and requests to stores.
const HOMES: [(&str, &str); 23] = [
    ("axum", "node"),
    ("burn", "learning"),
    ("bytes", "storage"),
    ("cudarc", "cuda"),
    ("embedded-graphics", "pages"),
    ("foxglove", "transport"),
    ("gif", "pages"),
    ("hdf5", "exchange"),
    ("hyper", "node"),
    ("hyper-util", "node"),
    ("iceoryx2", "transport"),
    ("maud", "pages"),
    ("mcap", "bag"),
    ("npyz", "exchange"),
    ("object_store", "storage"),
    ("plotters", "pages"),
    ("plotters-backend", "pages"),
    ("reqwest", "storage"),
    ("ros2-client", "transport"),
    ("strsim", "settings"),
    ("tokio", "node"),
    ("tokio", "storage"),
    ("zenoh", "transport"),
];

/// Middleware crates and the folder of the crate `transport` that each belongs to.
const MIDDLEWARE: [(&str, &str); 5] = [
    ("foxglove", "foxglove"),
    ("iceoryx2", "shm"),
    ("ros2_client", "dds"),
    ("rustdds", "dds"),
    ("zenoh", "zenoh"),
];

/// Dependencies that crates meant for use on their own must not pull in.
const WITHOUT: [(&str, &[&str]); 7] = [
    ("eddy-cuda", &["burn", "iceoryx2", "mcap", "ros2-client", "zenoh"]),
    ("eddy-inference", &["burn", "iceoryx2", "mcap", "ros2-client", "zenoh"]),
    ("eddy-mpm", &["burn", "iceoryx2", "mcap", "ros2-client", "zenoh"]),
    ("eddy-dataset", &["burn", "iceoryx2", "maud", "plotters", "ros2-client", "zenoh"]),
    ("eddy-evaluation", &["burn", "iceoryx2", "ros2-client", "zenoh"]),
    ("eddy-node", &["burn", "eddy-mpm", "gif", "maud", "plotters"]),
    ("eddy-threads", &["eddy-frames", "rayon", "tracing"]),
];

/// Packages that are programs.
const PROGRAMS: [&str; 2] = ["eddy-surrogates", "eddy-lab"];

/// Pages and pictures that guide through the source.
const GUIDES: [&str; 4] = [
    "CONTRIBUTING.md",
    "docs/src/background/source.md",
    "docs/src/pictures/frame_path.svg",
    "docs/src/pictures/training_batch.svg",
];

/// Folders at the top of the repository.
const FOLDERS: [&str; 10] = [
    ".ci",
    "bags",
    "checkpoints",
    "crates",
    "docs",
    "launch_configs",
    "msgs",
    "python",
    "src",
    "tests",
];

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn manifest(folder: &Path) -> Table {
    fs::read_to_string(folder.join("Cargo.toml")).unwrap().parse().unwrap()
}

/// Dependencies of each package of the workspace, without dev-dependencies.
fn dependencies() -> BTreeMap<String, BTreeSet<String>> {
    let members = fs::read_dir(root().join("crates")).unwrap().map(|entry| entry.unwrap().path());
    let folders = members.chain([root().to_owned()]);
    folders
        .map(|folder| {
            let manifest = manifest(&folder);
            let name = manifest["package"]["name"].as_str().unwrap().to_owned();
            let dependencies = manifest["dependencies"].as_table().unwrap().keys().cloned();
            (name, dependencies.collect())
        })
        .collect()
}

/// All packages of the workspace that a package depends on, itself included.
fn closure(name: &str, all: &BTreeMap<String, BTreeSet<String>>) -> BTreeSet<String> {
    let mut found = BTreeSet::new();
    let mut open = vec![name.to_owned()];
    while let Some(name) = open.pop() {
        if found.insert(name.clone()) {
            open.extend(all[&name].iter().filter(|name| all.contains_key(*name)).cloned());
        }
    }
    found
}

fn sources(folder: &Path) -> Vec<PathBuf> {
    let mut files = Vec::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            files.extend(sources(&path));
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            files.push(path);
        }
    }
    files
}

#[test]
fn a_dependency_has_one_home() {
    for (package, dependencies) in dependencies() {
        for (dependency, _) in HOMES.iter().filter(|(name, _)| dependencies.contains(*name)) {
            let homes: Vec<_> = HOMES.iter().filter(|(name, _)| name == dependency).collect();
            assert!(
                homes.iter().any(|(_, home)| package == format!("eddy-{home}")),
                "{package} depends on {dependency}, expected only {homes:?}"
            );
        }
    }
}

#[test]
fn homes_are_lived_in() {
    let all = dependencies();
    for (dependency, home) in HOMES {
        assert!(all[&format!("eddy-{home}")].contains(dependency), "{home} has no {dependency}");
    }
}

#[test]
fn middleware_stays_in_its_file_of_the_transport() {
    let folder = root().join("crates/transport/src");
    for file in sources(&folder) {
        let text = fs::read_to_string(&file).unwrap();
        let inside = file.strip_prefix(&folder).unwrap().to_str().unwrap();
        for (name, room) in MIDDLEWARE {
            let forms = [format!("use {name}::"), format!(" {name}::"), format!("({name}::")];
            let uses = forms.iter().any(|form| text.contains(form.as_str()));
            assert!(
                !uses || inside.starts_with(room),
                "{inside} uses {name}, expected {room} only"
            );
        }
    }
}

#[test]
fn nothing_depends_on_a_program_and_only_the_programs_on_the_command_line() {
    for (package, dependencies) in dependencies() {
        let is_program = PROGRAMS.contains(&package.as_str());
        for name in PROGRAMS {
            assert!(!dependencies.contains(name), "{package} depends on the program {name}");
        }
        assert!(
            is_program || !dependencies.contains("eddy-cli"),
            "{package} depends on the command line"
        );
    }
}

#[test]
fn everything_but_the_laboratory_is_built_by_default() {
    let manifest = manifest(root());
    let built = manifest["workspace"]["default-members"].as_array().unwrap();
    let built: BTreeSet<_> =
        built.iter().map(|member| member.as_str().unwrap().to_owned()).collect();
    let folders = fs::read_dir(root().join("crates")).unwrap();
    let names = folders.map(|entry| entry.unwrap().file_name().into_string().unwrap());
    let others = names.filter(|name| !["lab", "plan"].contains(&name.as_str()));
    let all: BTreeSet<_> =
        others.map(|name| format!("crates/{name}")).chain([".".to_owned()]).collect();
    assert_eq!(built, all);
}

#[test]
fn parts_that_are_taken_alone_build_no_framework_and_no_middleware() {
    let all = dependencies();
    for (package, unwanted) in WITHOUT {
        for part in closure(package, &all) {
            for unwanted in unwanted {
                assert!(!all[&part].contains(*unwanted), "{package} builds {unwanted} with {part}");
            }
        }
    }
}

/// `a/{b,c}/d` as `a/b/d` and `a/c/d`.
fn alternatives(path: &str) -> Vec<String> {
    let braces = path.split_once('{').zip(path.split_once('}'));
    let Some(((before, rest), (_, after))) = braces else { return vec![path.to_owned()] };
    let names = rest.split('}').next().unwrap_or_default().split(',');
    names.map(|name| format!("{before}{name}{after}")).collect()
}

/// The pairs of a name and a path that a text has as "`NAME` in `PATH`", also several names of one path.
fn places(text: &str) -> Vec<(&str, &str)> {
    let parts: Vec<_> = text.split('`').collect();
    let mut places = Vec::new();
    let mut path = "";
    for code in (1..parts.len().saturating_sub(2)).step_by(2).rev() {
        path = match parts[code + 1] {
            " in " => parts[code + 2],
            " and " | ", " => path,
            _ => "",
        };
        if path.contains('/') && !parts[code].contains(['/', ' ']) {
            places.push((parts[code], path));
        }
    }
    places
}

/// Where other languages count or list the materials, which the compiler does not see.
#[test]
fn materials_are_listed_alike_in_every_language() {
    let count = Material::COUNT;
    let list =
        |entry: fn(Material) -> String, between: &str| Material::ALL.map(entry).join(between);
    let numbered = list(|material| format!("{} {}", material as u8, material.name()), ", ");
    let names = list(|material| format!("\"{}\"", material.name()), ", ");
    let named = list(|material| material.name().to_owned(), ", ").replace(", sand", " or sand");
    let constants = list(
        |material| format!("uint8 {}={}", material.name().to_uppercase(), material as u8),
        "\n",
    );
    for (file, text) in [
        ("msgs/eddy_msgs/msg/ParticleFrame.msg", constants),
        ("crates/node/src/viewer/page/painter.js", format!("uniform vec3 materials[{count}];")),
        ("crates/node/src/viewer/page/painter.js", format!("min(material, {}u)", count - 1)),
        ("python/src/frame.rs", numbered),
        ("python/src/frame.rs", format!("\"{named}\"")),
        ("src/cli/bag.rs", named),
        ("python/eddy/__init__.py", format!("({names})")),
        ("tests/peers/check_exports.py", format!("MATERIALS = [{names}]")),
    ] {
        let found = fs::read_to_string(root().join(file)).unwrap();
        assert!(found.contains(&text), "{file}: expected {text:?}");
    }
}

#[test]
fn what_a_guide_says_is_in_a_file_is_there() {
    let guides = GUIDES.iter().filter(|guide| guide.ends_with(".md"));
    let texts: Vec<_> =
        guides.map(|guide| (guide, fs::read_to_string(root().join(guide)).unwrap())).collect();
    let mut count = 0;
    for (guide, text) in &texts {
        for (name, path) in places(text) {
            let place = root().join(path);
            let files = if place.is_dir() { sources(&place) } else { vec![place] };
            let mut files = files.into_iter().map(|file| fs::read_to_string(file).unwrap());
            let last = name.rsplit("::").next().unwrap();
            assert!(files.any(|file| file.contains(last)), "{guide}: `{name}` is not in {path}");
            count += 1;
        }
    }
    assert!(count > 10, "found {count} names with a path, expected more");
}

#[test]
fn every_path_and_type_that_a_guide_names_exists() {
    let read = |file: PathBuf| fs::read_to_string(file).unwrap();
    let files = ["crates", "src"].iter().flat_map(|folder| sources(&root().join(folder)));
    let code: String = files.map(read).collect();
    let known: BTreeSet<_> = code.split(|c: char| !c.is_alphanumeric() && c != '_').collect();
    for guide in GUIDES {
        let text = read(root().join(guide));
        let is_picture = guide.ends_with(".svg");
        let code = if is_picture { text.replace(['<', '>'], " ") } else { spans(&text).join(" ") };
        let (mut paths, mut names) = (0, 0);
        for word in code.split_whitespace().map(|word| word.trim_end_matches([':', ',', '.', ';']))
        {
            let is_name = |part: &str| part.chars().all(|c| c.is_alphanumeric() || c == '_');
            let is_type = word.starts_with(char::is_uppercase)
                && word.contains(char::is_lowercase)
                && word.split("::").all(is_name);
            if word.split_once('/').is_some_and(|(folder, _)| FOLDERS.contains(&folder)) {
                for path in alternatives(word) {
                    assert!(root().join(&path).exists(), "{guide}: {path} does not exist");
                }
                paths += 1;
            } else if is_type && (!is_picture || word.contains("::")) {
                for name in word.split("::") {
                    assert!(
                        known.contains(name),
                        "{guide}: {name} of `{word}` is nowhere in the source"
                    );
                }
                names += 1;
            }
        }
        assert!(
            paths > 5 && names > 0,
            "{guide}: found {paths} paths and {names} names, expected more"
        );
    }
}
