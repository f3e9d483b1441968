//! Frames of several topics, matched by sequence number.

use crate::ExchangeError;
use eddy_frames::Frame;

/// The frames of one topic, in ascending order of their sequence numbers.
pub type Frames<const D: usize = 2> = Box<dyn Iterator<Item = Result<Frame<D>, ExchangeError>>>;

/// Reads the frames of the first topic, each with the frames of the same sequence number on the other topics.
pub struct AlignedFrames<const D: usize = 2> {
    first: Frames<D>,
    others: Vec<Other<D>>,
}

struct Other<const D: usize> {
    frames: Frames<D>,
    /// A frame that is later than the last one of the first topic.
    next: Option<Frame<D>>,
}

impl<const D: usize> AlignedFrames<D> {
    /// Matches `others` with `first`.
    pub fn new(first: Frames<D>, others: Vec<Frames<D>>) -> Self {
        let others = others.into_iter().map(|frames| Other { frames, next: None }).collect();
        Self { first, others }
    }
}

impl<const D: usize> Iterator for AlignedFrames<D> {
    type Item = Result<Vec<Option<Frame<D>>>, ExchangeError>;

    /// One entry per topic; only the first is always a frame.
    fn next(&mut self) -> Option<Self::Item> {
        let frame = match self.first.next()? {
            Ok(frame) => frame,
            Err(error) => return Some(Err(error)),
        };
        let others = self.others.iter_mut().map(|other| other.frame(frame.sequence));
        let others: Result<Vec<_>, _> = others.collect();
        Some(others.map(|mut frames| {
            frames.insert(0, Some(frame));
            frames
        }))
    }
}

impl<const D: usize> Other<D> {
    /// The frame with this sequence number, if there is one.
    fn frame(&mut self, sequence: u64) -> Result<Option<Frame<D>>, ExchangeError> {
        while self.next.as_ref().is_none_or(|frame| frame.sequence < sequence) {
            self.next = self.frames.next().transpose()?;
            if self.next.is_none() {
                break;
            }
        }
        Ok(self.next.take_if(|frame| frame.sequence == sequence))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use eddy_frames::{Domain, Material, Stamp};

    fn frames(sequences: &'static [u64]) -> Frames {
        Box::new(sequences.iter().map(|&sequence| {
            Ok(Frame {
                stream: 0,
                sequence,
                stamp: Stamp(0),
                dt: 0.016,
                domain: Domain::UNIT,
                position: vec![[0.5; 2]],
                velocity: vec![[0.0; 2]],
                material: vec![Material::Snow],
            })
        }))
    }

    #[test]
    fn frames_are_matched_by_sequence_number_with_gaps_on_either_side() {
        let aligned = AlignedFrames::new(frames(&[1, 2, 4, 5]), vec![frames(&[0, 2, 3, 5, 6])]);
        let sequences = aligned.map(|row| {
            row.unwrap().iter().map(|frame| frame.as_ref().map(|f| f.sequence)).collect::<Vec<_>>()
        });
        let expected = [[Some(1), None], [Some(2), Some(2)], [Some(4), None], [Some(5), Some(5)]];
        assert_eq!(sequences.collect::<Vec<_>>(), expected);
    }
}
