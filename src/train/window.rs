//! Which pieces of which streams a batch is made of.

use rand::{RngExt as _, seq::index::sample};
use rand_chacha::ChaCha8Rng;

use super::TrainError;
use crate::{
    dataset::{State, Stream},
    frame::Material,
};

/// A piece of a stream: some of its particles over consecutive frames.
#[derive(Clone, Debug)]
pub(super) struct Window {
    /// The stream it is from.
    pub(super) stream: u64,
    /// Its first frame in that stream.
    pub(super) start: usize,
    /// Materials, `[N]`.
    pub(super) material: Vec<Material>,
    /// The states, `warm_up + unroll` of them.
    pub(super) states: Vec<State>,
}

/// Draws windows from streams, each window alike.
pub(super) struct Sampler<'a> {
    streams: &'a [Stream],
    /// Number of windows up to and with each stream.
    ends: Vec<usize>,
    /// Frames a window.
    frames: usize,
    /// Particles a window; 0 is all.
    particles: usize,
    /// Whether to mirror every other window.
    mirror: bool,
}

impl<'a> Sampler<'a> {
    /// Windows of `warm_up + unroll` frames.
    pub(super) fn new(
        streams: &'a [Stream],
        warm_up: usize,
        unroll: usize,
        particles: usize,
        mirror: bool,
    ) -> Result<Self, TrainError> {
        let frames = warm_up + unroll;
        let mut windows = 0;
        let ends = streams.iter().map(|stream| {
            windows += (stream.states.len() + 1).saturating_sub(frames);
            windows
        });
        let sampler = Self { streams, ends: ends.collect(), frames, particles, mirror };
        if windows == 0 {
            let found = streams.iter().map(|stream| stream.states.len()).max().unwrap_or(0);
            return Err(TrainError::TooShort { found, expected: frames, warm_up, unroll });
        }
        Ok(sampler)
    }

    /// `count` windows, drawn with replacement.
    pub(super) fn draw(&self, count: usize, random: &mut ChaCha8Rng) -> Vec<Window> {
        let windows = self.ends.last().copied().unwrap_or(0);
        (0..count)
            .map(|_| {
                let window = random.random_range(0..windows);
                let stream = self.ends.partition_point(|&end| end <= window);
                let before = if stream == 0 { 0 } else { self.ends[stream - 1] };
                self.cut(&self.streams[stream], window - before, random)
            })
            .collect()
    }

    fn cut(&self, stream: &Stream, start: usize, random: &mut ChaCha8Rng) -> Window {
        let count = stream.material.len();
        let chosen = match self.particles {
            wanted if wanted == 0 || wanted >= count => (0..count).collect(),
            wanted => sample(random, count, wanted).into_vec(),
        };
        let sides = stream.domain.lower[0] + stream.domain.upper[0];
        let mirrored = self.mirror && random.random();
        let pick = |values: &[[f32; 2]], sides: f32| {
            let value = |&i: &usize| {
                let [x, y] = values[i];
                if mirrored { [sides - x, y] } else { [x, y] }
            };
            chosen.iter().map(value).collect()
        };
        Window {
            stream: stream.id,
            start,
            material: chosen.iter().map(|&i| stream.material[i]).collect(),
            states: stream.states[start..start + self.frames]
                .iter()
                .map(|s| State {
                    position: pick(&s.position, sides),
                    velocity: pick(&s.velocity, 0.0),
                })
                .collect(),
        }
    }
}
