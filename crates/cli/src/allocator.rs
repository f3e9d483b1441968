//! An option of the memory allocator.
#![expect(unsafe_code, reason = "an option of the allocator")]

use std::ffi::{c_int, c_long};

/// mimalloc's option "milliseconds before freed pages are returned to the system".
const PURGE_DELAY: c_int = 15;

/// Keeps freed memory for the rest of the process. A training step frees and allocates arrays as large as the network;
/// pages returned to the system in between would have to be cleared again.
pub fn keep_freed_memory() {
    const NEVER: c_long = -1;
    // SAFETY: stores a number in a table of options; the index is part of mimalloc's interface
    // (`mi_option_purge_delay`).
    unsafe { libmimalloc_sys::mi_option_set(PURGE_DELAY, NEVER) }
}
