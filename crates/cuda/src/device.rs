//! What the networks need of a device: memory, kernels, products, queues, recorded steps. A GPU has it,
//! and in tests the emulator.

#![expect(unsafe_code, reason = "launches cannot be checked by the compiler")]

use std::any::Any;

use crate::{error::Result, kernels::Kernel};

/// A place in the memory of a device (bytes); 0 is nowhere.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Address(pub u64);

impl Address {
    /// Nowhere: what a kernel gets for data that it is not to use.
    pub const NULL: Self = Self(0);

    /// The place so many numbers of 4 bytes further on.
    #[must_use]
    pub fn plus(self, numbers: usize) -> Self {
        Self(self.0 + 4 * numbers as u64)
    }

    /// The place so many bytes further on.
    #[must_use]
    pub fn plus_bytes(self, bytes: usize) -> Self {
        Self(self.0 + bytes as u64)
    }
}

/// Memory of a device, given back when it is dropped.
pub struct Buffer {
    address: Address,
    bytes: usize,
    /// What gives it back.
    _owner: Box<dyn Any + Send + Sync>,
}

impl Buffer {
    /// Memory that `owner` gives back when it is dropped.
    ///
    /// # Safety
    /// The device must have as many bytes there until then.
    pub unsafe fn new(address: Address, bytes: usize, owner: impl Any + Send + Sync) -> Self {
        Self { address, bytes, _owner: Box::new(owner) }
    }

    /// Where it starts.
    pub fn address(&self) -> Address {
        self.address
    }

    /// Its size.
    pub fn bytes(&self) -> usize {
        self.bytes
    }

    /// Where `bytes` bytes from `offset` on start.
    ///
    /// # Panics
    /// If they reach beyond the end.
    pub fn part(&self, offset: usize, bytes: usize) -> Address {
        let end = offset.checked_add(bytes);
        assert!(
            end.is_some_and(|end| end <= self.bytes),
            "{bytes} bytes at {offset} of {}",
            self.bytes
        );
        self.address.plus_bytes(offset)
    }
}

/// Memory of the host that a device reads and writes itself, given back when it is dropped.
pub struct HostBuffer {
    address: Address,
    bytes: usize,
    /// What gives it back.
    _owner: Box<dyn Any + Send + Sync>,
}

impl HostBuffer {
    /// Memory that `owner` gives back when it is dropped.
    ///
    /// # Safety
    /// The address must be that of as many bytes, aligned to 16, until then.
    pub unsafe fn new(address: Address, bytes: usize, owner: impl Any + Send + Sync) -> Self {
        Self { address, bytes, _owner: Box::new(owner) }
    }

    /// Where it starts, for the device and for the host.
    pub fn address(&self) -> Address {
        self.address
    }

    /// The memory as a list.
    ///
    /// # Safety
    /// No work of the device that uses this memory may run while the list is used.
    pub unsafe fn slice<T: bytemuck::Pod>(&mut self) -> &mut [T] {
        // SAFETY: the constructor's promise; any bytes are a `T`; `&mut self` keeps out other lists.
        unsafe {
            let first = std::ptr::with_exposed_provenance_mut(self.address.0 as usize);
            std::slice::from_raw_parts_mut(first, self.bytes / size_of::<T>())
        }
    }

    /// The memory as a list that cannot be changed.
    ///
    /// # Safety
    /// No work of the device that writes this memory may run while the list is used.
    pub unsafe fn view<T: bytemuck::Pod>(&self) -> &[T] {
        // SAFETY: as in `slice`.
        unsafe {
            let first = std::ptr::with_exposed_provenance(self.address.0 as usize);
            std::slice::from_raw_parts(first, self.bytes / size_of::<T>())
        }
    }
}

/// Which queue work is put into. Work in one queue runs in order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Queue {
    /// The one that results are read from.
    Main,
    /// Runs beside it.
    Side,
    /// Runs beside both: kernels that fetch data out of the memory of the host.
    Fetch,
    /// Runs beside all: what devices exchange, and what waits for that.
    Exchange,
}

/// A device's place among those that train together, each on its part of every batch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rank {
    /// Its number, from 0.
    pub number: usize,
    /// How many there are.
    pub count: usize,
}

impl Rank {
    /// The only one.
    pub const ALONE: Self = Self { number: 0, count: 1 };
}

/// Largest value passed to a kernel (bytes): `struct Frames` has 76.
const ARGUMENT_BYTES: usize = 80;

/// A value passed to a kernel: a number, an address, or a struct of C.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(8))]
pub struct Argument([u8; ARGUMENT_BYTES]);

impl Argument {
    /// From the bytes of a value as C has it.
    ///
    /// # Panics
    /// When there are more than 80.
    pub fn from_bytes(bytes: &[u8]) -> Self {
        let mut all = [0; ARGUMENT_BYTES];
        all[..bytes.len()].copy_from_slice(bytes);
        Self(all)
    }
}

impl From<Address> for Argument {
    fn from(value: Address) -> Self {
        Self::from_bytes(&value.0.to_le_bytes())
    }
}

impl From<u64> for Argument {
    fn from(value: u64) -> Self {
        Self::from_bytes(&value.to_le_bytes())
    }
}

impl From<f32> for Argument {
    fn from(value: f32) -> Self {
        Self::from_bytes(&value.to_le_bytes())
    }
}

/// A C int: sizes and counts, all below 2^31.
impl From<usize> for Argument {
    fn from(value: usize) -> Self {
        let value = i32::try_from(value).expect("sizes are checked before work starts");
        Self::from_bytes(&value.to_le_bytes())
    }
}

/// Blocks of a grid along y and along z, at most.
pub const MOST_BLOCKS: usize = 65_535;

/// The blocks and threads of a launch.
#[derive(Clone, Copy, Debug)]
pub struct Shape {
    /// Blocks along x, y, z.
    pub grid: [usize; 3],
    /// Threads of a block along x, y.
    pub block: [usize; 2],
    /// Dynamic shared memory of a block (bytes).
    pub shared: usize,
}

impl Shape {
    /// Blocks of `threads` in a row, in a grid of two dimensions.
    pub fn new(x: usize, y: usize, threads: usize) -> Self {
        Self { grid: [x, y, 1], block: [threads, 1], shared: 0 }
    }
}

/// A factor of a product, row by row in memory.
#[derive(Clone, Copy, Debug)]
pub struct Factor {
    /// Where it is.
    pub at: Address,
    /// Numbers from a row to the next one.
    pub stride: usize,
    /// Whether it is stored the other way round.
    pub transposed: bool,
}

/// `result[rows, columns] = left[rows, inner] right[inner, columns]`, or added to it.
#[derive(Clone, Copy, Debug)]
pub struct Product {
    /// The left factor.
    pub left: Factor,
    /// The right factor.
    pub right: Factor,
    /// The result.
    pub result: Address,
    /// Numbers from a row of the result to the next one.
    pub stride: usize,
    /// Rows, inner size, columns.
    pub sizes: [usize; 3],
    /// Whether the product is added to what is there.
    pub add: bool,
}

/// Work that was recorded once and is repeated without its launches.
pub trait Recording {
    /// Repeats it, in the main queue.
    ///
    /// # Errors
    /// [`CudaError::Call`](crate::CudaError::Call).
    fn repeat(&self) -> Result<()>;
}

/// A device.
pub trait Device: Send + Sync {
    /// Memory, all zero.
    ///
    /// # Errors
    /// [`CudaError::Call`](crate::CudaError::Call), as of all that follows.
    fn allocate(&self, bytes: usize) -> Result<Buffer>;

    /// Memory of the host that the device reads and writes itself, all zero.
    ///
    /// # Errors
    /// As above.
    fn allocate_host(&self, bytes: usize) -> Result<HostBuffer>;

    /// Whether products are to be computed from factors in TF32, on tensor cores.
    fn rounds_to_tf32(&self) -> bool;

    /// Memory that is free (bytes).
    ///
    /// # Errors
    /// As above.
    fn free_memory(&self) -> Result<u64>;

    /// Copies to the device, after what is in the main queue; returns when the bytes may be changed. `offset` is in bytes.
    ///
    /// # Errors
    /// As above.
    ///
    /// # Panics
    /// If the buffer is too short, as all copies.
    fn write(&self, to: &Buffer, offset: usize, bytes: &[u8]) -> Result<()>;

    /// Copies from the device, after what is in the main queue; returns when the bytes are there.
    ///
    /// # Errors
    /// As above.
    fn read(&self, from: &Buffer, offset: usize, bytes: &mut [u8]) -> Result<()>;

    /// Copies a buffer to another of the same size, in the main queue.
    ///
    /// # Errors
    /// As above.
    fn copy(&self, to: &Buffer, from: &Buffer) -> Result<()>;

    /// Sets memory to zero, in a queue.
    ///
    /// # Errors
    /// As above.
    fn clear(&self, queue: Queue, buffer: &Buffer) -> Result<()>;

    /// Puts a kernel into a queue.
    ///
    /// # Safety
    /// The arguments must be those of the kernel, in type and order, and the memory they name must be as large as
    /// the kernel and the shape ask for.
    ///
    /// # Errors
    /// As above.
    unsafe fn launch(
        &self,
        queue: Queue,
        kernel: Kernel,
        shape: Shape,
        arguments: &[Argument],
    ) -> Result<()>;

    /// Puts a product into a queue.
    ///
    /// # Safety
    /// The memory must be as large as the sizes and strides ask for.
    ///
    /// # Errors
    /// As above.
    unsafe fn multiply(&self, queue: Queue, product: &Product) -> Result<()>;

    /// Its place among the devices that train together; by default it is alone.
    fn rank(&self) -> Rank {
        Rank::ALONE
    }

    /// Replaces numbers by their means over the devices that train together, which all call this in the same order, and get the
    /// same bits.
    ///
    /// # Safety
    /// The memory must have as many.
    ///
    /// # Errors
    /// As above.
    unsafe fn average(&self, _queue: Queue, _at: Address, _numbers: usize) -> Result<()> {
        Ok(())
    }

    /// Ends its waiting for other devices, now and later, since one of them has failed.
    fn leave_group(&self) {}

    /// Lets one queue go on only after what is in the other one now. By default, work is done when its call returns, and
    /// there is nothing to wait for.
    ///
    /// # Errors
    /// As above.
    fn wait(&self, _queue: Queue, _for_queue: Queue) -> Result<()> {
        Ok(())
    }

    /// Records what `work` puts into the queues, without running it; `None`, the default, where a device cannot, and
    /// `work` is to be called each time.
    ///
    /// # Errors
    /// As above, and those of `work`.
    fn record(
        &self,
        _work: &mut dyn FnMut() -> Result<()>,
    ) -> Result<Option<Box<dyn Recording + Send>>> {
        Ok(None)
    }

    /// Waits for all work; by default, it is done.
    ///
    /// # Errors
    /// As above.
    fn finish(&self) -> Result<()> {
        Ok(())
    }
}
