//! The loss of a batch and its gradients.
//!
//! In the particle model, each window goes through a network of its own, with the same weights: threads process
//! windows independently, and the data of a window stays in nearby caches. Gradients are added in the order of the windows. In
//! the frame model, all windows go through the network together, since its weights are much larger than a window.

use std::sync::Arc;

use rayon::prelude::*;

use super::{TrainConfig, batch::Batch, loss, loss_weights::LossScale, window::Window};
use crate::model::{DeviceKind, described::Model, dropout::Dropout, network::Network};
use eddy_inference::checkpoint::{Architecture, Description};

/// The loss of a batch and its gradient by each tensor, in the order of the plan; empty if the loss does not depend on
/// a tensor.
pub(super) struct BatchGradient {
    pub(super) loss: f32,
    pub(super) gradients: Vec<Vec<f32>>,
}

/// Computes losses and gradients.
pub(super) struct GradientTask<'a> {
    pub(super) config: &'a TrainConfig,
    pub(super) description: &'a Description,
    pub(super) scale: &'a LossScale<'a>,
    pub(super) device: DeviceKind,
}

impl GradientTask<'_> {
    /// The means over the windows, of the network with these weights in the order of its plan.
    pub(super) fn compute(
        &self,
        weights: &Arc<Vec<Vec<f32>>>,
        windows: &[Window],
        dropout: &mut Dropout,
    ) -> BatchGradient {
        let model = Model::new(self.description);
        let device = self.device.device().autodiff();
        let together = match self.config.architecture {
            Architecture::Frame => windows.len(),
            Architecture::Particle => 1,
        };
        let groups: Vec<_> =
            windows.chunks(together).map(|group| (group, dropout.fork())).collect();
        let parts: Vec<(f32, BatchGradient)> = groups
            .into_par_iter()
            .map(|(group, mut dropout)| {
                let share = group.len() as f32 / windows.len() as f32;
                let network = Network::new(&model, weights, &device);
                (share, self.group(&network, group, &mut dropout))
            })
            .collect();
        let mut parts = parts.into_iter();
        let Some((share, mut sum)) = parts.next() else {
            return BatchGradient { loss: 0.0, gradients: Vec::new() };
        };
        if share < 1.0 {
            sum.loss *= share;
            sum.gradients.iter_mut().flatten().for_each(|number| *number *= share);
        }
        for (share, part) in parts {
            sum.loss += share * part.loss;
            for (sum, gradient) in sum.gradients.iter_mut().zip(part.gradients) {
                sum.resize(gradient.len().max(sum.len()), 0.0);
                sum.iter_mut().zip(gradient).for_each(|(sum, number)| *sum += share * number);
            }
        }
        sum
    }

    /// The means over windows that go through the network together.
    pub(super) fn group(
        &self,
        network: &Network,
        windows: &[Window],
        dropout: &mut Dropout,
    ) -> BatchGradient {
        let Self { config, description, scale, .. } = self;
        let warm_up = config.windows.warm_up;
        let batch = Batch::new(windows, warm_up, scale, description, &self.device.device());
        let (predicted, steps) = loss::unroll(network, &batch, config.truncation, dropout);
        let loss = loss::loss(&config.loss, &batch, &predicted, &steps, description.domain);
        let value = loss.clone().inner().into_scalar();
        let mut gradients = network.gradients(&mut loss.backward());
        // The gradient of a window whose prediction diverges can overflow. It contains no direction and is dropped.
        if !gradients.iter().flatten().all(|number| number.is_finite()) {
            gradients.iter_mut().flatten().for_each(|number| *number = 0.0);
        }
        BatchGradient { loss: value, gradients }
    }
}
