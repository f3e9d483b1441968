//! The kernels' text to machine code by NVRTC, which needs neither a driver nor a GPU; kept on disk by a hash of text,
//! options and compiler.

#![expect(unsafe_code, reason = "calls of the driver and its libraries")]

use std::{
    ffi::{CStr, CString},
    fs,
    path::{Path, PathBuf},
};

use cudarc::nvrtc;
use xxhash_rust::xxh3::xxh3_128;

use crate::error::{Context as _, CudaError, Result};

/// What is compiled for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Target {
    /// Machine code of a compute capability, 90 for 9.0.
    Machine(u32),
    /// PTX of a compute capability.
    Ptx(u32),
}

/// The options for the compiler.
fn options(definitions: &[(&str, usize)], target: Target) -> Vec<String> {
    let architecture = match target {
        Target::Machine(capability) => format!("sm_{capability}"),
        Target::Ptx(capability) => format!("compute_{capability}"),
    };
    let mut options = vec![
        format!("--gpu-architecture={architecture}"),
        "--std=c++17".to_owned(),
        "-default-device".to_owned(),
        "-DDYNAMIC_SHARED(type,name)=extern __shared__ type name[]".to_owned(),
    ];
    options.extend(definitions.iter().map(|(name, value)| format!("-D{name}={value}")));
    options
}

/// Compiles a text with these constants.
///
/// # Errors
/// [`CudaError::Compile`] with the compiler's messages, [`CudaError::MissingLibrary`].
pub fn compile(source: &str, definitions: &[(&str, usize)], target: Target) -> Result<Vec<u8>> {
    // SAFETY: looks for a file and loads it.
    if !unsafe { nvrtc::sys::is_culib_present() } {
        return Err(CudaError::MissingLibrary {
            library: "libnvrtc",
            package: "nvidia-cuda-nvrtc",
        });
    }
    let text = CString::new(source).context("the kernels' text")?;
    let program =
        nvrtc::result::create_program(&text, Some(c"eddy.cu")).context("nvrtcCreateProgram")?;
    // SAFETY: the program is one just made.
    if unsafe { nvrtc::result::compile_program(program, &options(definitions, target)) }.is_err() {
        // SAFETY: as above; a log ends with a zero.
        let log = unsafe {
            let log = nvrtc::result::get_program_log(program).context("nvrtcGetProgramLog")?;
            CStr::from_ptr(log.as_ptr()).to_string_lossy().into_owned()
        };
        return Err(CudaError::Compile { log });
    }
    let image = match target {
        // SAFETY: as above.
        Target::Ptx(_) => unsafe { nvrtc::result::get_ptx(program) }
            .context("nvrtcGetPTX")?
            .into_iter()
            .map(|byte| byte as u8)
            .take_while(|&byte| byte != 0) // it ends with a zero
            .collect(),
        Target::Machine(_) => {
            let mut size = 0;
            // SAFETY: as above; the image has the size that NVRTC says.
            unsafe {
                nvrtc::sys::nvrtcGetCUBINSize(program, &mut size)
                    .result()
                    .context("nvrtcGetCUBINSize")?;
                let mut image = vec![0u8; size];
                nvrtc::sys::nvrtcGetCUBIN(program, image.as_mut_ptr().cast())
                    .result()
                    .context("nvrtcGetCUBIN")?;
                image
            }
        }
    };
    // SAFETY: as above; it is not used any more.
    unsafe { nvrtc::result::destroy_program(program) }.context("nvrtcDestroyProgram")?;
    Ok(image)
}

/// The same, from the folder `cache` if it was compiled before. What cannot be read or kept there is compiled again.
pub(super) fn cached(
    source: &str,
    definitions: &[(&str, usize)],
    target: Target,
    cache: Option<&Path>,
) -> Result<Vec<u8>> {
    if let Some(file) = cached_file(source, definitions, target, cache)?
        && let Ok(image) = fs::read(file)
    {
        return Ok(image);
    }
    compiled_anew(source, definitions, target, cache)
}

/// Where a compiled text is kept.
fn cached_file(
    source: &str,
    definitions: &[(&str, usize)],
    target: Target,
    cache: Option<&Path>,
) -> Result<Option<PathBuf>> {
    let Some(folder) = cache else { return Ok(None) };
    let (mut major, mut minor) = (0, 0);
    // SAFETY: writes two numbers.
    let version = unsafe { nvrtc::sys::nvrtcVersion(&mut major, &mut minor) };
    version.result().context("nvrtcVersion")?;
    let key = format!("{source}\n{:?}\n{major}.{minor}", options(definitions, target));
    Ok(Some(folder.join(format!("{:032x}.cubin", xxh3_128(key.as_bytes())))))
}

/// Compiles, and keeps the result in the folder `cache`.
pub(super) fn compiled_anew(
    source: &str,
    definitions: &[(&str, usize)],
    target: Target,
    cache: Option<&Path>,
) -> Result<Vec<u8>> {
    let image = compile(source, definitions, target)?;
    if let (Some(folder), Some(file)) = (cache, cached_file(source, definitions, target, cache)?) {
        let partial = file.with_extension(format!("{}.part", std::process::id()));
        let kept = fs::create_dir_all(folder)
            .and_then(|()| fs::write(&partial, &image))
            .and_then(|()| fs::rename(&partial, &file));
        if let Err(reason) = kept {
            tracing::debug!("compiled kernels are not kept in {}: {reason}", folder.display());
        }
    }
    Ok(image)
}
