//! What can go wrong on a GPU, each with what to do about it.

use std::path::PathBuf;

/// An error of the GPU or of what it needs.
#[derive(Debug, thiserror::Error)]
pub enum CudaError {
    /// There is no NVIDIA driver on this machine.
    #[error(
        "device: found no NVIDIA driver (libcuda.so.1), expected one; omit --device cuda to compute on the processor"
    )]
    NoDriver,
    /// A library is missing that is loaded at run time.
    #[error(
        "device: {library} of CUDA 13 not found; install the CUDA toolkit, or `pip install {package}` and add its lib \
         folder to LD_LIBRARY_PATH"
    )]
    MissingLibrary {
        /// File name without extension.
        library: &'static str,
        /// The package of PyPI that has it.
        package: &'static str,
    },
    /// A GPU of this number is not there.
    #[error("device: found no GPU {found}, expected {expected}")]
    NoSuchDevice {
        /// The number that was asked for.
        found: usize,
        /// The numbers there are, in words.
        expected: String,
    },
    /// The GPU has too little memory.
    #[error("GPU {device}: {needed} MiB more memory needed, {free} MiB free; {remedy}")]
    Memory {
        /// The GPU's number.
        device: usize,
        /// Memory needed (MiB).
        needed: u64,
        /// Memory free (MiB).
        free: u64,
        /// Which setting helps.
        remedy: &'static str,
    },
    /// A call of the driver or of a library failed.
    #[error("GPU: {call} failed: {reason}")]
    Call {
        /// What was called.
        call: &'static str,
        /// What the library says.
        reason: String,
    },
    /// The kernels do not compile.
    #[error("kernels: {log}")]
    Compile {
        /// The compiler's messages.
        log: String,
    },
    /// The folder of compiled kernels cannot be used.
    #[error("{}: {reason}", file.display())]
    File {
        /// The file.
        file: PathBuf,
        /// Why.
        reason: std::io::Error,
    },
    /// The network or a setting is not supported on a GPU yet.
    #[error("device cuda: {setting} is not supported, expected {expected}")]
    Unsupported {
        /// The setting and its value.
        setting: String,
        /// What is.
        expected: &'static str,
    },
}

impl CudaError {
    /// A launch of a kernel that the device's program does not have.
    pub fn unknown_kernel(kernel: &'static str) -> Self {
        Self::Call { call: kernel, reason: "the program has no kernel of this name".to_owned() }
    }
}

/// A result of this crate.
pub type Result<T> = std::result::Result<T, CudaError>;

/// Names the call in the error of a library.
pub(crate) trait Context<T> {
    /// The same, with the call's name.
    fn context(self, call: &'static str) -> Result<T>;
}

impl<T, E: std::fmt::Debug> Context<T> for std::result::Result<T, E> {
    fn context(self, call: &'static str) -> Result<T> {
        self.map_err(|reason| CudaError::Call { call, reason: format!("{reason:?}") })
    }
}
