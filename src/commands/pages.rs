//! Memory that training uses again and again.
#![expect(unsafe_code, reason = "an option of the allocator")]

use std::ffi::{c_int, c_long};

/// mimalloc's option "milliseconds before freed pages are given back to the system".
const PURGE_DELAY: c_int = 15;

/// Keeps freed pages for the rest of the process. A training step frees and allocates lists as large as
/// the network; given back in between, each page would have to be cleared anew by the system.
pub(crate) fn keep_freed() {
    const NEVER: c_long = -1;
    // SAFETY: a number is stored in a table of options; the number of this one is part of mimalloc's
    // interface (`mi_option_purge_delay`).
    unsafe { libmimalloc_sys::mi_option_set(PURGE_DELAY, NEVER) }
}
