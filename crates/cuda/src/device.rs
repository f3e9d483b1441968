//! What the networks need of a device: memory, kernels, products, queues, recorded steps. A GPU has it,
//! and in tests the emulator.

#![expect(unsafe_code, reason = "launches cannot be checked by the compiler")]

use std::{any::Any, ffi::c_void, fmt, marker::PhantomData, ops::Deref};

use crate::error::Result;

/// Where numbers or structs of a type begin in the memory of a device.
///
/// ```compile_fail
/// use eddy_cuda::device::Pointer;
/// let numbers: Pointer<u32> = Pointer::<f32>::NULL;
/// ```
#[repr(transparent)]
pub struct Pointer<T>(u64, PhantomData<fn() -> T>);

impl<T> Pointer<T> {
    /// Nowhere: what a kernel gets for data that it is not to use.
    pub const NULL: Self = Self::at(0);

    /// At an address.
    pub const fn at(address: u64) -> Self {
        Self(address, PhantomData)
    }

    /// The address.
    pub const fn address(self) -> u64 {
        self.0
    }

    /// The place so many items further on.
    #[must_use]
    pub const fn plus(self, items: usize) -> Self {
        Self::at(self.0 + (items * size_of::<T>()) as u64)
    }

    /// The same place for items of another type.
    #[must_use]
    pub const fn cast<U>(self) -> Pointer<U> {
        Pointer::at(self.0)
    }
}

impl<T> Clone for Pointer<T> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<T> Copy for Pointer<T> {}

impl<T> Default for Pointer<T> {
    fn default() -> Self {
        Self::NULL
    }
}

impl<T> fmt::Debug for Pointer<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:#x}", self.0)
    }
}

// SAFETY: an integer; any value is an address.
unsafe impl<T: 'static> bytemuck::Zeroable for Pointer<T> {}
// SAFETY: as above.
unsafe impl<T: 'static> bytemuck::Pod for Pointer<T> {}

/// Memory of a device, given back when it is dropped.
pub struct Buffer {
    address: u64,
    bytes: usize,
    /// What gives it back.
    _owner: Box<dyn Any + Send + Sync>,
}

impl Buffer {
    /// Memory that `owner` gives back when it is dropped.
    ///
    /// # Safety
    /// The device must have as many bytes there until then.
    pub unsafe fn new(address: u64, bytes: usize, owner: impl Any + Send + Sync) -> Self {
        Self { address, bytes, _owner: Box::new(owner) }
    }

    /// Where it starts.
    pub fn address(&self) -> u64 {
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
    pub fn part(&self, offset: usize, bytes: usize) -> u64 {
        let end = offset.checked_add(bytes);
        assert!(
            end.is_some_and(|end| end <= self.bytes),
            "{bytes} bytes at {offset} of {}",
            self.bytes
        );
        self.address + offset as u64
    }
}

/// A list in the memory of a device.
pub(crate) struct List<T> {
    buffer: Buffer,
    items: PhantomData<fn() -> T>,
}

impl<T: bytemuck::Pod> List<T> {
    /// So many items, all zero.
    pub(crate) fn new(device: &dyn Device, items: usize) -> Result<Self> {
        Ok(Self { buffer: device.allocate(size_of::<T>() * items)?, items: PhantomData })
    }

    /// A copy of these.
    pub(crate) fn of(device: &dyn Device, items: &[T]) -> Result<Self> {
        let list = Self::new(device, items.len())?;
        device.write(&list, 0, bytemuck::cast_slice(items))?;
        Ok(list)
    }

    /// Where it begins.
    pub(crate) fn pointer(&self) -> Pointer<T> {
        Pointer::at(self.buffer.address)
    }
}

impl<T> From<List<T>> for Buffer {
    fn from(list: List<T>) -> Self {
        list.buffer
    }
}

impl<T> Deref for List<T> {
    type Target = Buffer;

    fn deref(&self) -> &Buffer {
        &self.buffer
    }
}

/// Memory of the host that a device reads and writes itself, given back when it is dropped.
pub struct HostBuffer {
    address: u64,
    bytes: usize,
    /// What gives it back.
    _owner: Box<dyn Any + Send + Sync>,
}

impl HostBuffer {
    /// Memory that `owner` gives back when it is dropped.
    ///
    /// # Safety
    /// The address must be that of as many bytes, aligned to 16, until then.
    pub unsafe fn new(address: u64, bytes: usize, owner: impl Any + Send + Sync) -> Self {
        Self { address, bytes, _owner: Box::new(owner) }
    }

    /// Where it starts, for the device and for the host.
    pub fn pointer<T>(&self) -> Pointer<T> {
        Pointer::at(self.address)
    }

    /// The memory as a list.
    ///
    /// # Safety
    /// No work of the device that uses this memory may run while the list is used.
    pub unsafe fn slice<T: bytemuck::Pod>(&mut self) -> &mut [T] {
        // SAFETY: the constructor's promise; any bytes are a `T`; `&mut self` keeps out other lists.
        unsafe {
            let first = std::ptr::with_exposed_provenance_mut(self.address as usize);
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
            let first = std::ptr::with_exposed_provenance(self.address as usize);
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

/// The arguments of a kernel. `build.rs` implements it for all kernels in the `.cu` files.
pub trait Kernel {
    /// The kernel's name.
    const NAME: &'static str;

    /// Where the arguments are, in the kernel's order.
    fn arguments(&self) -> Vec<*mut c_void>;
}

/// A size or a count as a kernel takes it.
///
/// # Panics
/// If it is too large: settings are checked before work starts.
pub(crate) fn count<T: TryFrom<usize>>(number: usize) -> T {
    let Ok(count) = number.try_into() else { panic!("{number} is too large for a kernel") };
    count
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
    pub at: Pointer<f32>,
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
    pub result: Pointer<f32>,
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

    /// Puts a kernel into a queue; the method `launch` takes typed arguments.
    ///
    /// # Safety
    /// The arguments must point to values of the kernel's types in its order, and the memory these name must be as large as
    /// the kernel and the shape ask for.
    ///
    /// # Errors
    /// As above.
    unsafe fn launch_named(
        &self,
        queue: Queue,
        kernel: &'static str,
        shape: Shape,
        arguments: &mut [*mut c_void],
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
    unsafe fn average(&self, _queue: Queue, _at: Pointer<f32>, _numbers: usize) -> Result<()> {
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

impl dyn Device + '_ {
    /// Puts a kernel into a queue.
    ///
    /// # Safety
    /// The memory that its arguments name must be as large as the kernel and the shape ask for.
    ///
    /// # Errors
    /// [`CudaError::Call`](crate::CudaError::Call).
    pub(crate) unsafe fn launch<K: Kernel>(
        &self,
        queue: Queue,
        shape: Shape,
        kernel: &K,
    ) -> Result<()> {
        // SAFETY: the arguments are fields of `kernel`, which `build.rs` has declared as the kernel does; the caller's promise.
        unsafe { self.launch_named(queue, K::NAME, shape, &mut kernel.arguments()) }
    }
}
