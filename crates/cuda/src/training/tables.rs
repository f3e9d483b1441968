//! What changes from step to step, in the memory of the device.

#![expect(unsafe_code, reason = "numbers that devices exchange")]

use std::sync::Arc;

use super::{Batch, GROUP, Outcome, Settings, Window, key};
use crate::{
    device::{Device, List, Queue},
    error::Result,
    kernels::{MATERIALS, common},
    streams::Body,
};

/// Windows, rates and weights of the steps that the host has prepared, and what came of them.
pub struct Tables {
    device: Arc<dyn Device>,
    /// Bodies of error weights of a step.
    weights: usize,
    /// Whether these differ from batch to batch.
    pub(crate) weights_differ: bool,
    batch: usize,
    /// `[steps, B]`.
    pub(crate) windows: List<common::Window>,
    /// `[steps]`.
    pub(crate) schedule: List<common::Schedule>,
    /// One.
    pub(crate) progress: List<common::Progress>,
    /// `[steps]`.
    pub(crate) outcomes: List<common::Outcome>,
    /// Weights of squared errors, `[steps or 1, K, B, MATERIALS]`.
    pub(crate) error_weights: List<Body>,
    /// Losses to be averaged over the devices.
    losses: List<f32>,
}

impl Tables {
    /// For steps of these settings, with weights of errors that differ from batch to batch or not.
    ///
    /// # Errors
    /// [`CudaError::Call`](crate::CudaError::Call), as of all that follows.
    pub(crate) fn new(
        device: &Arc<dyn Device>,
        settings: &Settings,
        weights_differ: bool,
    ) -> Result<Self> {
        let Settings { batch, unroll, .. } = *settings;
        let weights = unroll * batch * MATERIALS;
        let steps = if weights_differ { GROUP } else { 1 };
        Ok(Self {
            weights,
            weights_differ,
            batch,
            windows: List::new(&**device, GROUP * batch)?,
            schedule: List::new(&**device, GROUP)?,
            progress: List::new(&**device, 1)?,
            outcomes: List::new(&**device, GROUP)?,
            error_weights: List::new(&**device, steps * weights)?,
            losses: List::new(&**device, GROUP)?,
            device: Arc::clone(device),
        })
    }

    /// Bodies of error weights from a step to the next one.
    pub(crate) fn weights_step(&self) -> usize {
        if self.weights_differ { self.weights } else { 0 }
    }

    /// Sets weights of squared errors of x, y, vx, vy that hold for all batches, the same for every frame, window and
    /// material.
    pub(crate) fn set_error_weights(&self, weights: [f32; 4]) -> Result<()> {
        let all = vec![weights; self.weights];
        self.device.write(&self.error_weights, 0, bytemuck::cast_slice(&all))
    }

    /// Writes the tables of steps, where the bodies of window `number` of a step begin with `first(step, number, window)`.
    ///
    /// # Panics
    /// With too many steps, or with batches of another size than the settings say.
    pub(crate) fn write(
        &self,
        batches: &[Batch],
        first: impl Fn(usize, usize, &Window) -> u64,
    ) -> Result<()> {
        assert!(batches.len() <= GROUP, "{} steps, at most {GROUP}", batches.len());
        let (mut windows, mut schedule, mut weights) = (Vec::new(), Vec::new(), Vec::new());
        for (step, batch) in batches.iter().enumerate() {
            assert_eq!(batch.windows.len(), self.batch, "windows of a batch");
            let found = batch.weights.as_ref().map(Vec::len);
            assert_eq!(found, self.weights_differ.then_some(self.weights), "weights of a batch");
            for (number, window) in batch.windows.iter().enumerate() {
                windows.push(window.on_device(first(step, number, window)));
            }
            let Batch { rate, correction, kept, plain_rate, .. } = *batch;
            let (dropout, shares) = (key(batch.dropout), batch.shares);
            schedule.push(common::Schedule { rate, correction, kept, plain_rate, dropout, shares });
            weights.extend(batch.weights.iter().flatten().copied());
        }
        self.device.write(&self.windows, 0, bytemuck::cast_slice(&windows))?;
        self.device.write(&self.schedule, 0, bytemuck::cast_slice(&schedule))?;
        self.device.write(&self.progress, 0, bytemuck::cast_slice(&[0u32]))?;
        if self.weights_differ {
            self.device.write(&self.error_weights, 0, bytemuck::cast_slice(&weights))?;
        }
        Ok(())
    }

    /// Means over the devices that train together, which all call this with as many numbers, at most [`GROUP`].
    fn average_over_devices(&self, numbers: &mut [f32]) -> Result<()> {
        if self.device.rank().count == 1 {
            return Ok(());
        }
        self.device.write(&self.losses, 0, bytemuck::cast_slice(numbers))?;
        // SAFETY: `write` has checked the length.
        unsafe { self.device.average(Queue::Main, self.losses.pointer(), numbers.len()) }?;
        self.device.read(&self.losses, 0, bytemuck::cast_slice_mut(numbers))
    }

    /// What came of the steps started last, for the whole batch.
    pub(super) fn outcomes(&self, steps: usize) -> Result<Vec<Outcome>> {
        assert!(steps <= GROUP, "{steps} steps, at most {GROUP}");
        let mut found: Vec<common::Outcome> = vec![bytemuck::Zeroable::zeroed(); steps];
        self.device.read(&self.outcomes, 0, bytemuck::cast_slice_mut(&mut found))?;
        let mut losses: Vec<_> = found.iter().map(|outcome| outcome.loss).collect();
        self.average_over_devices(&mut losses)?;
        let outcome = |(outcome, loss): (&common::Outcome, f32)| Outcome {
            loss,
            gradient_norm: outcome.gradient_norm,
            not_finite: outcome.not_finite != 0,
        };
        Ok(found.iter().zip(losses).map(outcome).collect())
    }
}
