//! Suggestions for misspelt names.

use std::{fs, io, path::Path};

use toml::{Table, Value};

/// Minimum Jaro similarity (0 to 1) of a suggestion, as in clap.
const MIN_SIMILARITY: f64 = 0.7;

/// The most similar candidate, if one is similar enough.
pub fn nearest<'a>(word: &str, candidates: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    nearest_by(word, candidates, strsim::jaro)
}

fn nearest_by<'a>(
    word: &str,
    candidates: impl IntoIterator<Item = &'a str>,
    similarity: impl Fn(&str, &str) -> f64,
) -> Option<&'a str> {
    candidates
        .into_iter()
        .filter(|candidate| *candidate != word)
        .map(|candidate| (similarity(word, candidate), candidate))
        .filter(|(similarity, _)| *similarity > MIN_SIMILARITY)
        .max_by(|(a, _), (b, _)| a.total_cmp(b))
        .map(|(_, candidate)| candidate)
}

/// Similarity of file names. A common extension makes names no more similar: all files of a folder may have it.
fn of_names(one: &str, other: &str) -> f64 {
    let [one, other] = [one, other].map(Path::new);
    let stem = |name: &Path| name.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    if one.extension() == other.extension() {
        strsim::jaro(&stem(one), &stem(other))
    } else {
        strsim::jaro(&one.to_string_lossy(), &other.to_string_lossy())
    }
}

/// The end of an error message: `; did you mean NAME?`, or nothing.
pub fn hint<'a>(word: &str, candidates: impl IntoIterator<Item = &'a str>) -> String {
    nearest(word, candidates).map(question).unwrap_or_default()
}

fn question(name: &str) -> String {
    format!("; did you mean {name}?")
}

/// A message of the TOML parser about an unknown key or word, with a suggestion.
pub fn in_toml(reason: &str) -> String {
    // serde: "unknown field `a`, expected one of `b`, `c`" (also "unknown variant").
    let meant = reason.lines().find(|line| line.contains("unknown ")).and_then(|line| {
        let (_, words) = line.split_once("unknown ")?;
        let mut names = words.split('`').skip(1).step_by(2);
        nearest(names.next()?, names)
    });
    format!("{reason}{}", meant.map(question).unwrap_or_default())
}

/// A message of the TOML parser about an unknown key, with the table that has it: `gravity` is `solver.gravity`.
pub(crate) fn in_tables(reason: String, tables: &Table) -> String {
    let word = reason.split_once("unknown field `").and_then(|(_, rest)| rest.split('`').next());
    let has = |value: &Value, word| value.as_table().is_some_and(|table| table.contains_key(word));
    let meant = word.and_then(|word| {
        let (table, _) = tables.iter().find(|(_, value)| has(value, word))?;
        Some(format!("{table}.{word}"))
    });
    match meant {
        Some(meant) => format!("{reason}{}", question(&meant)),
        None => reason,
    }
}

/// An error of the system for a path; if it does not exist, with a suggestion.
pub fn in_folder(path: &Path, error: io::Error) -> io::Error {
    if error.kind() != io::ErrorKind::NotFound {
        return error;
    }
    match neighbour(path) {
        Some(meant) => io::Error::new(error.kind(), format!("{error}{}", question(&meant))),
        None => error,
    }
}

/// The existing name most similar to the first missing part of the path.
fn neighbour(path: &Path) -> Option<String> {
    let gone = |part: &&Path| !part.as_os_str().is_empty() && !part.exists();
    let missing = path.ancestors().take_while(gone).last()?;
    let folder = missing.parent()?;
    let inside = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
    let mut names: Vec<String> = fs::read_dir(inside)
        .ok()?
        .filter_map(|entry| entry.ok()?.file_name().into_string().ok())
        .collect();
    names.sort();
    let names = names.iter().map(String::as_str);
    let name = nearest_by(missing.file_name()?.to_str()?, names, of_names)?;
    Some(folder.join(name).display().to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_most_similar_name_is_suggested_unless_all_differ() {
        let transports = ["memory", "shm", "zenoh", "dds"];
        assert_eq!(nearest("zneoh", transports), Some("zenoh"));
        assert_eq!(nearest("sbm", transports), Some("shm"));
        assert_eq!(nearest("tcp", transports), None);
        assert_eq!(hint("/partcles", ["/prediction", "/particles"]), "; did you mean /particles?");
        assert_eq!(hint("xyz", ["/prediction", "/particles"]), "");
    }

    #[test]
    fn messages_of_the_toml_parser_get_a_suggestion() {
        let said = "TOML parse error at line 1\n  |\nunknown field `epoch`, expected one of `core`, `epochs`\n";
        assert_eq!(in_toml(said), format!("{said}; did you mean epochs?"));
        assert_eq!(
            in_toml("unknown field `abc`, expected `xyz`"),
            "unknown field `abc`, expected `xyz`"
        );
        assert_eq!(in_toml("missing field `abc`"), "missing field `abc`");
    }

    #[test]
    fn a_missing_path_gets_a_suggestion() {
        let folder = tempfile::tempdir().unwrap();
        let there = folder.path().join("scenes");
        fs::create_dir(&there).unwrap();
        let missing = || io::Error::from(io::ErrorKind::NotFound);
        let said = in_folder(&folder.path().join("scnes/model.toml"), missing());
        assert_eq!(said.kind(), io::ErrorKind::NotFound);
        assert!(
            said.to_string().ends_with(&format!("; did you mean {}?", there.display())),
            "{said}"
        );
        let alone = in_folder(&folder.path().join("other"), missing());
        assert_eq!(alone.to_string(), missing().to_string());
        fs::write(folder.path().join("pool.toml"), "").unwrap();
        let far = in_folder(&folder.path().join("nofile.toml"), missing());
        assert_eq!(far.to_string(), missing().to_string(), "only the extension is the same");
        let near = in_folder(&folder.path().join("pol.toml"), missing());
        assert!(near.to_string().ends_with("pool.toml?"), "{near}");
        let locked = in_folder(&there, io::Error::from(io::ErrorKind::PermissionDenied));
        assert_eq!(locked.kind(), io::ErrorKind::PermissionDenied);
    }
}
