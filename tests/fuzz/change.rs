//! Changes inputs as libFuzzer does, without its knowledge of which code they reach.

use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

/// Numbers at which code errs.
const EDGES: [u64; 14] = [
    0,
    1,
    2,
    7,
    8,
    0x7f,
    0x80,
    0xff,
    0x7fff,
    0xffff,
    0x7fff_ffff,
    0xffff_ffff,
    0x7fff_ffff_ffff_ffff,
    u64::MAX,
];

/// How MCAP files begin.
const MAGIC: &[u8] = b"\x89MCAP0\r\n";

/// Makes inputs of inputs.
pub struct Changer {
    random: ChaCha8Rng,
    corpus: Vec<Vec<u8>>,
}

impl Changer {
    pub fn new(seed: u64, corpus: Vec<Vec<u8>>) -> Self {
        Self { random: ChaCha8Rng::seed_from_u64(seed), corpus }
    }

    /// An input of the corpus with some changes.
    pub fn next(&mut self, longest: usize) -> Vec<u8> {
        let mut input = self.some_input().to_vec();
        for _ in 0..1 << self.random.random_range(0..5) {
            self.change(&mut input);
        }
        input.truncate(longest);
        input
    }

    fn some_input(&mut self) -> &[u8] {
        let which = self.random.random_range(0..self.corpus.len());
        &self.corpus[which]
    }

    fn change(&mut self, input: &mut Vec<u8>) {
        if input.is_empty() {
            input.push(self.random.random());
            return;
        }
        let at = self.random.random_range(0..input.len());
        let length = self.random.random_range(1..=(input.len() - at).min(64));
        match self.random.random_range(0..10) {
            0 => input[at] ^= 1 << self.random.random_range(0..8),
            1 => input[at] = self.random.random(),
            2 | 3 => self.overwrite(input, at),
            4 => drop(input.drain(at..at + length)),
            5 => {
                let piece = input[at..at + length].to_vec();
                let into = self.random.random_range(0..=input.len());
                drop(input.splice(into..into, piece));
            }
            6 => input.truncate(at),
            7 => {
                let filling: u8 = self.random.random();
                input[at..at + length].fill(filling);
            }
            8 => self.double_record(input),
            _ => {
                let other = self.some_input().to_vec();
                let from = self.random.random_range(0..=other.len());
                input.truncate(at);
                input.extend_from_slice(&other[from..]);
            }
        }
    }

    /// Says something twice: copies a record of an MCAP file to the start of another one, half of the time with another byte.
    fn double_record(&mut self, input: &mut Vec<u8>) {
        let mut starts = vec![MAGIC.len()];
        while input.starts_with(MAGIC)
            && let Some(&start) = starts.last()
            && let Some(length) = input.get(start + 1..start + 9)
            && let Ok(length) = length.try_into().map(u64::from_le_bytes)
            && let Some(end) = (start as u64 + 9).checked_add(length)
            && end <= input.len() as u64
        {
            starts.push(end as usize);
        }
        let Some(last) = starts.len().checked_sub(2) else { return };
        let which = self.random.random_range(0..=last);
        let mut record = input[starts[which]..starts[which + 1]].to_vec();
        if self.random.random_bool(0.5) && record.len() > 9 {
            let at = self.random.random_range(9..record.len());
            record[at] = self.random.random();
        }
        let into = starts[self.random.random_range(0..=last)];
        drop(input.splice(into..into, record));
    }

    /// Puts a number at which code errs where a number may be.
    fn overwrite(&mut self, input: &mut [u8], at: usize) {
        let mut number = EDGES[self.random.random_range(0..EDGES.len())];
        if self.random.random_bool(0.3) {
            number = (input.len() as u64 + self.random.random_range(0..16)).wrapping_sub(8);
        }
        let width = [1, 2, 4, 8][self.random.random_range(0..4)].min(input.len() - at);
        input[at..at + width].copy_from_slice(&number.to_le_bytes()[..width]);
    }
}
