//! The streams that a network was trained on, as its description lists them.

use base64::{Engine, prelude::BASE64_STANDARD};
use serde::{Deserialize, Serialize};

/// Digits of a fingerprint, hexadecimal: eight bytes.
const DIGITS: usize = 16;

/// Fingerprints of streams (`Trajectory::fingerprint`).
///
/// In a file they are one text, the eight bytes of each in base64: half the size of a list of hexadecimal texts, as which older files
/// hold them. Read from a list, they are written as a list again, so that a checkpoint keeps its digest.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(try_from = "Written", into = "Written")]
pub struct Fingerprints {
    streams: Vec<String>,
    listed: bool,
}

/// Of the same streams, whether listed or not.
impl PartialEq for Fingerprints {
    fn eq(&self, other: &Self) -> bool {
        self.streams == other.streams
    }
}

/// What is in the file.
#[derive(Serialize, Deserialize)]
#[serde(untagged, expecting = "expected base64, or a list of texts")]
enum Written {
    Packed(String),
    List(Vec<String>),
}

impl Fingerprints {
    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.streams.is_empty()
    }

    /// Each, hexadecimal.
    pub fn iter(&self) -> impl Iterator<Item = &str> {
        self.streams.iter().map(String::as_str)
    }

    /// Whether a stream is one of them.
    pub fn contains(&self, stream: &str) -> bool {
        self.iter().any(|known| known == stream)
    }
}

impl FromIterator<String> for Fingerprints {
    fn from_iter<T: IntoIterator<Item = String>>(streams: T) -> Self {
        Self { streams: streams.into_iter().collect(), listed: false }
    }
}

fn hexadecimal(fingerprint: u64) -> String {
    format!("{fingerprint:0DIGITS$x}")
}

impl TryFrom<Written> for Fingerprints {
    type Error = String;

    fn try_from(written: Written) -> Result<Self, String> {
        let text = match written {
            Written::List(streams) => return Ok(Self { streams, listed: true }),
            Written::Packed(text) => text,
        };
        let bytes = BASE64_STANDARD.decode(text);
        let bytes = bytes.map_err(|error| format!("expected base64: {error}"))?;
        let (streams, rest) = bytes.as_chunks();
        if !rest.is_empty() {
            let found = bytes.len();
            return Err(format!("found {found} bytes, expected eight for each stream"));
        }
        Ok(streams.iter().map(|stream| hexadecimal(u64::from_be_bytes(*stream))).collect())
    }
}

impl From<Fingerprints> for Written {
    fn from(Fingerprints { streams, listed }: Fingerprints) -> Self {
        // Those that are read again as the same text.
        let number = |stream: &String| {
            let number = u64::from_str_radix(stream, 16).ok();
            number.filter(|number| hexadecimal(*number) == *stream)
        };
        match streams.iter().map(number).collect::<Option<Vec<_>>>() {
            Some(numbers) if !listed => {
                let bytes: Vec<u8> = numbers.into_iter().flat_map(u64::to_be_bytes).collect();
                Self::Packed(BASE64_STANDARD.encode(bytes))
            }
            _ => Self::List(streams),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, PartialEq, Serialize, Deserialize)]
    struct File {
        seen: Fingerprints,
    }

    fn of(streams: &[&str]) -> Fingerprints {
        streams.iter().map(|&stream| stream.to_owned()).collect()
    }

    #[test]
    fn they_are_written_as_base64_and_read_again() {
        let file = File { seen: of(&["0123456789abcdef", "00000000000000ff"]) };
        let text = toml::to_string(&file).unwrap();
        assert_eq!(text, "seen = \"ASNFZ4mrze8AAAAAAAAA/w==\"\n");
        assert_eq!(toml::from_str::<File>(&text).unwrap(), file);
        assert!(file.seen.contains("00000000000000ff") && !file.seen.contains("ff"));
    }

    #[test]
    fn a_list_stays_a_list() {
        let text = "seen = [\"0123456789abcdef\"]\n";
        let file: File = toml::from_str(text).unwrap();
        assert_eq!(file.seen.iter().collect::<Vec<_>>(), ["0123456789abcdef"]);
        assert_eq!(toml::to_string(&file).unwrap(), text);
    }

    #[test]
    fn damaged_text_is_rejected() {
        for (text, part) in [("ASNF*", "expected base64"), ("ASNFZ4mr", "found 6 bytes")] {
            let error = toml::from_str::<File>(&format!("seen = {text:?}")).unwrap_err();
            assert!(error.to_string().contains(part), "{error}");
        }
    }
}
