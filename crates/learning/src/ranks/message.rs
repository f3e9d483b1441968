//! Messages between processes: a length of four bytes, little-endian, and as many bytes of TOML.

use std::io::{self, Read, Write};

use serde::{Deserialize, Serialize};

/// Largest length of a message (bytes). A greeting has all settings of a run, some kilobytes.
const LARGEST: u32 = 1 << 20;

/// A message.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "message", rename_all = "snake_case", deny_unknown_fields)]
pub(super) enum Message {
    /// The first one to rank 0: who connects, and what it is about to train.
    Hello { rank: usize, name: String, facts: Vec<(String, String)> },
    /// Rank 0's answer when all are there: its name.
    Welcome { name: String },
    /// Rank 0's answer when the processes do not fit together.
    Refused { reason: String },
    /// A sign of life.
    Alive,
    /// What rank 0 decides.
    Word { word: String },
    /// Another process asks rank 0 to stop.
    Stop,
    /// The sender ends with an error.
    Failed { reason: String },
    /// Rank 0 knows that another process was lost, or why it ended.
    Gone { who: String, reason: Option<String> },
    /// The sender has come to the end of the run.
    Bye,
}

impl Message {
    pub(super) fn send(&self, to: &mut impl Write) -> io::Result<()> {
        let text = toml::to_string(self).map_err(io::Error::other)?;
        let length = u32::try_from(text.len()).map_err(io::Error::other)?;
        // In one piece: a message of one packet.
        let mut bytes = length.to_le_bytes().to_vec();
        bytes.extend(text.as_bytes());
        to.write_all(&bytes)
    }

    /// The next message; an error of kind `InvalidData` if it is not one.
    pub(super) fn receive(from: &mut impl Read) -> io::Result<Self> {
        let mut length = [0; 4];
        from.read_exact(&mut length)?;
        let length = u32::from_le_bytes(length);
        let invalid = |reason: String| io::Error::new(io::ErrorKind::InvalidData, reason);
        if length > LARGEST {
            return Err(invalid(format!(
                "found a message of {length} bytes, expected at most {LARGEST}"
            )));
        }
        let mut bytes = vec![0; length as usize];
        from.read_exact(&mut bytes)?;
        let text = str::from_utf8(&bytes).map_err(|error| invalid(error.to_string()))?;
        toml::from_str(text).map_err(|error| invalid(error.message().to_owned()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_arrive_as_they_were_sent() {
        let facts = vec![("data".to_owned(), "a \"quoted\"\nvalue".to_owned())];
        let messages = [
            Message::Hello { rank: 3, name: "host, process 7".to_owned(), facts },
            Message::Welcome { name: "host, process 6".to_owned() },
            Message::Alive,
            Message::Word { word: "go".to_owned() },
            Message::Gone { who: "rank 1".to_owned(), reason: None },
            Message::Bye,
        ];
        let mut bytes = Vec::new();
        messages.iter().for_each(|message| message.send(&mut bytes).unwrap());
        let mut rest = bytes.as_slice();
        for message in messages {
            assert_eq!(Message::receive(&mut rest).unwrap(), message);
        }
        assert_eq!(Message::receive(&mut rest).unwrap_err().kind(), io::ErrorKind::UnexpectedEof);
    }

    #[test]
    fn what_is_not_a_message_is_rejected() {
        for bytes in [&b"GET / HTTP/1.1\r\n\r\n"[..], b"\x03\0\0\0abc", b"\x01\0\0\0\xff"] {
            let error = Message::receive(&mut &*bytes).unwrap_err();
            assert_eq!(error.kind(), io::ErrorKind::InvalidData, "{bytes:?}");
        }
    }
}
