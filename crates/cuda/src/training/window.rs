//! Pieces of streams.

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

/// Numbers of `struct Window` of the kernels.
pub(super) const WORDS: usize = 14;

impl Window {
    /// As the kernels have it, where its bodies begin with number `first`.
    pub(super) fn words(&self, first: u64) -> [u32; WORDS] {
        let mut words = [0; WORDS];
        words[0] = first as u32;
        words[1] = (first >> 32) as u32;
        words[2] = self.stream as u32;
        words[3] = u32::from(self.mirrored);
        if let Some(seed) = self.noise {
            words[4] = 1;
            words[6..].copy_from_slice(&key(seed));
        }
        words
    }
}

/// A seed as words.
pub(crate) fn key(seed: [u8; 32]) -> [u32; 8] {
    std::array::from_fn(|word| {
        u32::from_le_bytes(std::array::from_fn(|byte| seed[4 * word + byte]))
    })
}
