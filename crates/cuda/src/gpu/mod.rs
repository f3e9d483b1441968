//! An NVIDIA GPU through the driver: a context, streams, kernels, products, graphs.
//!
//! 1. `library`: which of the libraries that are loaded at run time are there.
//! 2. `compile`: the kernels' text to machine code, kept on disk.
//! 3. `products`: products by cuBLASLt.
//! 4. `peers`: several GPUs that train together, by NCCL.

#![expect(unsafe_code, reason = "calls of the driver and its libraries")]

mod compile;
mod library;
mod peers;
mod products;

pub use compile::{Target, compile};
pub use library::{GpuDescription, check, list};

pub use eddy_inference::engine::Precision;

use std::{
    collections::{BTreeMap, HashMap},
    ffi::c_void,
    path::Path,
    sync::{Arc, Mutex, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard},
};

use cudarc::{
    driver::{
        CudaContext, CudaFunction, CudaGraph, CudaSlice, CudaStream, DevicePtr as _, result, sys,
    },
    nvrtc::Ptx,
};

use crate::{
    device::{Buffer, Device, HostBuffer, Pointer, Product, Queue, Rank, Recording, Shape},
    error::{Context as _, CudaError, Result},
    kernels::Program,
};
use peers::{GroupId, Peers};
use products::Products;

/// Keeps apart, on one device, the recording of graphs from calls that get memory, modules or handles, or give them back.
///
/// All GPUs of this type that a process has on a device are in one context. A call that waits for the whole context, or for
/// a stream that is recorded, spoils the recordings of all threads (CUDA Programming Guide, "Prohibited and Unhandled
/// Operations").
#[derive(Clone)]
struct Recordings(Arc<RwLock<()>>);

impl Recordings {
    /// Those of a device.
    fn of(device: usize) -> Self {
        static ALL: Mutex<BTreeMap<usize, Recordings>> = Mutex::new(BTreeMap::new());
        let mut all = ALL.lock().unwrap_or_else(PoisonError::into_inner);
        all.entry(device).or_insert_with(|| Self(Arc::default())).clone()
    }

    /// Waits until none is made; none is begun before the guard is dropped. Not for work that may itself be recorded.
    fn wait(&self) -> RwLockReadGuard<'_, ()> {
        self.0.read().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits until no thread has a guard of [`Self::wait`].
    fn begin(&self) -> RwLockWriteGuard<'_, ()> {
        self.0.write().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A GPU, ready to compute with the kernels of a program.
pub struct Gpu {
    number: usize,
    precision: Precision,
    /// Dropped before the streams that it works in.
    peers: Option<Peers>,
    context: Arc<CudaContext>,
    streams: [Arc<CudaStream>; 4],
    kernels: HashMap<String, CudaFunction>,
    products: Products,
    recordings: Recordings,
}

impl Drop for Gpu {
    fn drop(&mut self) {
        let _guard = self.recordings.wait();
        // The last use of the module.
        self.kernels.clear();
    }
}

impl Gpu {
    /// GPU number `device`. Compiled kernels are kept in the folder `cache`, if there is one.
    ///
    /// # Errors
    /// [`CudaError`]: no driver, a library missing, no such GPU, a call that failed.
    pub fn new(
        device: usize,
        program: &dyn Program,
        precision: Precision,
        cache: Option<&Path>,
    ) -> Result<Self> {
        check(device)?;
        let recordings = Recordings::of(device);
        let context = {
            let _guard = recordings.wait();
            CudaContext::new(device).context("cuCtxCreate")?
        };
        // SAFETY: memory is used in the streams of this struct only, which wait for each other by hand;
        // tracking would record events into graphs.
        unsafe { context.disable_event_tracking() };
        let stream = || context.new_stream().context("cuStreamCreate");
        let streams = [stream()?, stream()?, stream()?, stream()?];
        let (major, minor) = context.compute_capability().context("cuDeviceGetAttribute")?;
        let target = Target::Machine(major as u32 * 10 + minor as u32);
        let (source, definitions) = (program.checked_source(), program.definitions());
        let load = |image| {
            let _guard = recordings.wait();
            context.load_module(Ptx::from_binary(image)).context("cuModuleLoadData")
        };
        let module = match load(compile::cached(&source, &definitions, target, cache)?) {
            Ok(module) => module,
            // A damaged file, or one of another compiler of the same version.
            Err(_) if cache.is_some() => {
                load(compile::compiled_anew(&source, &definitions, target, cache)?)?
            }
            Err(error) => return Err(error),
        };
        let mut kernels = HashMap::new();
        for kernel in program.kernels() {
            let function = module.load_function(&kernel).context("cuModuleGetFunction")?;
            kernels.insert(kernel, function);
        }
        let products = Products::new(&streams[0], precision, &recordings)?;
        Ok(Self {
            number: device,
            precision,
            peers: None,
            context,
            streams,
            kernels,
            products,
            recordings,
        })
    }

    /// GPUs of these numbers as a group that trains together.
    ///
    /// # Errors
    /// As [`Self::new`]; without NCCL, [`CudaError::MissingLibrary`].
    pub fn group(
        numbers: std::ops::Range<usize>,
        program: &dyn Program,
        precision: Precision,
        cache: Option<&Path>,
    ) -> Result<Vec<Self>> {
        let (id, count) = (GroupId::new()?, numbers.len());
        let gpus = numbers.map(|number| Self::new(number, program, precision, cache));
        let gpus = gpus.collect::<Result<Vec<_>>>()?;
        // Each waits for the others.
        std::thread::scope(|scope| {
            let join = |(number, mut gpu): (usize, Self)| {
                scope.spawn(move || gpu.join(id, Rank { number, count }).map(|()| gpu))
            };
            let threads: Vec<_> = gpus.into_iter().enumerate().map(join).collect();
            let joined = |thread: std::thread::ScopedJoinHandle<'_, Result<Self>>| {
                thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
            };
            threads.into_iter().map(joined).collect()
        })
    }

    /// Joins a group of GPUs that train together; returns when all have joined.
    ///
    /// # Errors
    /// [`CudaError::MissingLibrary`], [`CudaError::Call`].
    fn join(&mut self, id: GroupId, rank: Rank) -> Result<()> {
        self.context.bind_to_thread().context("cuCtxSetCurrent")?;
        self.peers = Some(Peers::join(id, rank)?);
        Ok(())
    }

    fn stream(&self, queue: Queue) -> &Arc<CudaStream> {
        &self.streams[match queue {
            Queue::Main => 0,
            Queue::Side => 1,
            Queue::Fetch => 2,
            Queue::Exchange => 3,
        }]
    }

    /// Milliseconds that `work` takes on the device.
    ///
    /// # Errors
    /// [`CudaError::Call`], and those of `work`.
    pub fn time(&self, work: impl FnOnce() -> Result<()>) -> Result<f32> {
        let flags = Some(sys::CUevent_flags::CU_EVENT_DEFAULT);
        let from = self.streams[0].record_event(flags).context("cuEventRecord")?;
        work()?;
        let to = self.streams[0].record_event(flags).context("cuEventRecord")?;
        from.elapsed_ms(&to).context("cuEventElapsedTime")
    }
}

/// Lets a kernel have that much dynamic shared memory.
fn allow_shared(function: &CudaFunction, bytes: usize) -> Result<()> {
    use sys::CUfunction_attribute_enum::CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES;
    let bytes = i32::try_from(bytes).unwrap_or(i32::MAX);
    function
        .set_attribute(CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES, bytes)
        .context("cuFuncSetAttribute")
}

/// Dynamic shared memory that a kernel may have without asking (bytes).
const SHARED_LIMIT: usize = (48 << 10) - STATIC_SHARED;
/// Static shared memory of the kernels that have dynamic shared memory, at most (bytes).
const STATIC_SHARED: usize = 1 << 10;

impl Device for Gpu {
    fn allocate(&self, bytes: usize) -> Result<Buffer> {
        self.context.bind_to_thread().context("cuCtxSetCurrent")?;
        let _guard = self.recordings.wait();
        let memory: CudaSlice<u8> = match self.streams[0].alloc_zeros(bytes.max(16)) {
            Err(cudarc::driver::DriverError(sys::CUresult::CUDA_ERROR_OUT_OF_MEMORY)) => {
                return Err(CudaError::Memory {
                    device: self.number,
                    needed: (bytes as u64).div_ceil(1 << 20),
                    free: self.free_memory()? >> 20,
                    remedy: "use a smaller windows.batch or fewer scenes for training, fewer streams for a node",
                });
            }
            memory => memory.context("cuMemAlloc")?,
        };
        let address = memory.device_ptr(&self.streams[0]).0;
        // SAFETY: the driver has given as many bytes, which are freed with their owner.
        Ok(unsafe { Buffer::new(address, bytes, Memory::new(memory, &self.recordings)) })
    }

    fn allocate_host(&self, bytes: usize) -> Result<HostBuffer> {
        self.context.bind_to_thread().context("cuCtxSetCurrent")?;
        let guard = self.recordings.wait();
        // SAFETY: memory is read only after it is cleared.
        let memory = unsafe { result::malloc_host(bytes.max(16), sys::CU_MEMHOSTALLOC_DEVICEMAP) };
        let memory = Pinned {
            memory: memory.context("cuMemHostAlloc")?,
            context: self.context.clone(),
            recordings: self.recordings.clone(),
        };
        drop(guard);
        // SAFETY: the driver has given as many bytes, aligned to a page, which are freed with their owner. In the unified
        // address space of 64-bit systems the device has them at the same address.
        unsafe {
            memory.memory.cast::<u8>().write_bytes(0, bytes);
            Ok(HostBuffer::new(memory.memory.expose_provenance() as u64, bytes, memory))
        }
    }

    fn rounds_to_tf32(&self) -> bool {
        self.precision == Precision::Tf32
    }

    fn free_memory(&self) -> Result<u64> {
        let (free, _) = self.context.mem_get_info().context("cuMemGetInfo")?;
        Ok(free as u64)
    }

    fn write(&self, to: &Buffer, offset: usize, bytes: &[u8]) -> Result<()> {
        let to = to.part(offset, bytes.len());
        self.context.bind_to_thread().context("cuCtxSetCurrent")?;
        // In the main stream: a copy in the default stream is not ordered before its launches.
        // SAFETY: `part` checks the length; the bytes live until the stream is done.
        unsafe { result::memcpy_htod_async(to, bytes, self.streams[0].cu_stream()) }
            .context("cuMemcpyHtoDAsync")?;
        self.streams[0].synchronize().context("cuStreamSynchronize")
    }

    fn read(&self, from: &Buffer, offset: usize, bytes: &mut [u8]) -> Result<()> {
        let from = from.part(offset, bytes.len());
        self.context.bind_to_thread().context("cuCtxSetCurrent")?;
        // SAFETY: as above.
        unsafe { result::memcpy_dtoh_async(bytes, from, self.streams[0].cu_stream()) }
            .context("cuMemcpyDtoHAsync")?;
        self.streams[0].synchronize().context("cuStreamSynchronize")
    }

    fn copy(&self, to: &Buffer, from: &Buffer) -> Result<()> {
        self.context.bind_to_thread().context("cuCtxSetCurrent")?;
        let bytes = from.bytes();
        let (to, from) = (to.part(0, bytes), from.part(0, bytes));
        // SAFETY: `part` checks the length.
        unsafe { result::memcpy_dtod_async(to, from, bytes, self.streams[0].cu_stream()) }
            .context("cuMemcpyDtoDAsync")
    }

    fn clear(&self, queue: Queue, buffer: &Buffer) -> Result<()> {
        self.context.bind_to_thread().context("cuCtxSetCurrent")?;
        let (at, bytes) = (buffer.address(), buffer.bytes());
        // SAFETY: the buffer has that many bytes.
        unsafe { result::memset_d8_async(at, 0, bytes, self.stream(queue).cu_stream()) }
            .context("cuMemsetD8Async")
    }

    unsafe fn launch_named(
        &self,
        queue: Queue,
        kernel: &'static str,
        shape: Shape,
        arguments: &mut [*mut c_void],
    ) -> Result<()> {
        self.context.bind_to_thread().context("cuCtxSetCurrent")?;
        let Some(function) = self.kernels.get(kernel) else {
            return Err(CudaError::unknown_kernel(kernel));
        };
        if shape.shared > SHARED_LIMIT {
            allow_shared(function, shape.shared)?;
        }
        let [x, y, z] = shape.grid.map(|size| size as u32);
        let [threads, rows] = shape.block.map(|size| size as u32);
        // SAFETY: the caller's promise; the driver copies the arguments before it returns.
        unsafe {
            result::launch_kernel(
                function.cu_function(),
                (x, y, z),
                (threads, rows, 1),
                shape.shared as u32,
                self.stream(queue).cu_stream(),
                arguments,
            )
        }
        .context(kernel)
    }

    unsafe fn multiply(&self, queue: Queue, product: &Product) -> Result<()> {
        let workspace = match queue {
            Queue::Main => 0,
            Queue::Side => 1,
            Queue::Fetch | Queue::Exchange => unreachable!("a queue without products"),
        };
        // SAFETY: the caller's promise.
        unsafe { self.products.multiply(self.stream(queue), workspace, product) }
    }

    fn rank(&self) -> Rank {
        self.peers.as_ref().map_or(Rank::ALONE, |peers| peers.rank)
    }

    fn leave_group(&self) {
        if let Some(peers) = &self.peers {
            peers.abort();
        }
    }

    unsafe fn average(&self, queue: Queue, at: Pointer<f32>, numbers: usize) -> Result<()> {
        let Some(peers) = &self.peers else { return Ok(()) };
        self.context.bind_to_thread().context("cuCtxSetCurrent")?;
        // SAFETY: the caller's promise.
        unsafe { peers.average(at, numbers, self.stream(queue).cu_stream().cast()) }
    }

    fn wait(&self, queue: Queue, for_queue: Queue) -> Result<()> {
        self.stream(queue).join(self.stream(for_queue)).context("cuStreamWaitEvent")
    }

    fn record(
        &self,
        work: &mut dyn FnMut() -> Result<()>,
    ) -> Result<Option<Box<dyn Recording + Send>>> {
        // `work` has run once before: products have their algorithms, kernels are loaded.
        self.finish()?;
        let guard = self.recordings.begin();
        let stream = &self.streams[0];
        stream
            .begin_capture(sys::CUstreamCaptureMode::CU_STREAM_CAPTURE_MODE_THREAD_LOCAL)
            .context("cuStreamBeginCapture")?;
        let outcome = work();
        let graph =
            stream.end_capture(sys::CUgraphInstantiate_flags(0)).context("cuStreamEndCapture");
        drop(guard);
        outcome?;
        Ok(graph?.map(|graph| Box::new(Graph(graph)) as Box<dyn Recording + Send>))
    }

    fn finish(&self) -> Result<()> {
        self.streams
            .iter()
            .try_for_each(|stream| stream.synchronize())
            .context("cuStreamSynchronize")
    }
}

/// Memory of the device, until it is dropped.
struct Memory {
    slice: Option<CudaSlice<u8>>,
    recordings: Recordings,
}

impl Memory {
    fn new(slice: CudaSlice<u8>, recordings: &Recordings) -> Self {
        Self { slice: Some(slice), recordings: recordings.clone() }
    }
}

impl Drop for Memory {
    fn drop(&mut self) {
        let _guard = self.recordings.wait();
        self.slice = None;
    }
}

/// Memory of the host that the driver has pinned.
struct Pinned {
    memory: *mut c_void,
    context: Arc<CudaContext>,
    recordings: Recordings,
}

// SAFETY: the memory belongs to no thread.
unsafe impl Send for Pinned {}
// SAFETY: likewise; it is freed only.
unsafe impl Sync for Pinned {}

impl Drop for Pinned {
    fn drop(&mut self) {
        let _guard = self.recordings.wait();
        // A failure here has no remedy.
        let _ = self.context.bind_to_thread();
        // SAFETY: it was allocated so, and nobody uses it any more.
        let _ = unsafe { result::free_host(self.memory) };
    }
}

/// A recorded step.
struct Graph(CudaGraph);

// SAFETY: a graph may be launched from any thread, one at a time.
unsafe impl Send for Graph {}

impl Recording for Graph {
    fn repeat(&self) -> Result<()> {
        self.0.launch().context("cuGraphLaunch")
    }
}
