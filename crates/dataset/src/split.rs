//! Training, validation and test streams.

use std::collections::BTreeSet;

/// Share of the ids in the training part (the paper's 80:10:10).
const TRAIN_SHARE: f64 = 0.8;
/// Share of the ids in the training and validation parts.
const VALIDATION_END: f64 = 0.9;

/// A part of a data set.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// Fits the weights.
    Train,
    /// Selects the best epoch.
    Validation,
    /// Unseen during training.
    Test,
}

/// The distinct ids of all streams, ascending. Pieces of a trajectory that was cut share one id.
pub(super) fn distinct_ids(ids: impl Iterator<Item = u64>) -> Vec<u64> {
    ids.collect::<BTreeSet<_>>().into_iter().collect()
}

impl Part {
    /// The part of the stream `id` among the ascending `ids`. Of 60 ids, the first 48 are for training, the next 6 for
    /// validation and the last 6 for the test, as in the paper; a single stream is for training.
    pub fn of(ids: &[u64], id: u64) -> Self {
        if ids.len() < 2 {
            return Self::Train;
        }
        let position = ids.partition_point(|&other| other < id);
        let (train, validation) = bounds(ids.len());
        if position < train {
            Self::Train
        } else if position < validation {
            Self::Validation
        } else {
            Self::Test
        }
    }
}

/// Ends of the training and validation parts among `count` ids: each has at least one id, and so does the test part
/// if there are three or more.
fn bounds(count: usize) -> (usize, usize) {
    let latest_validation_end = if count >= 3 { count - 1 } else { count };
    let end = |share: f64| (share * count as f64).floor() as usize;
    let train = end(TRAIN_SHARE).clamp(1, latest_validation_end - 1);
    let validation = end(VALIDATION_END).clamp(train + 1, latest_validation_end);
    (train, validation)
}

#[cfg(test)]
mod tests {
    use super::bounds;

    #[test]
    fn the_papers_sixty_scenes_are_split_48_6_6() {
        assert_eq!(bounds(60), (48, 54));
    }

    #[test]
    fn every_part_has_a_stream_if_there_are_at_least_three() {
        assert_eq!(bounds(2), (1, 2));
        assert_eq!(bounds(3), (1, 2));
        assert_eq!(bounds(12), (9, 10));
        for count in 3..200 {
            let (train, validation) = bounds(count);
            assert!(0 < train && train < validation && validation < count, "{count}");
        }
    }
}
