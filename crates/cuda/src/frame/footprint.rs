//! The memory that a training needs, before any of it is taken.

use std::{collections::BTreeMap, sync::Arc};

use eddy_inference::checkpoint::Description;

use super::{Inference, Place, Store, StoreWriter, Training};
use crate::{
    device::Device,
    error::{CudaError, Result},
    kernels::Constants,
    training::{Counter, LIBRARIES, Settings},
};

/// Memory of a device for steps of the largest of several stages, the network for validation, and streams of so many frames
/// in all that lie in this place (bytes).
///
/// # Errors
/// [`CudaError::Unsupported`].
pub fn bytes(
    description: &Description,
    stages: &[Settings],
    frames: usize,
    place: Place,
) -> Result<u64> {
    let counter = Arc::new(Counter::default());
    let particles = Constants::of(description)?.particles;
    let mut store = StoreWriter::new(&*counter, particles, frames, place)?;
    store.stream(&vec![0; particles]);
    let store = Arc::new(store.finish()?);
    Inference::new(counter.clone(), description, &BTreeMap::new())?;
    let common = counter.take();
    let mut largest = 0;
    for settings in stages {
        Training::new(counter.clone(), store.clone(), description, settings)?;
        largest = largest.max(counter.take());
    }
    Ok(common + largest + LIBRARIES)
}

/// Where streams of so many frames in all are to lie, for the largest of several stages: on the device if they fit there, or in
/// the memory of the host, of which so much is free (bytes).
///
/// # Errors
/// [`CudaError::Memory`], [`CudaError::Unsupported`].
pub fn place(
    device: &dyn Device,
    number: usize,
    description: &Description,
    stages: &[Settings],
    frames: usize,
    host_free: u64,
) -> Result<Place> {
    let free = device.free_memory()?;
    let needed = |place| bytes(description, stages, frames, place);
    let refused = |needed: u64, remedy| {
        Err(CudaError::Memory { device: number, needed: needed >> 20, free: free >> 20, remedy })
    };
    let all = needed(Place::Device)?;
    if all <= free {
        return Ok(Place::Device);
    }
    let steps = needed(Place::Host)?;
    if steps > free {
        return refused(steps, "use a smaller windows.batch, or fewer frames of unroll");
    }
    if Store::bytes(frames, Constants::of(description)?.particles) > host_free {
        return refused(all, "use fewer or shorter scenes");
    }
    Ok(Place::Host)
}

#[cfg(test)]
mod tests {
    use super::*;
    use eddy_inference::checkpoint::{Architecture, Core, Sizes};

    fn settings(batch: usize) -> Settings {
        Settings { observed_weight: 0.0, ..Settings::plain(batch, 2) }
    }

    #[test]
    fn the_memory_of_the_papers_training_is_known_and_streams_that_do_not_fit_stay_on_the_host() {
        let sizes = Sizes { encoder: 256, hidden: 1250, layers: 2, particles: Some(2500) };
        let description = Description::untrained(Architecture::Frame, Core::MinGru, sizes);
        let bytes = |batch| bytes(&description, &[settings(batch)], 1000, Place::Device).unwrap();
        let needed = bytes(256);
        // 14.4 million weights with gradients, two moments and a copy for validation; trajectories and states of a batch,
        // 16 bytes a particle.
        let least = 5 * 4 * 14_397_304 + 16 * 2500 * (1000 + 2 * 256);
        assert!((least..2 * least + (512 << 20)).contains(&needed), "{needed}, at least {least}");
        let more = bytes(512);
        assert!(more > needed + 16 * 2500 * 512, "{more} after {needed}");

        let free = needed + (64 << 20);
        let device = Counter::with_free(free);
        let place = |batch, frames| {
            let stages = [settings(256), settings(batch)];
            place(&device, 1, &description, &stages, frames, 5 << 30)
        };
        assert_eq!(place(256, 1000).unwrap(), Place::Device);
        // 4.7 GiB of 5 that the host has free, and 7.
        assert_eq!(place(256, 125_000).unwrap(), Place::Host);
        for (batch, frames, remedy) in
            [(1024, 1000, "a smaller windows.batch"), (256, 190_000, "fewer or shorter scenes")]
        {
            let message = place(batch, frames).unwrap_err().to_string();
            let free = format!("{} MiB free", free >> 20);
            for part in ["GPU 1: ", free.as_str(), remedy] {
                assert!(message.contains(part), "`{part}` is not in: {message}");
            }
        }
    }
}
