//! Parsers of data from other programs, without the middlewares: for fuzzing.

use super::zenoh::attachment::Attachment;
use super::zenoh::keys::{topic_in, type_in};
use super::{Link, shm::layout};
use eddy_messages::{FrameCdr, cdr};

/// Reads a sample of a topic of frames in shared memory.
pub fn shm_sample(bits: &[u8]) {
    sample::<2>(bits);
    sample::<3>(bits);
}

fn sample<const D: usize>(bits: &[u8]) {
    let (header, particles) = layout::from_bits::<D>(bits);
    let message = cdr::encode(&layout::message(&header, &particles));
    match layout::frame(&header, &particles) {
        Ok(frame) => {
            frame.check().expect("a frame that is passed on is valid");
            assert_eq!(frame.to_cdr(), message, "both conversions of a sample agree");
        }
        // Passed on as bytes; the node rejects it.
        Err(_) => drop(eddy_frames::AnyFrame::from_cdr(&message)),
    }
}

/// Reads an attachment.
pub fn attachment(bytes: &[u8]) {
    if let Some(attachment) = Attachment::parse(bytes) {
        assert_eq!(attachment.to_bytes(), bytes, "an attachment has one encoding");
    }
}

/// Parses the token of an endpoint, and a link.
pub fn names(text: &str) {
    let _ = (type_in(text), topic_in(text));
    if let Ok(link) = text.parse::<Link>() {
        let again: Link = link.to_string().parse().expect("the text of a link is a link");
        assert_eq!(again, link);
    }
}
