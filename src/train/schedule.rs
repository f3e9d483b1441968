//! Which learning rate and which length of unroll at which moment of the run.

use super::{OptimizerConfig, Stage};

/// Half a cosine from the first to the last learning rate; `progress` runs from 0 to 1.
pub(super) fn learning_rate(config: &OptimizerConfig, progress: f64) -> f64 {
    let left = 0.5 * (1.0 + (std::f64::consts::PI * progress.clamp(0.0, 1.0)).cos());
    config.learning_rate * (config.final_share + (1.0 - config.final_share) * left)
}

/// The stage that holds at `progress`, 0 to 1.
pub(super) fn stage(stages: &[Stage], progress: f64) -> usize {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_learning_rate_falls_from_the_first_to_the_last() {
        let config =
            OptimizerConfig { learning_rate: 1e-3, final_share: 0.1, clip: 1.0, epsilon: 1e-8 };
        assert_eq!(learning_rate(&config, 0.0), 1e-3);
        assert!((learning_rate(&config, 0.5) - 5.5e-4).abs() < 1e-12);
        assert!((learning_rate(&config, 1.0) - 1e-4).abs() < 1e-12);
    }

    #[test]
    fn stages_take_their_shares_of_the_run() {
        let stages = [Stage { share: 1.0, frames: 2 }, Stage { share: 3.0, frames: 6 }];
        let found = [0.0, 0.24, 0.26, 0.99, 1.0].map(|progress| stage(&stages, progress));
        assert_eq!(found, [0, 0, 1, 1, 1]);
    }
}
