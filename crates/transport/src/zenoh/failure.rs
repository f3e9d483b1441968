//! Errors of zenoh in words for its users: zenoh adds to each the line of its source that it comes from.

use std::fmt::Display;

use crate::{Link, TransportError, middleware};

/// How zenoh joins an error with its cause (`zenoh-result`, `ZError`).
const CAUSE: &str = " - Caused by ";

/// What an action on `link` failed for.
pub(super) fn error(link: &Link, action: &'static str, reason: &dyn Display) -> TransportError {
    middleware::error(link, action, &words(reason))
}

/// The error and its causes, without places in source files: `A at /path/to/file.rs:12. - Caused by B at ...` is `A: B`.
pub(super) fn words(reason: &dyn Display) -> String {
    let text = reason.to_string();
    let parts = text.split(CAUSE).map(|part| without_type(without_places(part).trim()).to_owned());
    let parts: Vec<_> = parts.filter(|part| !part.is_empty()).collect();
    parts.join(": ")
}

/// The text of an error of `validated_struct`, which zenoh prints as a value of Rust: `Str("unknown key")`.
fn without_type(text: &str) -> &str {
    text.strip_prefix("Str(\"").and_then(|text| text.strip_suffix("\")")).unwrap_or(text)
}

/// A text without each ` at FILE.rs:LINE`, and without the full stop at its end.
fn without_places(text: &str) -> String {
    const AT: &str = " at ";
    const SOURCE: &str = ".rs:";
    let (mut kept, mut rest) = (String::new(), text);
    while let Some((before, after)) = rest.split_once(AT) {
        kept.push_str(before);
        let file = after.split_once(SOURCE).filter(|(file, _)| !file.contains(' '));
        match file {
            Some((_, line)) => rest = line.trim_start_matches(|c: char| c.is_ascii_digit()),
            None => {
                kept.push_str(AT);
                rest = after;
            }
        }
    }
    kept.push_str(rest);
    kept.trim_end().trim_end_matches('.').to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_in_source_files_are_left_out_and_causes_are_kept() {
        for (text, expected) in [
            (
                "Unknown key at /home/a/.cargo/registry/src/i-1/zenoh-config-1.10.2/src/lib.rs:7.",
                "Unknown key",
            ),
            ("A at /a/b.rs:1. - Caused by B at tcp at C:\\\\d.rs:22.", "A: B at tcp"),
            ("Str(\"unknown key\") at /a.rs:2.", "unknown key"),
            ("no place", "no place"),
            ("meet at noon", "meet at noon"),
            ("[a at /b.rs:3., c at /d.rs:4.]", "[a., c.]"),
        ] {
            assert_eq!(words(&text), expected, "{text}");
        }
    }

    #[test]
    fn errors_of_zenoh_itself_name_no_source_file() {
        let mut config = zenoh::Config::default();
        for (key, value) in
            [("yeees", "1"), ("mode", "\"pear\""), ("mode", "peer"), ("listen/endpoints", "[1]")]
        {
            let error = config.insert_json5(key, value).unwrap_err();
            let words = words(&error);
            assert!(!words.is_empty() && !words.contains(".rs"), "{words}");
            assert!(!words.contains("Str("), "{words}");
        }
        let error = zenoh::Config::from_file("/nowhere.json5").unwrap_err();
        assert!(!words(&error).contains(".rs"), "{}", words(&error));
    }
}
