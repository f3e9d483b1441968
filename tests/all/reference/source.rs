//! Parses the structs and enums of settings from the source: fields, types, variants, docs.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
};

use super::root;

/// A struct, or an enum whose variants are words in files.
#[derive(Debug, Default)]
pub struct Item {
    /// Its docs, in one line.
    pub docs: String,
    /// Whether it is an enum.
    pub is_enum: bool,
    /// Its fields or variants, with their names in files.
    pub members: Vec<Member>,
}

impl Item {
    /// The item without a member.
    pub fn without(&self, name: &str) -> Self {
        let members = self.members.iter().filter(|member| member.name != name);
        Self { docs: self.docs.clone(), is_enum: self.is_enum, members: members.cloned().collect() }
    }
}

/// A field, or a variant.
#[derive(Clone, Debug, Default)]
pub struct Member {
    /// The key or word in files.
    pub name: String,
    /// Its docs, in one line.
    pub docs: String,
    /// The type of a field; empty for a variant.
    pub kind: String,
    /// Fields of a struct-like variant.
    pub fields: Vec<Self>,
}

/// The items of source files by name.
pub struct Source(BTreeMap<String, Item>);

impl Source {
    /// Reads files, and all in folders, given by their path from the root of the workspace.
    pub fn of(paths: &[&str]) -> Self {
        let mut items = BTreeMap::new();
        let mut open: BTreeSet<_> = paths.iter().map(|path| root().join(path)).collect();
        while let Some(path) = open.pop_first() {
            if path.is_dir() {
                open.extend(fs::read_dir(path).unwrap().map(|entry| entry.unwrap().path()));
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                read(&fs::read_to_string(path).unwrap(), &mut items);
            }
        }
        Self(items)
    }

    /// The item of this name.
    pub fn item(&self, name: &str) -> &Item {
        self.0.get(name).unwrap_or_else(|| panic!("no struct or enum {name} was read"))
    }

    /// The item in a field, directly, in an `Option` or in a list; `None` if it was not read.
    pub fn held(&self, kind: &str) -> Option<&Item> {
        self.0.get(bare(kind))
    }
}

/// A type without surrounding `Option` and `Vec`.
pub fn bare(kind: &str) -> &str {
    let inside =
        ["Option<", "Vec<"].iter().find_map(|wrap| kind.strip_prefix(wrap)?.strip_suffix('>'));
    inside.map_or(kind, bare)
}

/// Whether a field holds a list of items.
pub fn is_list(kind: &str) -> bool {
    kind.starts_with("Vec<")
}

/// Docs and attributes above an item or a member.
#[derive(Default)]
struct Above {
    docs: Vec<String>,
    attributes: String,
}

impl Above {
    /// Takes a line of docs or attributes; returns whether it was one.
    fn takes(&mut self, line: &str) -> bool {
        if let Some(doc) = line.strip_prefix("///") {
            self.docs.push(doc.trim().to_owned());
        } else if line.starts_with("#[") || self.is_open() {
            self.attributes.push_str(line);
        } else {
            return false;
        }
        true
    }

    /// Whether an attribute continues on the next line.
    fn is_open(&self) -> bool {
        self.attributes.matches('[').count() > self.attributes.matches(']').count()
    }

    fn docs(&self) -> String {
        self.docs.join(" ").trim().to_owned()
    }

    fn argument(&self, name: &str) -> Option<&str> {
        let (_, rest) = self.attributes.split_once(&format!("{name} = \""))?;
        rest.split('"').next()
    }
}

fn read(text: &str, items: &mut BTreeMap<String, Item>) {
    let mut above = Above::default();
    let mut lines = text.lines();
    while let Some(line) = lines.next() {
        if above.takes(line) {
            continue;
        }
        let words: Vec<_> = line.split_whitespace().collect();
        let declared = words.iter().position(|word| ["struct", "enum"].contains(word));
        if let Some(at) = declared.filter(|_| line.ends_with('{') && !line.starts_with(' ')) {
            let is_enum = words[at] == "enum";
            let style = above.argument("rename_all").unwrap_or_default().to_owned();
            let item =
                Item { docs: above.docs(), is_enum, members: members(&mut lines, is_enum, &style) };
            let name = words[at + 1].split('<').next().unwrap_or_default();
            items.insert(name.to_owned(), item);
        }
        above = Above::default();
    }
}

/// Parses the members up to the closing brace.
fn members<'a>(
    lines: &mut impl Iterator<Item = &'a str>,
    variants: bool,
    style: &str,
) -> Vec<Member> {
    let mut members = Vec::new();
    let mut above = Above::default();
    while let Some(line) = lines.next().map(str::trim) {
        if above.takes(line) {
            continue;
        }
        if line.starts_with('}') {
            break;
        }
        let above = std::mem::take(&mut above);
        let (written, kind) = match line.trim_end_matches(',').split_once(": ") {
            Some((name, kind)) if !variants => (name, kind),
            _ => {
                (line.trim_end_matches([',', ' ', '{']).split(" = ").next().unwrap_or_default(), "")
            }
        };
        let name = written.split_whitespace().last().unwrap_or_default();
        let (name, _) = name.split_once('(').unwrap_or((name, ""));
        let name = above.argument("rename").map_or_else(|| styled(name, style), str::to_owned);
        let fields = if variants && line.ends_with('{') {
            self::members(lines, false, "")
        } else {
            Vec::new()
        };
        members.push(Member { name, docs: above.docs(), kind: kind.to_owned(), fields });
    }
    members
}

fn styled(name: &str, style: &str) -> String {
    match style {
        "lowercase" => name.to_lowercase(),
        "kebab-case" | "snake_case" => {
            let between = if style == "kebab-case" { "-" } else { "_" };
            let word = |(at, c): (usize, char)| {
                let gap = if at > 0 && c.is_uppercase() { between } else { "" };
                format!("{gap}{}", c.to_lowercase())
            };
            name.chars().enumerate().map(word).collect()
        }
        _ => name.to_owned(),
    }
}

#[test]
fn structs_and_enums_are_read_as_files_have_them() {
    let text = "\
/// A thing
/// of two lines.
#[derive(A)]
#[serde(
    default
)]
pub struct Thing {
    /// A list.
    #[serde(default)]
    pub parts: Vec<Part>,
}

#[serde(rename_all = \"kebab-case\")]
enum Part {
    /// One.
    OneWord,
    #[serde(rename = \"a+b\")]
    Both = 1,
    /// With more.
    Disc {
        /// Radius.
        radius: f32,
    },
}
";
    let mut items = BTreeMap::new();
    read(text, &mut items);
    let (thing, part) = (&items["Thing"], &items["Part"]);
    assert_eq!(thing.docs, "A thing of two lines.");
    assert_eq!(
        (thing.members[0].name.as_str(), thing.members[0].kind.as_str()),
        ("parts", "Vec<Part>")
    );
    assert_eq!(
        part.members.iter().map(|word| word.name.as_str()).collect::<Vec<_>>(),
        ["one-word", "a+b", "disc"]
    );
    assert_eq!(part.members[2].fields[0].name, "radius");
    assert_eq!(styled("OneWord", "snake_case"), "one_word");
    assert_eq!(bare("Option<Vec<Part>>"), "Part");
}
