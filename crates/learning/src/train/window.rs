//! The pieces of streams that make up a batch.

use std::{collections::VecDeque, ops::Range};

use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::{NoiseConfig, TrainError, WindowConfig};
use eddy_dataset::Trajectory;
use eddy_frames::{Material, State, tool::Sweep};

/// A piece of a stream: all particles over consecutive frames.
#[derive(Clone, Debug)]
pub(super) struct Window {
    /// Its stream.
    pub(super) stream: u64,
    /// Its first frame in the stream.
    pub(super) start: usize,
    /// Materials, `[N]`.
    pub(super) material: Vec<Material>,
    /// Positions in the stream's first frame, `[N]`.
    pub(super) rest: Vec<[f32; 2]>,
    /// Its stream's stiffness, if it is known (density x velocity^2).
    pub(super) stiffness: Option<f32>,
    /// The states, `warm_up + unroll` of them.
    pub(super) states: Vec<State>,
    /// How tools move after each state but the last, if there are any.
    pub(super) sweeps: Vec<Option<Sweep>>,
    /// The last observed state with noise, if any, which the network observes instead.
    pub(super) noisy: Option<State>,
}

/// Draws windows from streams with equal probability.
///
/// The windows that a seed draws do not depend on where the frames are stored. For streams on disk, the windows of many
/// batches are drawn at once and read in the order of their streams, so that each block is read once.
pub(super) struct Sampler<'a> {
    streams: &'a [Trajectory],
    /// Indices of the streams: by their stiffness, if each batch is of about one stiffness.
    order: Vec<usize>,
    /// Number of windows up to and including each stream in that order.
    ends: Vec<usize>,
    /// Number of parts of that order, from one of which a batch is drawn: 1 for all streams.
    parts: usize,
    /// Frames per window.
    frames: usize,
    config: &'a WindowConfig,
    /// Windows drawn ahead.
    ahead: VecDeque<Window>,
}

/// Least number of streams that a batch of about one stiffness is drawn from, unless there are few.
const STREAMS_OF_PART: usize = 32;
/// Least number of parts of about one stiffness, if there are as many streams.
const PARTS: usize = 8;

/// A stream's stiffness, for their order.
fn stiffness(stream: &Trajectory) -> f32 {
    stream.stiffness.unwrap_or_default()
}

/// A window that was drawn but not read yet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Draw {
    /// Index of the stream.
    pub(super) stream: usize,
    /// First frame.
    pub(super) start: usize,
    pub(super) mirrored: bool,
    /// Seed of the noise.
    pub(super) noise: Option<u64>,
}

impl<'a> Sampler<'a> {
    /// Windows of `warm_up + unroll` frames.
    pub(super) fn new(
        streams: &'a [Trajectory],
        config: &'a WindowConfig,
        unroll: usize,
    ) -> Result<Self, TrainError> {
        let warm_up = config.warm_up;
        let frames = warm_up + unroll;
        let mut windows = 0;
        let ends = streams.iter().map(|stream| {
            windows += (stream.frames + 1).saturating_sub(frames);
            windows
        });
        let ends = ends.collect();
        let order = (0..streams.len()).collect();
        if windows == 0 {
            let found = streams.iter().map(|stream| stream.frames).max().unwrap_or(0);
            return Err(TrainError::TooShort { found, expected: frames, warm_up, unroll });
        }
        Ok(Self { streams, order, ends, parts: 1, frames, config, ahead: VecDeque::new() })
    }

    /// The same, but that all windows of a batch are of streams of about one stiffness: of [`STREAMS_OF_PART`] or more that follow each
    /// other in their order by stiffness; of fewer if there would not be [`PARTS`] parts.
    pub(super) fn by_stiffness(self) -> Self {
        let windows = |stream: usize| self.ends[stream] - self.first(stream);
        let counts: Vec<usize> = (0..self.streams.len()).map(windows).collect();
        let Self { streams, mut order, mut ends, .. } = self;
        order.sort_by(|&a, &b| f32::total_cmp(&stiffness(&streams[a]), &stiffness(&streams[b])));
        let mut sum = 0;
        for (end, &stream) in ends.iter_mut().zip(&order) {
            sum += counts[stream];
            *end = sum;
        }
        let parts = (order.len() / STREAMS_OF_PART).max(PARTS.min(order.len()));
        Self { order, ends, parts, ..self }
    }

    /// The next batch of `size` windows; at least `left` such batches are still needed.
    pub(super) fn batch(
        &mut self,
        size: usize,
        left: impl FnOnce() -> usize,
        random: &mut ChaCha8Rng,
    ) -> Result<Vec<Window>, TrainError> {
        if self.ahead.is_empty() {
            let batches = left().min(self.batches_ahead(size)).max(1);
            self.ahead = self.draw(batches * size, random)?.into();
        }
        Ok(self.ahead.drain(..size).collect())
    }

    /// Number of batches that are drawn at once: one from memory; from disk as many as fit into a third of the cache.
    fn batches_ahead(&self, size: usize) -> usize {
        let Some(store) = self.streams[0].frame_store() else { return 1 };
        let counts = self.streams.iter().map(|stream| stream.material.len());
        let particles = counts.max().unwrap_or(1);
        let window = self.frames * particles * size_of::<[f32; 4]>();
        usize::try_from(store.limit() / 3).unwrap_or(usize::MAX) / (window * size).max(1)
    }

    /// `count` windows, drawn with replacement.
    pub(super) fn draw(
        &self,
        count: usize,
        random: &mut ChaCha8Rng,
    ) -> Result<Vec<Window>, TrainError> {
        let mut draws: Vec<_> = self.choose_many(count, random).into_iter().enumerate().collect();
        draws.sort_by_key(|(_, draw)| (draw.stream, draw.start));
        let cut = |(place, draw): (usize, Draw)| Ok((place, self.cut(draw)?));
        let mut windows = draws.into_iter().map(cut).collect::<Result<Vec<_>, TrainError>>()?;
        windows.sort_by_key(|&(place, _)| place);
        Ok(windows.into_iter().map(|(_, window)| window).collect())
    }

    /// `count` windows, drawn with replacement, not read: whole batches of the settings' size, if those are of about one stiffness.
    pub(super) fn choose_many(&self, count: usize, random: &mut ChaCha8Rng) -> Vec<Draw> {
        let mut range = 0..self.ends.last().copied().unwrap_or(0);
        (0..count)
            .map(|number| {
                if self.parts > 1 && number.is_multiple_of(self.config.batch) {
                    range = self.range_of_batch(random);
                }
                let window = random.random_range(range.clone());
                let place = self.ends.partition_point(|&end| end <= window);
                self.choose(self.order[place], window - self.first(place), random)
            })
            .collect()
    }

    /// Number of windows before a stream's.
    fn first(&self, place: usize) -> usize {
        if place == 0 { 0 } else { self.ends[place - 1] }
    }

    /// The windows that a batch is drawn from, by the stiffness of one that is drawn.
    fn range_of_batch(&self, random: &mut ChaCha8Rng) -> Range<usize> {
        let windows = self.ends.last().copied().unwrap_or(0);
        let window = random.random_range(0..windows);
        let place = self.ends.partition_point(|&end| end <= window);
        let (streams, parts) = (self.order.len(), self.parts);
        let part = place * parts / streams;
        let [first, end] = [part, part + 1].map(|part| (part * streams).div_ceil(parts));
        self.first(first)..self.first(end)
    }

    /// The id of a window's stream, and the window's first frame in it.
    #[cfg(feature = "cuda")]
    pub(super) fn origin(&self, draw: &Draw) -> (u64, usize) {
        (self.streams[draw.stream].id, draw.start)
    }

    fn choose(&self, stream: usize, start: usize, random: &mut ChaCha8Rng) -> Draw {
        let mirrored = self.config.mirror && random.random();
        let share = self.config.noise.share;
        let noise = (share > 0.0 && random.random::<f32>() < share).then(|| random.random());
        Draw { stream, start, mirrored, noise }
    }

    /// Materials of a window's particles.
    #[cfg(feature = "cuda")]
    pub(super) fn material(&self, draw: &Draw) -> &[Material] {
        &self.streams[draw.stream].material
    }

    /// Stiffness of a window's stream, if it is known.
    #[cfg(feature = "cuda")]
    pub(super) fn stiffness(&self, draw: &Draw) -> Option<f32> {
        self.streams[draw.stream].stiffness
    }

    pub(super) fn cut(&self, draw: Draw) -> Result<Window, TrainError> {
        let Draw { stream, start, mirrored, noise } = draw;
        let stream = &self.streams[stream];
        let sides = stream.domain.lower[0] + stream.domain.upper[0];
        let turn = |values: &[[f32; 2]], sides: f32| {
            let value = |&[x, y]: &[f32; 2]| if mirrored { [sides - x, y] } else { [x, y] };
            values.iter().map(value).collect::<Vec<_>>()
        };
        let mut states = Vec::with_capacity(self.frames);
        stream.visit(start..start + self.frames, |s| {
            let (position, velocity) = (turn(&s.position, sides), turn(&s.velocity, 0.0));
            states.push(State { position, velocity });
        })?;
        let sweep = |frame| {
            let sweep = stream.sweep(frame)?;
            Some(if mirrored { sweep.mirrored(sides) } else { sweep })
        };
        let sweeps = (start..start + self.frames - 1).map(sweep).collect();
        let last = &states[self.config.warm_up - 1];
        Ok(Window {
            stream: stream.id,
            start,
            material: stream.material.clone(),
            rest: turn(&stream.rest, sides),
            stiffness: stream.stiffness,
            noisy: noise.map(|seed| add_noise(last, &self.config.noise, seed)),
            states,
            sweeps,
        })
    }
}

impl Window {
    /// Its stream, and its first frame in it.
    pub(super) fn origin(&self) -> (u64, usize) {
        (self.stream, self.start)
    }
}

/// Stream and first frame of each window, to identify a batch.
pub(super) fn names(windows: &[(u64, usize)]) -> String {
    let names: Vec<_> = windows.iter().map(|(stream, start)| format!("{stream}:{start}")).collect();
    names.join(" ")
}

/// A state with uniformly distributed noise of the given standard deviations.
fn add_noise(state: &State, noise: &NoiseConfig, seed: u64) -> State {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut moved = |values: &[[f32; 2]], deviation: f32| {
        let half = 3f32.sqrt() * deviation;
        let add =
            |x: &f32, random: &mut ChaCha8Rng| x + half * (2.0 * random.random::<f32>() - 1.0);
        values.iter().map(|[x, y]| [add(x, &mut random), add(y, &mut random)]).collect()
    };
    State {
        position: moved(&state.position, noise.position),
        velocity: moved(&state.velocity, noise.velocity),
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;
    use crate::train::TrainConfig;
    use eddy_dataset::Stream;
    use eddy_frames::{Domain, Stamp};
    use eddy_inference::checkpoint::Architecture;

    /// Frames of each stream.
    const FRAMES: usize = 6;

    /// Streams of a particle whose stiffnesses are 1, 2, ... in another order.
    fn streams(count: usize) -> Vec<Trajectory> {
        let state = State { position: vec![[0.5; 2]], velocity: vec![[0.0; 2]] };
        let stream = |id: usize| {
            Trajectory::from(Stream {
                id: id as u64,
                source: "memory".into(),
                dt: 0.016,
                domain: Domain::UNIT,
                material: vec![Material::Jelly],
                first_sequence: 0,
                first_stamp: Stamp::default(),
                stiffness: Some((id * 37 % count + 1) as f32),
                tools: None,
                // One is too short for a window.
                states: vec![state.clone(); if id == 5 { 2 } else { FRAMES }],
            })
        };
        (0..count).map(stream).collect()
    }

    #[test]
    fn a_batch_is_of_about_one_stiffness_and_every_window_is_drawn() {
        let mut config = TrainConfig::defaults(Architecture::Particle).windows;
        (config.warm_up, config.batch) = (2, 16);
        for (count, longest) in [(300, 34), (20, 3)] {
            let streams = streams(count);
            let sampler = Sampler::new(&streams, &config, 2).unwrap().by_stiffness();
            let draws = sampler.choose_many(4096 * 16, &mut ChaCha8Rng::seed_from_u64(1));
            for batch in draws.chunks(16) {
                let of_batch = batch.iter().map(|draw| stiffness(&streams[draw.stream]) as usize);
                let (least, most) = (of_batch.clone().min().unwrap(), of_batch.max().unwrap());
                assert!(most - least < longest, "{least} to {most} of {count}");
            }
            let drawn: BTreeSet<_> = draws.iter().map(|draw| (draw.stream, draw.start)).collect();
            assert_eq!(drawn.len(), (count - 1) * (FRAMES - 3), "each window");
        }
    }
}
