//! Pairs of consecutive frames, and their scaling.

use rand::RngExt as _;
use rand_chacha::ChaCha8Rng;

use eddy_dataset::Trajectory;
use eddy_frames::State;
use eddy_inference::checkpoint::Normalization;
use eddy_learning::train::TrainError;

/// Features of a particle: x, y, vx, vy.
pub(super) const FEATURES: usize = 4;

/// Frames and the ones that follow, `[B, 4 N]` each.
pub(super) type Frames = [Vec<f32>; 2];

/// Pairs of frames.
pub(super) struct Pairs {
    pub(super) frames: Frames,
    /// Stream and first frame of each.
    origins: Vec<(u64, usize)>,
}

impl Pairs {
    /// Stream and first frame of each pair, to identify a batch.
    pub(super) fn names(&self) -> String {
        let names = self.origins.iter().map(|(stream, start)| format!("{stream}:{start}"));
        names.collect::<Vec<_>>().join(" ")
    }
}

/// Draws pairs from streams, all with the same probability.
pub(super) struct Sampler<'a> {
    streams: &'a [Trajectory],
    scale: &'a Scaling,
    /// Number of pairs of a stream and those before it.
    ends: Vec<usize>,
}

impl<'a> Sampler<'a> {
    pub(super) fn new(streams: &'a [Trajectory], scale: &'a Scaling) -> Result<Self, TrainError> {
        let mut pairs = 0;
        let ends = streams.iter().map(|stream| {
            pairs += stream.frames.saturating_sub(1);
            pairs
        });
        let ends = ends.collect();
        if pairs == 0 {
            let found = streams.iter().map(|stream| stream.frames).max().unwrap_or(0);
            return Err(TrainError::TooShort { found, expected: 2, warm_up: 1, unroll: 1 });
        }
        Ok(Self { streams, scale, ends })
    }

    /// `count` pairs, drawn with replacement.
    pub(super) fn draw(&self, count: usize, random: &mut ChaCha8Rng) -> Result<Pairs, TrainError> {
        let pairs = self.ends.last().copied().unwrap_or(0);
        let mut frames: Frames = Default::default();
        let mut origins = Vec::with_capacity(count);
        for _ in 0..count {
            let pair = random.random_range(0..pairs);
            let place = self.ends.partition_point(|&end| end <= pair);
            let start = pair - if place == 0 { 0 } else { self.ends[place - 1] };
            let stream = &self.streams[place];
            let mut sides = frames.iter_mut();
            stream.visit(start..start + 2, |state| {
                if let Some(side) = sides.next() {
                    side.extend(self.scale.scaled(state));
                }
            })?;
            origins.push((stream.id, start));
        }
        Ok(Pairs { frames, origins })
    }
}

/// Normalisation of features to 0..1 by their range in the training split.
pub(super) struct Scaling {
    minimum: [f32; FEATURES],
    inverse_range: [f32; FEATURES],
    mean: [f32; FEATURES],
}

impl Scaling {
    pub(super) fn new(normalization: &Normalization) -> Self {
        let Normalization { minimum, maximum, mean, .. } = *normalization;
        let each = [0, 1, 2, 3];
        let inverse_range = each.map(|feature| 1.0 / (maximum[feature] - minimum[feature]));
        let mean = each.map(|feature| (mean[feature] - minimum[feature]) * inverse_range[feature]);
        Self { minimum, inverse_range, mean }
    }

    fn scaled<'a>(&'a self, state: &'a State) -> impl Iterator<Item = f32> + 'a {
        state.position.iter().zip(&state.velocity).flat_map(|(x, v)| {
            let features = [x[0], x[1], v[0], v[1]];
            [0, 1, 2, 3].map(|f| (features[f] - self.minimum[f]) * self.inverse_range[f])
        })
    }

    /// Frames with mean features for all particles, so many numbers.
    pub(super) fn mean(&self, numbers: usize) -> Vec<f32> {
        self.mean.iter().copied().cycle().take(numbers).collect()
    }
}
