//! Simulates a disk with a bad sector. Preloaded into a program (`LD_PRELOAD`), it makes reads of some bytes of
//! one file fail, as Linux does for a bad sector (EIO; the bytes before it are read).
//!
//! `BAD_SECTOR_FILE` names the file, `BAD_SECTOR_START` and `BAD_SECTOR_END` the range of bytes.
//! Compiled by the test that uses it: `rustc --crate-type cdylib bad_sector.rs`.

use std::{
    env,
    ffi::{c_int, c_long, c_void},
    fs, io,
    sync::OnceLock,
};

unsafe extern "C" {
    fn lseek(file: c_int, offset: i64, from: c_int) -> i64;
    fn syscall(number: c_long, ...) -> c_long;
    fn __errno_location() -> *mut c_int;
}

const SEEK_CUR: c_int = 1;
const EIO: c_int = 5;
#[cfg(target_arch = "x86_64")]
const READ: c_long = 0;
#[cfg(not(target_arch = "x86_64"))]
const READ: c_long = 63;

struct Sector {
    file: String,
    start: i64,
    end: i64,
}

fn sector() -> Option<&'static Sector> {
    static SECTOR: OnceLock<Option<Sector>> = OnceLock::new();
    let number = |name: &str| env::var(name).ok()?.parse().ok();
    let read = || {
        let file = env::var("BAD_SECTOR_FILE").ok()?;
        Some(Sector { file, start: number("BAD_SECTOR_START")?, end: number("BAD_SECTOR_END")? })
    };
    SECTOR.get_or_init(read).as_ref()
}

/// How many of the requested bytes can be read.
fn readable(file: c_int, count: usize) -> io::Result<usize> {
    let Some(sector) = sector() else { return Ok(count) };
    let path = fs::read_link(format!("/proc/self/fd/{file}"));
    if !path.is_ok_and(|path| path.to_string_lossy() == sector.file) {
        return Ok(count);
    }
    // SAFETY: no memory is involved.
    let position = unsafe { lseek(file, 0, SEEK_CUR) };
    if (sector.start..sector.end).contains(&position) {
        return Err(io::Error::from_raw_os_error(EIO));
    }
    let before = usize::try_from(sector.start - position).unwrap_or(usize::MAX);
    Ok(count.min(before))
}

/// Replaces the C library's `read`.
///
/// # Safety
/// Same as the C library's.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn read(file: c_int, into: *mut c_void, count: usize) -> isize {
    match readable(file, count) {
        // SAFETY: the caller's guarantees are passed on; `count` is at most what the caller requested.
        Ok(count) => unsafe { syscall(READ, file, into, count) as isize },
        Err(_) => {
            // SAFETY: `errno` is thread-local.
            unsafe { *__errno_location() = EIO };
            -1
        }
    }
}
