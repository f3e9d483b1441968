//! The memory that a training needs, before any of it is taken.

#![expect(unsafe_code, reason = "memory that is counted only")]

use std::{
    collections::BTreeMap,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
};

use eddy_inference::checkpoint::Description;

use super::{Inference, Settings, Store, StoreWriter, Training};
use crate::{
    device::{Address, Argument, Buffer, Device, HostBuffer, Product, Queue, Shape},
    error::{CudaError, Result},
    kernels::{Constants, Kernel},
};

/// Memory that the libraries take for themselves, with the workspaces of products (bytes).
const LIBRARIES: u64 = 256 << 20;

/// Memory of a device for steps of the largest of several stages, the network for validation, and streams of so many frames
/// in all (bytes).
///
/// # Errors
/// [`CudaError::Unsupported`].
pub fn bytes(description: &Description, stages: &[Settings], frames: usize) -> Result<u64> {
    let counter = Arc::new(Counter::default());
    let particles = Constants::of(description)?.particles;
    let mut store = StoreWriter::new(&*counter, particles, frames)?;
    store.stream(&vec![0; particles]);
    let store = Arc::new(store.finish()?);
    Inference::new(counter.clone(), description, &BTreeMap::new())?;
    let common = counter.taken.swap(0, Ordering::Relaxed);
    let mut largest = 0;
    for settings in stages {
        Training::new(counter.clone(), store.clone(), description, settings)?;
        largest = largest.max(counter.taken.swap(0, Ordering::Relaxed));
    }
    Ok(common + largest + LIBRARIES)
}

/// Checks that a device has the memory for the largest of several stages.
///
/// # Errors
/// [`CudaError::Memory`], [`CudaError::Unsupported`].
pub fn check(
    device: &dyn Device,
    number: usize,
    description: &Description,
    stages: &[Settings],
    frames: usize,
) -> Result<()> {
    let (free, needed) = (device.free_memory()?, bytes(description, stages, frames)?);
    if needed <= free {
        return Ok(());
    }
    let streams = Store::bytes(frames, Constants::of(description)?.particles);
    Err(CudaError::Memory {
        device: number,
        needed: needed >> 20,
        free: free >> 20,
        remedy: match streams > needed / 2 {
            true => "use fewer or shorter scenes",
            false => "use a smaller windows.batch, or fewer frames of unroll",
        },
    })
}

/// A device that counts what is allocated, and does nothing else.
#[derive(Default)]
struct Counter {
    taken: AtomicU64,
    free: u64,
}

impl Device for Counter {
    fn allocate(&self, bytes: usize) -> Result<Buffer> {
        self.taken.fetch_add(bytes as u64, Ordering::Relaxed);
        // SAFETY: this device never uses its memory.
        Ok(unsafe { Buffer::new(Address::NULL, bytes, ()) })
    }

    fn allocate_host(&self, _: usize) -> Result<HostBuffer> {
        // SAFETY: an empty buffer is nowhere.
        Ok(unsafe { HostBuffer::new(Address::NULL, 0, ()) })
    }

    fn rounds_to_tf32(&self) -> bool {
        false
    }

    fn free_memory(&self) -> Result<u64> {
        Ok(self.free)
    }

    fn write(&self, _: &Buffer, _: usize, _: &[u8]) -> Result<()> {
        Ok(())
    }

    fn read(&self, _: &Buffer, _: usize, _: &mut [u8]) -> Result<()> {
        Ok(())
    }

    fn copy(&self, _: &Buffer, _: &Buffer) -> Result<()> {
        Ok(())
    }

    fn clear(&self, _: Queue, _: &Buffer) -> Result<()> {
        Ok(())
    }

    unsafe fn launch(&self, _: Queue, _: Kernel, _: Shape, _: &[Argument]) -> Result<()> {
        Ok(())
    }

    unsafe fn multiply(&self, _: Queue, _: &Product) -> Result<()> {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use eddy_inference::checkpoint::{Architecture, Core, Sizes};

    fn settings(batch: usize) -> Settings {
        Settings { observed_weight: 0.0, ..Settings::plain(batch, 2) }
    }

    #[test]
    fn the_memory_of_the_papers_training_is_known_and_too_much_of_it_is_refused() {
        let sizes = Sizes { encoder: 256, hidden: 1250, layers: 2, particles: Some(2500) };
        let description = Description::untrained(Architecture::Frame, Core::MinGru, sizes);
        let needed = bytes(&description, &[settings(256)], 1000).unwrap();
        // 14.4 million weights with gradients, two moments and a copy for validation; trajectories and states of a batch,
        // 16 bytes a particle.
        let least = 5 * 4 * 14_397_304 + 16 * 2500 * (1000 + 2 * 256);
        assert!((least..2 * least + (512 << 20)).contains(&needed), "{needed}, at least {least}");
        let more = bytes(&description, &[settings(512)], 1000).unwrap();
        assert!(more > needed + 16 * 2500 * 512, "{more} after {needed}");

        let device = Counter { free: needed, ..Counter::default() };
        let check = |batch, frames| {
            check(&device, 1, &description, &[settings(256), settings(batch)], frames)
        };
        check(256, 1000).unwrap();
        for (batch, frames, remedy) in
            [(512, 1000, "a smaller windows.batch"), (256, 100_000, "fewer or shorter scenes")]
        {
            let message = check(batch, frames).unwrap_err().to_string();
            let free = format!("{} MiB free", needed >> 20);
            for part in ["GPU 1: ", free.as_str(), remedy] {
                assert!(message.contains(part), "`{part}` is not in: {message}");
            }
        }
    }
}
