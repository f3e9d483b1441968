//! The memory that a training needs, before any of it is taken.

#![expect(unsafe_code, reason = "memory that is counted only")]

use std::{
    ffi::c_void,
    sync::atomic::{AtomicU64, Ordering},
};

use crate::{
    device::{Buffer, Device, HostBuffer, Product, Queue, Shape},
    error::Result,
};

/// Memory that the libraries take for themselves, with the workspaces of products (bytes).
pub(crate) const LIBRARIES: u64 = 256 << 20;

/// A device that counts what is allocated, and does nothing else.
#[derive(Default)]
pub(crate) struct Counter {
    taken: AtomicU64,
    free: u64,
}

impl Counter {
    /// One that has so much memory free (bytes).
    #[cfg(test)]
    pub(crate) fn with_free(free: u64) -> Self {
        Self { free, ..Self::default() }
    }

    /// What was allocated since the last call (bytes).
    pub(crate) fn take(&self) -> u64 {
        self.taken.swap(0, Ordering::Relaxed)
    }
}

impl Device for Counter {
    fn allocate(&self, bytes: usize) -> Result<Buffer> {
        self.taken.fetch_add(bytes as u64, Ordering::Relaxed);
        // SAFETY: this device never uses its memory.
        Ok(unsafe { Buffer::new(0, bytes, ()) })
    }

    /// Nothing of the device.
    fn allocate_host(&self, _: usize) -> Result<HostBuffer> {
        // SAFETY: an empty buffer is nowhere.
        Ok(unsafe { HostBuffer::new(0, 0, ()) })
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

    unsafe fn launch_named(
        &self,
        _: Queue,
        _: &'static str,
        _: Shape,
        _: &mut [*mut c_void],
    ) -> Result<()> {
        Ok(())
    }

    unsafe fn multiply(&self, _: Queue, _: &Product) -> Result<()> {
        Ok(())
    }
}
