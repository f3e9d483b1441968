//! Which of the libraries that are loaded at run time are there, and which GPUs.

#![expect(unsafe_code, reason = "calls of the driver and its libraries")]

use cudarc::{cublaslt, driver, nvrtc};

use crate::error::{Context as _, CudaError, Result};

/// Asks for every library before the first call: a call of one that is not there would panic.
fn check_libraries() -> Result<()> {
    // SAFETY: these functions look for a file and load it; they have no other requirements.
    let [driver, nvrtc, cublaslt] = unsafe {
        [
            driver::sys::is_culib_present(),
            nvrtc::sys::is_culib_present(),
            cublaslt::sys::is_culib_present(),
        ]
    };
    let missing = |library, package| Err(CudaError::MissingLibrary { library, package });
    match (driver, nvrtc, cublaslt) {
        (false, ..) => Err(CudaError::NoDriver),
        (_, false, _) => missing("libnvrtc", "nvidia-cuda-nvrtc"),
        (.., false) => missing("libcublasLt", "nvidia-cublas"),
        _ => Ok(()),
    }
}

/// Checks that a GPU of this number is there, and the libraries that it needs.
///
/// # Errors
/// [`CudaError::NoDriver`], [`CudaError::MissingLibrary`], [`CudaError::NoSuchDevice`].
pub fn check(number: usize) -> Result<()> {
    check_libraries()?;
    check_number(number)
}

/// A GPU of this machine.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GpuDescription {
    /// Its number, as in `cuda:N`.
    pub number: usize,
    /// Its name.
    pub name: String,
    /// Its memory (bytes).
    pub memory: u64,
    /// Compute capability, such as 9.0.
    pub capability: (i32, i32),
    /// Multiprocessors.
    pub multiprocessors: i32,
}

/// All GPUs of this machine.
///
/// # Errors
/// [`CudaError::NoDriver`], [`CudaError::Call`].
pub fn list() -> Result<Vec<GpuDescription>> {
    (0..count()?).map(describe).collect()
}

fn count() -> Result<usize> {
    // SAFETY: as in `check_libraries`.
    if !unsafe { driver::sys::is_culib_present() } {
        return Err(CudaError::NoDriver);
    }
    driver::result::init().context("cuInit")?;
    let count = driver::result::device::get_count().context("cuDeviceGetCount")?;
    Ok(usize::try_from(count).unwrap_or_default())
}

/// Checks that a GPU of this number is there.
fn check_number(found: usize) -> Result<()> {
    let count = count()?;
    if found < count {
        return Ok(());
    }
    let expected = match count {
        0 => "a machine with a GPU".to_owned(),
        1 => "0, the only one".to_owned(),
        _ => format!("0 to {}", count - 1),
    };
    Err(CudaError::NoSuchDevice { found, expected })
}

fn describe(number: usize) -> Result<GpuDescription> {
    use driver::sys::CUdevice_attribute_enum as Attribute;
    let device = driver::result::device::get(number as i32).context("cuDeviceGet")?;
    // SAFETY: the device was returned by the driver just now.
    let attribute = |which| unsafe { driver::result::device::get_attribute(device, which) };
    let attribute = |which| attribute(which).context("cuDeviceGetAttribute");
    // SAFETY: as above.
    let memory =
        unsafe { driver::result::device::total_mem(device) }.context("cuDeviceTotalMem")?;
    Ok(GpuDescription {
        number,
        name: driver::result::device::get_name(device).context("cuDeviceGetName")?,
        memory: memory as u64,
        capability: (
            attribute(Attribute::CU_DEVICE_ATTRIBUTE_COMPUTE_CAPABILITY_MAJOR)?,
            attribute(Attribute::CU_DEVICE_ATTRIBUTE_COMPUTE_CAPABILITY_MINOR)?,
        ),
        multiprocessors: attribute(Attribute::CU_DEVICE_ATTRIBUTE_MULTIPROCESSOR_COUNT)?,
    })
}
