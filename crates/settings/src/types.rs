//! What serde says of a value of the wrong type, in the words of a settings file.

/// How serde begins, and ends the value that it has found.
const BEGINNINGS: [&str; 2] = ["invalid type: ", "invalid value: "];
const EXPECTED: &str = ", expected ";

/// Kinds of values, as serde names what it has found; a value in backquotes or quotation marks follows some of them.
const FOUND: [(&str, &str); 8] = [
    ("string ", ""),
    ("integer ", ""),
    ("floating point ", ""),
    ("boolean ", ""),
    ("sequence", "a list"),
    ("map", "a table"),
    ("null", "nothing"),
    ("unit value", "nothing"),
];

/// Types, as Rust names them.
const TYPES: [(&str, &str); 16] = [
    ("u8", "a whole number from 0"),
    ("u16", "a whole number from 0"),
    ("u32", "a whole number from 0"),
    ("u64", "a whole number from 0"),
    ("usize", "a whole number from 0"),
    ("a nonzero", "a whole number from 1"),
    ("i8", "a whole number"),
    ("i16", "a whole number"),
    ("i32", "a whole number"),
    ("i64", "a whole number"),
    ("f32", "a number"),
    ("f64", "a number"),
    ("a boolean", "true or false"),
    ("a sequence", "a list"),
    ("a map", "a table"),
    ("a string", "text"),
];

/// The message with what was found and expected in plain words; other messages as they are.
pub fn in_words(message: &str) -> String {
    let begins = BEGINNINGS.iter().find_map(|mark| Some((message.find(mark)?, mark.len())));
    let Some((start, mark)) = begins else { return message.to_owned() };
    let (before, rest) = (&message[..start], &message[start + mark..]);
    let Some((value, expected)) = rest.split_once(EXPECTED) else { return message.to_owned() };
    let found = FOUND.iter().find_map(|(serde, words)| {
        Some(format!("{words}{}", value.strip_prefix(serde)?.trim_matches('`')))
    });
    let wanted = TYPES.iter().find_map(|(rust, words)| {
        let after = expected.strip_prefix(rust)?;
        let ends = !after.starts_with(|c: char| c.is_ascii_alphanumeric());
        ends.then(|| format!("{words}{after}"))
    });
    let found = found.unwrap_or_else(|| value.to_owned());
    let wanted = wanted.unwrap_or_else(|| expected.to_owned());
    format!("{before}found {found}{EXPECTED}{wanted}")
}

#[cfg(test)]
mod tests {
    use super::in_words;

    #[test]
    fn types_of_rust_are_said_in_words() {
        for (serde, words) in [
            (
                "invalid type: sequence, expected f32 in `dt`",
                "found a list, expected a number in `dt`",
            ),
            (
                "epochs: invalid type: string \"many\", expected u32",
                "epochs: found \"many\", expected a whole number from 0",
            ),
            (
                "invalid value: integer `-1`, expected usize",
                "found -1, expected a whole number from 0",
            ),
            ("invalid type: map, expected a sequence", "found a table, expected a list"),
            (
                "invalid type: floating point `1.5`, expected u64\nin `seed`",
                "found 1.5, expected a whole number from 0\nin `seed`",
            ),
            ("unknown field `epoch`", "unknown field `epoch`"),
        ] {
            assert_eq!(in_words(serde), words);
        }
    }
}
