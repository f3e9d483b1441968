//! What a batch costs, and how that changes with every weight.
//!
//! Windows of the particle model have nothing in common but the weights: each goes through a network of
//! its own with the same weights, so that threads have a window each and what a layer hands on to the
//! next stays near them. Their gradients are added in the order of the windows. The frame model's windows
//! go together: its weights are many times larger than a window.

use rayon::prelude::*;

use super::{TrainConfig, batch::Batch, loss, weigh::Scale, window::Window};
use crate::model::{
    DeviceKind,
    network::{Dropout, Network},
};
use eddy_inference::checkpoint::{Architecture, Description};

/// The loss of a batch, and its gradient by every tensor in the order of the layers' update; empty where
/// the loss does not depend on a tensor.
pub(super) struct Slope {
    pub(super) loss: f32,
    pub(super) gradients: Vec<Vec<f32>>,
}

/// What loss and gradients are computed from.
pub(super) struct Task<'a> {
    pub(super) config: &'a TrainConfig,
    pub(super) description: &'a Description,
    pub(super) scale: &'a Scale<'a>,
    pub(super) device: DeviceKind,
}

impl Task<'_> {
    /// The mean over the windows.
    pub(super) fn slope(
        &self,
        network: &Network,
        windows: &[Window],
        dropout: &mut Dropout,
    ) -> Slope {
        let together = match self.config.architecture {
            Architecture::Frame => windows.len(),
            Architecture::Particle => 1,
        };
        let groups: Vec<_> =
            windows.chunks(together).map(|group| (group, dropout.fork())).collect();
        let slopes: Vec<(f32, Slope)> = groups
            .into_par_iter()
            .map(|(group, mut dropout)| {
                let share = group.len() as f32 / windows.len() as f32;
                (share, self.of(network.apart(), group, &mut dropout))
            })
            .collect();
        let mut slopes = slopes.into_iter();
        let Some((share, mut sum)) = slopes.next() else {
            return Slope { loss: 0.0, gradients: Vec::new() };
        };
        if share < 1.0 {
            sum.loss *= share;
            sum.gradients.iter_mut().flatten().for_each(|number| *number *= share);
        }
        for (share, slope) in slopes {
            sum.loss += share * slope.loss;
            for (sum, gradient) in sum.gradients.iter_mut().zip(slope.gradients) {
                sum.resize(gradient.len().max(sum.len()), 0.0);
                sum.iter_mut().zip(gradient).for_each(|(sum, number)| *sum += share * number);
            }
        }
        sum
    }

    /// Of windows that go through the network together.
    fn of(&self, network: Network, windows: &[Window], dropout: &mut Dropout) -> Slope {
        let Self { config, description, scale, .. } = self;
        let (warm_up, grid) = (config.windows.warm_up, description.grid.as_ref());
        let batch = Batch::new(windows, warm_up, scale, grid, &self.device.device());
        let (predicted, steps) = loss::unroll(&network, &batch, dropout);
        let loss = loss::loss(&config.loss, &batch, &predicted, &steps, description.domain);
        let value = loss.clone().inner().into_scalar();
        let mut gradients = network.layers().gradients(&mut loss.backward());
        // A window that the network throws far about can have a slope beyond all numbers. It tells no
        // direction.
        if !gradients.iter().flatten().all(|number| number.is_finite()) {
            gradients.iter_mut().flatten().for_each(|number| *number = 0.0);
        }
        Slope { loss: value, gradients }
    }
}
