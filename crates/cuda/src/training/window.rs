//! Pieces of streams.

use crate::{device::count, kernels::common};

/// A piece of a stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Window {
    /// The stream's number in the store.
    pub stream: usize,
    /// Its first frame.
    pub start: usize,
    /// Whether left and right are exchanged.
    pub mirrored: bool,
    /// Seed of ChaCha8 (32 bytes) for the noise on the last observed frame; none without noise.
    pub noise: Option<[u8; 32]>,
}

impl Window {
    /// As the kernels have it, where its bodies begin with number `first`.
    pub(super) fn on_device(&self, first: u64) -> common::Window {
        common::Window {
            first,
            stream: count(self.stream),
            mirrored: u32::from(self.mirrored),
            disturbed: u32::from(self.noise.is_some()),
            unused: 0,
            key: self.noise.map(key).unwrap_or_default(),
        }
    }
}

/// A seed as words.
pub(crate) fn key(seed: [u8; 32]) -> [u32; 8] {
    std::array::from_fn(|word| {
        u32::from_le_bytes(std::array::from_fn(|byte| seed[4 * word + byte]))
    })
}
