//! The memory that a training of the particle model needs, before any of it is taken.

use std::sync::Arc;

use eddy_inference::{checkpoint::Description, kernels::rest_shape::RestShape};

use super::{Constants, Store, StoreWriter, Training};
use crate::{
    device::Device,
    error::{CudaError, Result},
    training::{Counter, LIBRARIES, Settings},
};

/// Memory of a device for steps of the largest of several stages, the network for validation, and streams of so many particles
/// and frames (bytes).
///
/// # Errors
/// [`CudaError::Unsupported`].
pub fn bytes(
    description: &Description,
    stages: &[Settings],
    streams: &[(usize, usize)],
) -> Result<u64> {
    Constants::of(description)?;
    let counter = Arc::new(Counter::default());
    let most = streams.iter().map(|&(particles, _)| particles).max().unwrap_or(0);
    let mut store = StoreWriter::new(&*counter, most, 0)?;
    let rest = RestShape::new(&[], &[], 1, 0.0);
    store.stream(&[], [&rest, &rest], 0.0);
    let store = Arc::new(store.finish()?);
    counter.take();
    let mut largest = 0;
    for settings in stages {
        Training::new(counter.clone(), store.clone(), description, settings)?;
        largest = largest.max(counter.take());
    }
    Ok(largest + Store::bytes(streams.iter().copied()) + LIBRARIES)
}

/// Checks that a device has room for the largest of several stages on streams of so many particles and frames.
///
/// # Errors
/// [`CudaError::Memory`], [`CudaError::Unsupported`].
pub fn check(
    device: &dyn Device,
    number: usize,
    description: &Description,
    stages: &[Settings],
    streams: &[(usize, usize)],
) -> Result<()> {
    let (needed, free) = (bytes(description, stages, streams)?, device.free_memory()?);
    if needed <= free {
        return Ok(());
    }
    let remedy = match Store::bytes(streams.iter().copied()) > free / 2 {
        true => "use fewer or shorter scenes",
        false => "use a smaller windows.batch, or fewer frames of unroll",
    };
    Err(CudaError::Memory { device: number, needed: needed >> 20, free: free >> 20, remedy })
}
