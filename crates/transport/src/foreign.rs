//! What other programs may make this one read, without the middleware that brings it: for fuzzing.

use super::zenoh::attachment::Attachment;
use super::zenoh::keys::{topic_in, type_in};
use super::{Link, shm::layout};
use eddy_messages::{FrameCdr, cdr};

/// Reads a sample of a topic of frames as it lies in shared memory.
pub fn shm_sample(bits: &[u8]) {
    let (header, particles) = layout::from_bits(bits);
    let message = cdr::encode(&layout::message(&header, &particles));
    match layout::frame(&header, &particles) {
        Ok(frame) => {
            frame.check().expect("a frame that is handed on is whole");
            assert_eq!(frame.to_cdr(), message, "both readings of a sample are the same");
        }
        // Then it is handed on as it is, for the node to refuse.
        Err(_) => drop(eddy_frames::Frame::from_cdr(&message)),
    }
}

/// Reads an attachment.
pub fn attachment(bytes: &[u8]) {
    if let Some(attachment) = Attachment::parse(bytes) {
        assert_eq!(attachment.to_bytes(), bytes, "an attachment has one form");
    }
}

/// Reads the token of an endpoint, and a link as users write it.
pub fn names(text: &str) {
    let _ = (type_in(text), topic_in(text));
    if let Ok(link) = text.parse::<Link>() {
        let again: Link = link.to_string().parse().expect("a link is written as it is read");
        assert_eq!(again, link);
    }
}
