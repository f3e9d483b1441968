//! Which stream teaches, which chooses, which judges.

use std::collections::BTreeSet;

/// Share of the ids that train (the paper's 80:10:10).
const TRAIN_SHARE: f64 = 0.8;
/// Share of the ids that train or validate.
const VALIDATION_END: f64 = 0.9;

/// A part of a data set.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// What weights are fitted to.
    Train,
    /// What the best epoch is chosen by.
    Validation,
    /// What nobody has seen.
    Test,
}

/// The ids of all streams, ascending. Pieces of a trajectory that was cut share one id.
pub(super) fn distinct_ids(ids: impl Iterator<Item = u64>) -> Vec<u64> {
    ids.collect::<BTreeSet<_>>().into_iter().collect()
}

impl Part {
    /// The part of the stream `id` among `ids`, which ascend. Of 60 ids, 0..47 train, 48..53
    /// validate and 54..59 test, as in the paper; a lone stream trains.
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

/// Where training and validation end among `count` ids: at least one id each, and one for the test
/// where there are three.
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
    fn every_part_has_a_stream_where_there_are_three() {
        assert_eq!(bounds(2), (1, 2));
        assert_eq!(bounds(3), (1, 2));
        assert_eq!(bounds(12), (9, 10));
        for count in 3..200 {
            let (train, validation) = bounds(count);
            assert!(0 < train && train < validation && validation < count, "{count}");
        }
    }
}
