//! Several GPUs that train together, through NCCL, which is loaded at run time when there is more than one.

#![expect(unsafe_code, reason = "calls of NCCL")]

use std::{
    ffi::{CStr, c_char, c_int, c_void},
    sync::{
        OnceLock,
        atomic::{AtomicBool, Ordering},
    },
};

use libloading::Library;

use crate::{
    device::{Pointer, Rank},
    error::{CudaError, Result},
};

/// `ncclFloat32` and `ncclAvg` of nccl.h, since version 2.10.
const FLOAT32: c_int = 7;
const AVERAGE: c_int = 4;
/// Size of `ncclUniqueId` (bytes).
const ID: usize = 128;

/// Names a group of GPUs; all that join it have the same.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(C)]
pub(super) struct GroupId([u8; ID]);

type Communicator = *mut c_void;
type Status = c_int;

/// NCCL's functions.
struct Nccl {
    unique_id: unsafe extern "C" fn(*mut GroupId) -> Status,
    init_rank: unsafe extern "C" fn(*mut Communicator, c_int, GroupId, c_int) -> Status,
    all_reduce: unsafe extern "C" fn(
        *const c_void,
        *mut c_void,
        usize,
        c_int,
        c_int,
        Communicator,
        *mut c_void,
    ) -> Status,
    abort: unsafe extern "C" fn(Communicator) -> Status,
    error_string: unsafe extern "C" fn(Status) -> *const c_char,
    /// Keeps the functions in memory.
    _library: Library,
}

impl Nccl {
    /// The library, loaded once. It is never unloaded: it has threads of its own.
    fn get() -> Result<&'static Self> {
        static LOADED: OnceLock<Option<Nccl>> = OnceLock::new();
        let missing = CudaError::MissingLibrary { library: "libnccl", package: "nvidia-nccl-cu13" };
        LOADED.get_or_init(Self::load).as_ref().ok_or(missing)
    }

    fn load() -> Option<Self> {
        // SAFETY: loading NCCL runs its constructors, which have no requirements; the signatures are those of nccl.h.
        unsafe {
            let library = ["libnccl.so.2", "libnccl.so"]
                .into_iter()
                .find_map(|name| Library::new(name).ok())?;
            Some(Self {
                unique_id: *library.get(b"ncclGetUniqueId").ok()?,
                init_rank: *library.get(b"ncclCommInitRank").ok()?,
                all_reduce: *library.get(b"ncclAllReduce").ok()?,
                abort: *library.get(b"ncclCommAbort").ok()?,
                error_string: *library.get(b"ncclGetErrorString").ok()?,
                _library: library,
            })
        }
    }

    fn check(&self, call: &'static str, status: Status) -> Result<()> {
        if status == 0 {
            return Ok(());
        }
        // SAFETY: NCCL returns a text of its own for every status.
        let reason = unsafe { CStr::from_ptr((self.error_string)(status)) };
        Err(CudaError::Call { call, reason: reason.to_string_lossy().into_owned() })
    }
}

impl GroupId {
    /// Of a new group.
    ///
    /// # Errors
    /// [`CudaError::MissingLibrary`], [`CudaError::Call`].
    pub(super) fn new() -> Result<Self> {
        let nccl = Nccl::get()?;
        let mut id = Self([0; ID]);
        // SAFETY: NCCL writes as many bytes.
        nccl.check("ncclGetUniqueId", unsafe { (nccl.unique_id)(&raw mut id) })?;
        Ok(id)
    }
}

/// A GPU's membership in a group.
pub(super) struct Peers {
    nccl: &'static Nccl,
    communicator: Communicator,
    aborted: AtomicBool,
    pub(super) rank: Rank,
}

// SAFETY: a communicator may be used from any thread, one at a time, as a GPU's launches are.
unsafe impl Send for Peers {}
// SAFETY: likewise.
unsafe impl Sync for Peers {}

impl Peers {
    /// Joins a group with the GPU of the thread's context; returns when all have joined.
    pub(super) fn join(id: GroupId, rank: Rank) -> Result<Self> {
        let nccl = Nccl::get()?;
        let mut communicator = std::ptr::null_mut();
        let count = |number: usize| c_int::try_from(number).unwrap_or(c_int::MAX);
        // SAFETY: NCCL writes the communicator.
        let status = unsafe {
            (nccl.init_rank)(&raw mut communicator, count(rank.count), id, count(rank.number))
        };
        nccl.check("ncclCommInitRank", status)?;
        Ok(Self { nccl, communicator, aborted: AtomicBool::new(false), rank })
    }

    /// Ends the waiting for others.
    pub(super) fn abort(&self) {
        if !self.aborted.swap(true, Ordering::Relaxed) {
            // SAFETY: NCCL lets any thread abort, while calls of others run. A failure here has no remedy.
            let _ = unsafe { (self.nccl.abort)(self.communicator) };
        }
    }

    /// Replaces numbers by their means over the group.
    ///
    /// # Safety
    /// The memory must have as many, and `stream` be one of this GPU.
    pub(super) unsafe fn average(
        &self,
        at: Pointer<f32>,
        numbers: usize,
        stream: *mut c_void,
    ) -> Result<()> {
        if self.aborted.load(Ordering::Relaxed) {
            let reason = "another GPU of the group has failed".to_owned();
            return Err(CudaError::Call { call: "ncclAllReduce", reason });
        }
        let place = at.address() as *mut c_void;
        // SAFETY: the caller's promise.
        let status = unsafe {
            (self.nccl.all_reduce)(
                place,
                place,
                numbers,
                FLOAT32,
                AVERAGE,
                self.communicator,
                stream,
            )
        };
        self.nccl.check("ncclAllReduce", status)
    }
}

impl Drop for Peers {
    /// Does not wait for the others, who may be lost.
    fn drop(&mut self) {
        self.abort();
    }
}
