//! The memory that a training needs, before any of it is taken.

#![expect(unsafe_code, reason = "memory that is counted only")]

use std::sync::{
    Arc,
    atomic::{AtomicU64, Ordering},
};

use eddy_inference::checkpoint::{Description, initial_weights};

use super::{Inference, Settings, StoreWriter, Training};
use crate::{
    device::{Address, Argument, Buffer, Device, HostBuffer, Product, Queue, Recording, Shape},
    error::{CudaError, Result},
    kernels::{Constants, Kernel},
};

/// Memory that the libraries take for themselves, with the workspaces of products (bytes).
const LIBRARIES: u64 = 256 << 20;

/// Memory of a device for steps of these settings, the network for validation, and streams of so many frames in all
/// (bytes).
///
/// # Errors
/// [`CudaError::Unsupported`].
pub fn bytes(description: &Description, settings: &Settings, frames: usize) -> Result<u64> {
    let counter = Arc::new(Counter::default());
    let particles = Constants::of(description)?.particles;
    let mut store = StoreWriter::new(&*counter, particles, frames)?;
    store.stream(&vec![0; particles]);
    let store = Arc::new(store.finish()?);
    Training::new(counter.clone(), store, description, settings)?;
    Inference::new(counter.clone(), description, &initial_weights(description, 0))?;
    Ok(counter.taken.load(Ordering::Relaxed) + LIBRARIES)
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
    let free = device.free_memory()?;
    for settings in stages {
        let needed = bytes(description, settings, frames)?;
        if needed > free {
            let particles = Constants::of(description)?.particles;
            let streams = super::Store::bytes(frames, particles);
            return Err(CudaError::Memory {
                device: number,
                needed: needed >> 20,
                free: free >> 20,
                remedy: match streams > needed / 2 {
                    true => "use fewer or shorter scenes",
                    false => "use a smaller windows.batch, or fewer frames of unroll",
                },
            });
        }
    }
    Ok(())
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

    fn wait(&self, _: Queue, _: Queue) -> Result<()> {
        Ok(())
    }

    fn record(
        &self,
        _: &mut dyn FnMut() -> Result<()>,
    ) -> Result<Option<Box<dyn Recording + Send>>> {
        Ok(None)
    }

    fn finish(&self) -> Result<()> {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use eddy_inference::checkpoint::{Architecture, Core, Sizes};

    fn settings(batch: usize) -> Settings {
        Settings {
            batch,
            warm_up: 2,
            unroll: 1,
            relative: false,
            observed_weight: 0.0,
            density_weight: 0.0,
            density_nodes: 32,
            dropout: 0.0,
            noise: [0.0, 0.0],
            clip: f32::INFINITY,
            epsilon: 1e-8,
            average: false,
        }
    }

    #[test]
    fn the_memory_of_the_papers_training_is_known_and_too_much_of_it_is_refused() {
        let sizes = Sizes { encoder: 256, hidden: 1250, layers: 2, particles: Some(2500) };
        let description = Description::untrained(Architecture::Frame, Core::MinGru, sizes);
        let needed = bytes(&description, &settings(256), 1000).unwrap();
        // 14.4 million weights with gradients, two moments and a copy for validation; trajectories and states of a batch,
        // 16 bytes a particle.
        let least = 5 * 4 * 14_397_304 + 16 * 2500 * (1000 + 2 * 256);
        assert!((least..2 * least + (512 << 20)).contains(&needed), "{needed}, at least {least}");
        let more = bytes(&description, &settings(512), 1000).unwrap();
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
