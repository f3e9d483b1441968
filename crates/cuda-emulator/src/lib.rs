//! A device made of the CPU, for tests where there is no GPU: the same text of the kernels, compiled by g++, with
//! products as plain sums. It finds wrong indices and formulas; it says nothing about speed.

#![expect(unsafe_code, reason = "memory and functions of a library compiled at run time")]

use std::{
    collections::HashMap,
    ffi::{CString, c_char, c_void},
    fs,
    process::Command,
    sync::{Arc, Condvar, Mutex, MutexGuard, OnceLock, PoisonError},
};

use libloading::Library;

use eddy_cuda::{
    CudaError, Result,
    device::{Buffer, Device, HostBuffer, MOST_BLOCKS, Pointer, Product, Queue, Rank, Shape},
    kernels::Program,
};

/// What every kernel of the library is called by: its name, grid, block and arguments; false if there is none of this name.
type Launch = unsafe extern "C" fn(*const c_char, *const u32, *const u32, *mut *mut c_void) -> bool;

/// The device.
pub struct Emulator {
    /// The kernels keep blocks and fibers in static memory: one launch at a time.
    library: Arc<Mutex<Library>>,
    /// Whether the encoder multiplies as tensor cores do. Other products are exact.
    tf32: bool,
    peers: Option<Peers>,
}

/// Membership in a group of devices, each driven by a thread of its own.
struct Peers {
    rank: Rank,
    group: Arc<Group>,
}

/// What the devices of a group share.
struct Group {
    exchange: Mutex<Exchange>,
    changed: Condvar,
}

/// An exchange between devices.
struct Exchange {
    /// The numbers of each device that are to be averaged.
    numbers: Vec<Vec<f32>>,
    /// Devices that have brought theirs.
    arrived: usize,
    /// Exchanges that are complete.
    complete: u64,
    /// The means of the last one.
    means: Vec<f32>,
    /// Whether a device has left.
    left: bool,
}

impl Group {
    fn exchange(&self) -> MutexGuard<'_, Exchange> {
        self.exchange.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Compiled libraries by their text.
type Libraries = HashMap<String, Arc<Mutex<Library>>>;

/// Those of this process, whose tests share them.
static LIBRARIES: OnceLock<Mutex<Libraries>> = OnceLock::new();

impl Emulator {
    /// Compiles the kernels of a program.
    ///
    /// # Errors
    /// [`CudaError::Compile`] with what g++ says, or that there is none.
    pub fn new(program: &dyn Program) -> Result<Self> {
        let source = text(program);
        let mut known = LIBRARIES
            .get_or_init(Mutex::default)
            .lock()
            .unwrap_or_else(|broken| broken.into_inner());
        if let Some(library) = known.get(&source) {
            return Ok(Self { library: library.clone(), tf32: false, peers: None });
        }
        let library = Arc::new(Mutex::new(compile(&source)?));
        known.insert(source, library.clone());
        Ok(Self { library, tf32: false, peers: None })
    }
}

impl Emulator {
    /// So many devices that train together.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn group(program: &dyn Program, count: usize) -> Result<Vec<Self>> {
        let numbers = vec![Vec::new(); count];
        let exchange =
            Exchange { numbers, arrived: 0, complete: 0, means: Vec::new(), left: false };
        let group = Arc::new(Group { exchange: Mutex::new(exchange), changed: Condvar::new() });
        let member = |number| {
            let peers = Peers { rank: Rank { number, count }, group: group.clone() };
            Ok(Self { peers: Some(peers), ..Self::new(program)? })
        };
        (0..count).map(member).collect()
    }

    /// The same, with an encoder whose factors are rounded to TF32.
    #[must_use]
    pub fn with_tf32(self) -> Self {
        Self { tf32: true, ..self }
    }
}

/// Constants, emulator, kernels, and one function that calls any of them by its name.
fn text(program: &dyn Program) -> String {
    let mut text = String::from(include_str!("emulator.cpp"));
    for (name, value) in program.definitions() {
        text += &format!("#define {name} {value}\n");
    }
    text += &program.checked_source();
    text += "extern \"C\" __attribute__((visibility(\"default\"))) bool launch(const char* kernel, const unsigned* grid, const unsigned* block, void** a) {\n";
    for kernel in program.kernels() {
        text += &format!(
            "  if (!std::strcmp(kernel, \"{kernel}\")) return call({kernel}, grid, block, a), true;\n"
        );
    }
    text + "  return false;\n}\n"
}

fn compile(source: &str) -> Result<Library> {
    let failed = |log: String| CudaError::Compile { log };
    let folder = tempfile::tempdir().map_err(|reason| failed(reason.to_string()))?;
    let [input, output] = ["kernels.cpp", "kernels.so"].map(|name| folder.path().join(name));
    fs::write(&input, source).map_err(|reason| failed(reason.to_string()))?;
    // Hidden: kernels must not be taken for functions of the C library of the same name.
    let compiler = Command::new("g++")
        .args([
            "-std=c++17",
            "-O1",
            "-shared",
            "-fPIC",
            "-fvisibility=hidden",
            "-fno-gnu-unique",
            "-Wno-unknown-pragmas",
            // It takes jumps between fibers for errors.
            "-U_FORTIFY_SOURCE",
            "-o",
        ])
        .arg(&output)
        .arg(&input)
        .output()
        .map_err(|reason| failed(format!("g++: {reason}")))?;
    if !compiler.status.success() {
        return Err(failed(String::from_utf8_lossy(&compiler.stderr).into_owned()));
    }
    // SAFETY: the library is the one just compiled; loading it runs no code but constructors of the C++ library. It
    // stays mapped when the folder goes.
    unsafe { Library::new(&output) }.map_err(|reason| failed(reason.to_string()))
}

/// The example of the README, run as a test.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

fn pointer(address: u64) -> *mut u8 {
    address as *mut u8
}

impl Device for Emulator {
    fn allocate(&self, bytes: usize) -> Result<Buffer> {
        let mut memory = vec![0u128; bytes.div_ceil(16).max(1)];
        let address = memory.as_mut_ptr().expose_provenance() as u64;
        // SAFETY: the list is that long, and does not move when its owner does.
        Ok(unsafe { Buffer::new(address, bytes, memory) })
    }

    fn allocate_host(&self, bytes: usize) -> Result<HostBuffer> {
        let mut memory = vec![0u128; bytes.div_ceil(16).max(1)];
        let address = memory.as_mut_ptr().expose_provenance() as u64;
        // SAFETY: as in `allocate`.
        Ok(unsafe { HostBuffer::new(address, bytes, memory) })
    }

    fn rounds_to_tf32(&self) -> bool {
        self.tf32
    }

    fn free_memory(&self) -> Result<u64> {
        Ok(u64::MAX)
    }

    fn copy(&self, to: &Buffer, from: &Buffer) -> Result<()> {
        let bytes = from.bytes();
        // SAFETY: both buffers are that long, which `part` checks.
        unsafe {
            std::ptr::copy(pointer(from.part(0, bytes)), pointer(to.part(0, bytes)), bytes);
        }
        Ok(())
    }

    fn write(&self, to: &Buffer, offset: usize, bytes: &[u8]) -> Result<()> {
        let to = pointer(to.part(offset, bytes.len()));
        // SAFETY: `part` checks the length.
        unsafe { std::ptr::copy_nonoverlapping(bytes.as_ptr(), to, bytes.len()) };
        Ok(())
    }

    fn read(&self, from: &Buffer, offset: usize, bytes: &mut [u8]) -> Result<()> {
        let from = pointer(from.part(offset, bytes.len()));
        // SAFETY: as above.
        unsafe { std::ptr::copy_nonoverlapping(from, bytes.as_mut_ptr(), bytes.len()) };
        Ok(())
    }

    fn clear(&self, _: Queue, buffer: &Buffer) -> Result<()> {
        // SAFETY: the buffer has that many bytes.
        unsafe { std::ptr::write_bytes(pointer(buffer.address()), 0, buffer.bytes()) };
        Ok(())
    }

    unsafe fn launch_named(
        &self,
        _: Queue,
        kernel: &'static str,
        shape: Shape,
        arguments: &mut [*mut c_void],
    ) -> Result<()> {
        // As the driver refuses it.
        if shape.grid[1..].iter().any(|&blocks| blocks > MOST_BLOCKS) {
            let reason = format!("{shape:?}, expected at most {MOST_BLOCKS} blocks along y and z");
            return Err(CudaError::Call { call: kernel, reason });
        }
        let grid = shape.grid.map(|size| size as u32);
        let block = shape.block.map(|size| size as u32);
        let name = CString::new(kernel).expect("the name of a kernel");
        let library = self.library.lock().unwrap_or_else(|broken| broken.into_inner());
        // SAFETY: the library has this function, see `text`; the arguments are the caller's promise.
        let found = unsafe {
            let launch = library
                .get::<Launch>(b"launch")
                .map_err(|reason| CudaError::Call { call: "dlsym", reason: reason.to_string() })?;
            launch(name.as_ptr(), grid.as_ptr(), block.as_ptr(), arguments.as_mut_ptr())
        };
        if found { Ok(()) } else { Err(CudaError::unknown_kernel(kernel)) }
    }

    fn rank(&self) -> Rank {
        self.peers.as_ref().map_or(Rank::ALONE, |peers| peers.rank)
    }

    unsafe fn average(&self, _: Queue, at: Pointer<f32>, numbers: usize) -> Result<()> {
        let Some(Peers { rank, group }) = &self.peers else { return Ok(()) };
        // SAFETY: the caller's promise.
        let here =
            unsafe { std::slice::from_raw_parts_mut(pointer(at.address()).cast::<f32>(), numbers) };
        let mut exchange = group.exchange();
        exchange.numbers[rank.number] = here.to_vec();
        exchange.arrived += 1;
        if exchange.arrived == rank.count {
            let Exchange { numbers, means, .. } = &mut *exchange;
            let mean = |number: usize| {
                numbers.iter().map(|of| of[number]).sum::<f32>() / rank.count as f32
            };
            *means = (0..here.len()).map(mean).collect();
            exchange.arrived = 0;
            exchange.complete += 1;
            group.changed.notify_all();
        } else {
            let complete = exchange.complete;
            let waits = |state: &mut Exchange| state.complete == complete && !state.left;
            exchange =
                group.changed.wait_while(exchange, waits).unwrap_or_else(PoisonError::into_inner);
            if exchange.complete == complete {
                let reason = "another device of the group has failed".to_owned();
                return Err(CudaError::Call { call: "average", reason });
            }
        }
        // The next exchange is complete only when this device has come again.
        here.copy_from_slice(&exchange.means);
        Ok(())
    }

    fn leave_group(&self) {
        if let Some(Peers { group, .. }) = &self.peers {
            group.exchange().left = true;
            group.changed.notify_all();
        }
    }

    unsafe fn multiply(&self, _: Queue, product: &Product) -> Result<()> {
        let [rows, inner, columns] = product.sizes;
        let at = |list: Pointer<f32>, index| (list.address() as *mut f32).wrapping_add(index);
        for row in 0..rows {
            for column in 0..columns {
                let mut sum = 0f64;
                for i in 0..inner {
                    let left = match product.left.transposed {
                        false => row * product.left.stride + i,
                        true => i * product.left.stride + row,
                    };
                    let right = match product.right.transposed {
                        false => i * product.right.stride + column,
                        true => column * product.right.stride + i,
                    };
                    // SAFETY: the sizes are the caller's promise.
                    sum += unsafe {
                        f64::from(*at(product.left.at, left))
                            * f64::from(*at(product.right.at, right))
                    };
                }
                let to = at(product.result, row * product.stride + column);
                // SAFETY: as above.
                unsafe { *to = if product.add { *to } else { 0.0 } + sum as f32 };
            }
        }
        Ok(())
    }
}
