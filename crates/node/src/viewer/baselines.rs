//! The trivial baselines, from the same observed frames as the predictions.

use std::collections::VecDeque;

use super::PredictionInfo;
use eddy_frames::{Domain, Frame, State, mean_squared_distance};
use eddy_inference::engine::{Ballistic, Baseline};

/// Maximum number of particle steps for the baselines of one prediction.
const MAX_ROLLOUT_STEPS: usize = 4_000_000;
/// Particles of all rollouts kept for continuation.
const KEPT_PARTICLES: usize = 1_000_000;

/// The baselines of one stream.
#[derive(Debug)]
pub(super) struct Baselines {
    gravity: [f32; 2],
    /// Domain of the model and its walls, lower and upper.
    domain: Domain,
    walls: [[f32; 2]; 2],
    /// Kept, so that a prediction one frame further ahead costs one step.
    pub(super) rollouts: VecDeque<Rollout>,
}

/// Rollouts of the baselines from one observed frame.
#[derive(Debug)]
pub(super) struct Rollout {
    source: u64,
    horizon: u32,
    states: [State; Baseline::ALL.len()],
}

impl Baselines {
    /// Baselines with this gravity (domain lengths/s^2) and these walls of `domain`, lower and upper.
    pub(super) fn new(gravity: [f32; 2], domain: Domain, walls: [[f32; 2]; 2]) -> Self {
        Self { gravity, domain, walls, rollouts: VecDeque::new() }
    }

    /// The same without rollouts.
    pub(super) fn empty_copy(&self) -> Self {
        Self::new(self.gravity, self.domain, self.walls)
    }

    /// Mean squared distances of the baselines from `truth` (domain lengths squared), predicted from the observed frame of
    /// `info`, which is `source`; `None` if it is unknown, or too far back for this number of particles.
    pub(super) fn errors(
        &mut self,
        truth: &Frame,
        source: Option<&Frame>,
        info: PredictionInfo,
    ) -> Option<[f64; Baseline::ALL.len()]> {
        if info.horizon == 0 {
            return None;
        }
        let step = self.step(truth);
        let found = self
            .rollouts
            .iter()
            .position(|rollout| rollout.source == info.source && rollout.horizon <= info.horizon);
        let mut rollout = match found.and_then(|place| self.rollouts.remove(place)) {
            Some(rollout) => rollout,
            None => {
                let source = source?;
                let state = || State {
                    position: source.position.clone(),
                    velocity: source.velocity.clone(),
                };
                Rollout { source: info.source, horizon: 0, states: Baseline::ALL.map(|_| state()) }
            }
        };
        let frames = (info.horizon - rollout.horizon) as usize;
        if frames.saturating_mul(truth.len()) > MAX_ROLLOUT_STEPS {
            return None;
        }
        for (baseline, state) in Baseline::ALL.into_iter().zip(&mut rollout.states) {
            (0..frames).for_each(|_| baseline.step(state, &step, None));
        }
        rollout.horizon = info.horizon;
        let errors =
            rollout.states.each_ref().map(|s| mean_squared_distance(&s.position, &truth.position));
        self.rollouts.push_back(rollout);
        let kept = (KEPT_PARTICLES / truth.len().max(1)).clamp(1, 64);
        while self.rollouts.len() > kept {
            self.rollouts.pop_front();
        }
        Some(errors)
    }

    /// The ballistic step in the domain of `frame`, with walls as thick as in the model's domain.
    fn step(&self, frame: &Frame) -> Ballistic {
        let [lower, upper] = self.walls;
        let (seen, domain) = (self.domain, frame.domain);
        let moved = |wall: [f32; 2], from: [f32; 2], to: [f32; 2]| {
            [0, 1].map(|axis| wall[axis] + (to[axis] - from[axis]))
        };
        Ballistic {
            gravity: self.gravity,
            dt: frame.dt,
            lower: moved(lower, seen.lower, domain.lower),
            upper: moved(upper, seen.upper, domain.upper),
        }
    }
}
