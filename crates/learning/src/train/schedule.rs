//! Learning rate and length of unroll over the run.

use super::{OptimizerConfig, Schedule, TrainConfig, UnrollStage};

/// The learning rate at `progress`, 0 to 1.
pub(super) fn learning_rate(config: &OptimizerConfig, progress: f64) -> f64 {
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
pub(super) fn stage(stages: &[UnrollStage], progress: f64) -> usize {
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
pub(super) fn progress(config: &TrainConfig, epoch: u32, batch: usize) -> f64 {
    let per_epoch = config.batches();
    let all = per_epoch * config.epochs as usize;
    ((epoch as usize - 1) * per_epoch + batch - 1) as f64 / all as f64
}

/// Number of batches of an epoch, from `batch` on, in the same stage.
pub(super) fn batches_of_stage(config: &TrainConfig, epoch: u32, batch: usize) -> usize {
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
    fn batches_of_a_stage_end_with_the_stage_and_the_epoch() {
        let mut config = TrainConfig::defaults(Architecture::Particle);
        config.epochs = 2;
        (config.windows.batch, config.windows.per_epoch) = (1, 10);
        config.unroll =
            vec![UnrollStage { share: 1.0, frames: 2 }, UnrollStage { share: 3.0, frames: 6 }];
        assert_eq!(progress(&config, 2, 1), 0.5);
        assert_eq!(batches_of_stage(&config, 1, 1), 5);
        assert_eq!(batches_of_stage(&config, 1, 4), 2);
        assert_eq!(batches_of_stage(&config, 1, 6), 5);
        assert_eq!(batches_of_stage(&config, 2, 1), 10);
    }
}
