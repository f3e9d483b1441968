//! The schedule of a run: the learning rate and the length of unroll of every batch.

use super::{OptimizerConfig, Schedule, TrainConfig, UnrollStage};

/// Batches that follow each other within an epoch and a stage of the run.
pub(super) struct Batches {
    /// Number of the first one in its epoch, from 1.
    pub(super) first: usize,
    /// Frames that are predicted freely.
    pub(super) unroll: usize,
    /// The learning rate of each.
    pub(super) rates: Vec<f64>,
    /// Number of batches from the first one to the end of the epoch or stage.
    pub(super) left: usize,
}

/// The batches of an epoch, at most so many at a time.
pub(super) fn batches(
    config: &TrainConfig,
    epoch: u32,
    at_a_time: usize,
) -> impl Iterator<Item = Batches> {
    let mut first = 1;
    std::iter::from_fn(move || {
        let left = batches_of_stage(config, epoch, first);
        let next = first + left.min(at_a_time);
        let rate = |batch| learning_rate(&config.optimizer, progress(config, epoch, batch));
        let rates: Vec<_> = (first..next).map(rate).collect();
        let batches = Batches { first, unroll: unroll(config, epoch, first), rates, left };
        first = next;
        (left > 0).then_some(batches)
    })
}

/// Frames that are predicted freely in a batch of an epoch, both counted from 1.
pub(super) fn unroll(config: &TrainConfig, epoch: u32, batch: usize) -> usize {
    config.unroll[stage(&config.unroll, progress(config, epoch, batch))].frames
}

/// Whether the last stage has begun when an epoch ends.
pub(super) fn in_last_stage(config: &TrainConfig, epoch: u32) -> bool {
    let progress = progress(config, epoch, config.batches());
    stage(&config.unroll, progress) + 1 == config.unroll.len()
}

/// The learning rate at `progress`, 0 to 1.
fn learning_rate(config: &OptimizerConfig, progress: f64) -> f64 {
    let OptimizerConfig { learning_rate, warm_up, schedule, final_share, .. } = *config;
    if progress < warm_up {
        return learning_rate * progress / warm_up;
    }
    match schedule {
        Schedule::Constant => learning_rate,
        Schedule::Cosine => {
            let after = ((progress - warm_up) / (1.0 - warm_up)).clamp(0.0, 1.0);
            let left = 0.5 * (1.0 + (std::f64::consts::PI * after).cos());
            learning_rate * (final_share + (1.0 - final_share) * left)
        }
    }
}

/// The stage at `progress`, 0 to 1.
fn stage(stages: &[UnrollStage], progress: f64) -> usize {
    let total: f32 = stages.iter().map(|stage| stage.share).sum();
    let mut end = 0.0;
    stages
        .iter()
        .position(|stage| {
            end += f64::from(stage.share / total);
            progress < end
        })
        .unwrap_or(stages.len() - 1)
}

/// The completed share of the run before a batch of an epoch, both counted from 1.
fn progress(config: &TrainConfig, epoch: u32, batch: usize) -> f64 {
    let per_epoch = config.batches();
    let all = per_epoch * config.epochs as usize;
    ((epoch as usize - 1) * per_epoch + batch - 1) as f64 / all as f64
}

/// Number of batches of an epoch, from `batch` on, in the same stage.
fn batches_of_stage(config: &TrainConfig, epoch: u32, batch: usize) -> usize {
    let stage_of = |batch| stage(&config.unroll, progress(config, epoch, batch));
    let now = stage_of(batch);
    (batch..=config.batches()).take_while(|&batch| stage_of(batch) == now).count()
}

#[cfg(test)]
mod tests {
    use super::{super::OptimizerKind, *};
    use eddy_inference::checkpoint::Architecture;

    fn config(schedule: Schedule, warm_up: f64) -> OptimizerConfig {
        OptimizerConfig {
            kind: OptimizerKind::Adam,
            learning_rate: 1e-3,
            warm_up,
            schedule,
            final_share: 0.1,
            clip: 1.0,
            epsilon: 1e-8,
            average: 0.0,
        }
    }

    #[test]
    fn the_learning_rate_decreases_to_its_final_share() {
        let config = config(Schedule::Cosine, 0.0);
        assert_eq!(learning_rate(&config, 0.0), 1e-3);
        assert!((learning_rate(&config, 0.5) - 5.5e-4).abs() < 1e-12);
        assert!((learning_rate(&config, 1.0) - 1e-4).abs() < 1e-12);
    }

    #[test]
    fn a_constant_learning_rate_does_not_change() {
        for progress in [0.0, 0.3, 1.0] {
            assert_eq!(learning_rate(&config(Schedule::Constant, 0.0), progress), 1e-3);
        }
    }

    #[test]
    fn a_warm_up_increases_linearly_to_the_start_of_the_schedule() {
        for schedule in [Schedule::Cosine, Schedule::Constant] {
            let config = config(schedule, 0.2);
            assert_eq!(learning_rate(&config, 0.0), 0.0);
            assert!((learning_rate(&config, 0.1) - 5e-4).abs() < 1e-12);
            assert!((learning_rate(&config, 0.2) - 1e-3).abs() < 1e-12);
        }
        assert!((learning_rate(&config(Schedule::Cosine, 0.2), 0.6) - 5.5e-4).abs() < 1e-12);
    }

    #[test]
    fn stages_have_their_shares_of_the_run() {
        let stages = [UnrollStage { share: 1.0, frames: 2 }, UnrollStage { share: 3.0, frames: 6 }];
        let found = [0.0, 0.24, 0.26, 0.99, 1.0].map(|progress| stage(&stages, progress));
        assert_eq!(found, [0, 0, 1, 1, 1]);
    }

    #[test]
    fn an_epoch_is_taken_in_groups_that_end_with_the_stage() {
        let mut config = TrainConfig::defaults(Architecture::Particle);
        config.epochs = 2;
        (config.windows.batch, config.windows.per_epoch) = (1, 10);
        config.unroll =
            vec![UnrollStage { share: 1.0, frames: 2 }, UnrollStage { share: 3.0, frames: 6 }];
        let groups = |epoch| -> Vec<_> {
            batches(&config, epoch, 4)
                .map(|group| (group.first, group.rates.len(), group.unroll, group.left))
                .collect()
        };
        assert_eq!(groups(1), [(1, 4, 2, 5), (5, 1, 2, 1), (6, 4, 6, 5), (10, 1, 6, 1)]);
        assert_eq!(groups(2), [(1, 4, 6, 10), (5, 4, 6, 6), (9, 2, 6, 2)]);
        assert!(in_last_stage(&config, 1));
        let rates = |at_a_time| -> Vec<_> {
            batches(&config, 2, at_a_time).flat_map(|group| group.rates).collect()
        };
        assert_eq!(rates(1), rates(4));
        assert_eq!(rates(1)[0], learning_rate(&config.optimizer, 0.5));
    }
}
