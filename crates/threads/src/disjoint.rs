//! One slice, written by several threads.

use std::{marker::PhantomData, ops::Range};

/// A mutable slice whose disjoint parts are borrowed by several threads at once.
#[derive(Clone, Copy, Debug)]
pub struct DisjointSlice<'a, T> {
    start: *mut T,
    length: usize,
    slice: PhantomData<&'a mut [T]>,
}

// SAFETY: a `DisjointSlice` is a `&mut [T]`; callers of `part` and `read` guarantee that no part is aliased.
unsafe impl<T: Send + Sync> Sync for DisjointSlice<'_, T> {}

impl<'a, T> DisjointSlice<'a, T> {
    /// Borrows the slice.
    pub fn new(slice: &'a mut [T]) -> Self {
        Self { start: slice.as_mut_ptr(), length: slice.len(), slice: PhantomData }
    }

    /// Length of the slice.
    #[inline(always)]
    pub fn len(&self) -> usize {
        self.length
    }

    /// Whether the slice is empty.
    pub fn is_empty(&self) -> bool {
        self.length == 0
    }

    /// A part to write.
    ///
    /// # Safety
    /// While the part is borrowed, no other thread borrows any element of it.
    ///
    /// # Panics
    /// When the range exceeds the slice.
    #[inline(always)]
    #[expect(clippy::mut_from_ref, reason = "the safety section excludes aliasing")]
    pub unsafe fn part(&self, range: Range<usize>) -> &mut [T] {
        assert!(range.start <= range.end && range.end <= self.length);
        // SAFETY: the range is inside the slice; the caller excludes other borrows.
        unsafe { std::slice::from_raw_parts_mut(self.start.add(range.start), range.len()) }
    }

    /// A part to read.
    ///
    /// # Safety
    /// While the part is borrowed, no thread writes any element of it.
    ///
    /// # Panics
    /// When the range exceeds the slice.
    #[inline(always)]
    pub unsafe fn read(&self, range: Range<usize>) -> &[T] {
        assert!(range.start <= range.end && range.end <= self.length);
        // SAFETY: the range is inside the slice; the caller excludes writers.
        unsafe { std::slice::from_raw_parts(self.start.add(range.start), range.len()) }
    }
}
