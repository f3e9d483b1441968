//! What changes from step to step, in the memory of the device.

#![expect(unsafe_code, reason = "numbers that devices exchange")]

use std::sync::Arc;

use super::{Batch, GROUP, Outcome, Settings, Window, key, window::WORDS};
use crate::{
    device::{Buffer, Device, Queue},
    error::Result,
    kernels::{AXES, MATERIALS},
};
use eddy_inference::checkpoint::MOST_KNOTS;

/// Words of a `Schedule`.
const SCHEDULE: usize = 12 + MOST_KNOTS;

/// Windows, rates and weights of the steps that the host has prepared, and what came of them.
pub struct Tables {
    device: Arc<dyn Device>,
    /// Bodies of error weights of a step.
    weights: usize,
    /// Whether these differ from batch to batch.
    pub(crate) weights_differ: bool,
    batch: usize,
    /// `Window`s, `[steps, B]`.
    pub(crate) windows: Buffer,
    /// `Schedule`s, `[steps]`.
    pub(crate) schedule: Buffer,
    /// `Progress`.
    pub(crate) progress: Buffer,
    /// `Outcome`s, `[steps]`.
    pub(crate) outcomes: Buffer,
    /// Weights of squared errors, `[steps or 1, K, B, MATERIALS]` bodies.
    pub(crate) error_weights: Buffer,
    /// Losses to be averaged over the devices.
    losses: Buffer,
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
        let numbers = |count: usize| device.allocate(4 * count);
        let Settings { batch, unroll, .. } = *settings;
        let weights = unroll * batch * MATERIALS;
        let steps = if weights_differ { GROUP } else { 1 };
        Ok(Self {
            weights,
            weights_differ,
            batch,
            windows: numbers(GROUP * batch * WORDS)?,
            schedule: numbers(GROUP * SCHEDULE)?,
            progress: numbers(1)?,
            outcomes: numbers(GROUP * 4)?,
            error_weights: numbers(steps * weights * 2 * AXES)?,
            losses: numbers(GROUP)?,
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
                windows.extend(window.words(first(step, number, window)));
            }
            let Batch { rate, correction, kept, plain_rate, .. } = *batch;
            schedule.extend([rate, correction, kept, plain_rate].map(f32::to_bits));
            schedule.extend(key(batch.dropout));
            schedule.extend(batch.shares.map(f32::to_bits));
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
        unsafe { self.device.average(Queue::Main, self.losses.address(), numbers.len()) }?;
        self.device.read(&self.losses, 0, bytemuck::cast_slice_mut(numbers))
    }

    /// What came of the steps started last, for the whole batch.
    pub(super) fn outcomes(&self, steps: usize) -> Result<Vec<Outcome>> {
        assert!(steps <= GROUP, "{steps} steps, at most {GROUP}");
        let mut words = vec![[0u32; 4]; steps];
        self.device.read(&self.outcomes, 0, bytemuck::cast_slice_mut(&mut words))?;
        let mut losses: Vec<_> = words.iter().map(|&[loss, ..]| f32::from_bits(loss)).collect();
        self.average_over_devices(&mut losses)?;
        let outcome = |(&[_, norm, not_finite, _], loss): (&[u32; 4], f32)| Outcome {
            loss,
            gradient_norm: f32::from_bits(norm),
            not_finite: not_finite != 0,
        };
        Ok(words.iter().zip(losses).map(outcome).collect())
    }
}
