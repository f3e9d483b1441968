//! Reads a file in pieces: one request for many small reads.

use std::io::{self, Read, Seek, SeekFrom};

use super::File;

/// Size of the first piece (bytes): the summary of most bags, in one request.
const FIRST: u64 = 256 << 10;
/// Size of the largest piece (bytes).
const LARGEST: u64 = 8 << 20;

/// A reader that keeps the last two pieces: the start of a file and its summary are read in turns. Pieces that follow each other
/// double in size.
#[derive(Debug)]
pub(crate) struct Pieces {
    file: File,
    position: u64,
    /// The one that was read last comes first.
    pieces: [Piece; 2],
}

#[derive(Debug, Default)]
struct Piece {
    /// Where it begins (bytes).
    start: u64,
    bytes: Vec<u8>,
}

impl Piece {
    fn end(&self) -> u64 {
        self.start + self.bytes.len() as u64
    }

    fn contains(&self, position: u64) -> bool {
        (self.start..self.end()).contains(&position)
    }
}

impl Pieces {
    pub(crate) fn of(file: File) -> Self {
        Self { file, position: 0, pieces: Default::default() }
    }

    /// The piece at the position, which is before the end of the file.
    fn piece(&mut self) -> io::Result<&Piece> {
        let at = self.pieces.iter().position(|piece| piece.contains(self.position));
        if let Some(at) = at {
            self.pieces[..=at].rotate_right(1);
            return Ok(&self.pieces[0]);
        }
        let (size, [last, _]) = (self.file.size(), &self.pieces);
        let (start, length) = if !last.bytes.is_empty() && self.position == last.end() {
            (self.position, (2 * last.bytes.len() as u64).min(LARGEST))
        } else {
            // The last piece of a file is as large as the others.
            (self.position.min(size.saturating_sub(FIRST)), FIRST)
        };
        let bytes = self.file.read(start, length.min(size - start))?;
        self.pieces.rotate_right(1);
        self.pieces[0] = Piece { start, bytes };
        Ok(&self.pieces[0])
    }
}

impl Read for Pieces {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        if self.position >= self.file.size() || into.is_empty() {
            return Ok(0);
        }
        let position = self.position;
        let piece = self.piece()?;
        let rest = &piece.bytes[(position - piece.start) as usize..];
        let length = rest.len().min(into.len());
        into[..length].copy_from_slice(&rest[..length]);
        self.position += length as u64;
        Ok(length)
    }
}

impl Seek for Pieces {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        let moved = match to {
            SeekFrom::Start(position) => Some(position),
            SeekFrom::End(offset) => self.file.size().checked_add_signed(offset),
            SeekFrom::Current(offset) => self.position.checked_add_signed(offset),
        };
        self.position = moved.ok_or(io::ErrorKind::InvalidInput)?;
        Ok(self.position)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn pieces_are_the_bytes_of_the_file(
            size in 0usize..3_000_000,
            reads in prop::collection::vec((0u64..3_200_000, 0usize..600_000, any::<bool>()), 1..20),
        ) {
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join("file");
            let bytes: Vec<u8> = (0..size).map(|k| (k * 31 % 251) as u8).collect();
            std::fs::write(&path, &bytes).unwrap();
            let mut pieces = Pieces::of(File::open(&path).unwrap());
            let mut position = 0;
            for (to, length, moves) in reads {
                if moves {
                    position = pieces.seek(SeekFrom::Start(to)).unwrap();
                }
                let mut found = Vec::new();
                pieces.by_ref().take(length as u64).read_to_end(&mut found).unwrap();
                let start = size.min(position as usize);
                prop_assert_eq!(&found, &bytes[start..size.min(start + length)]);
                position += found.len() as u64;
            }
        }
    }
}
