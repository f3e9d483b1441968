//! NumPy arrays: arguments that are read in place, and results that are views of the library's memory.
#![expect(unsafe_code, reason = "the memory of NumPy arrays, and arrays of the library's memory")]

use std::{fmt::Display, slice};

use numpy::{
    Element, IntoPyArray as _, PyArray, PyArrayDyn, PyArrayMethods as _, PyUntypedArray,
    PyUntypedArrayMethods as _,
    ndarray::{Array, ArrayView, ArrayView1, ArrayView2, Dimension, StrideShape},
};
use pyo3::{
    exceptions::{PyException, PyTypeError, PyValueError},
    intern,
    prelude::*,
};

/// The type of ordinary memory in the DLPack protocol (kDLCPU).
const CPU: i32 = 1;

/// An argument: an array in C order, whose memory is read in place. Python code that writes to it meanwhile changes the
/// numbers that are read, nothing else.
pub(crate) struct Argument<'py, T> {
    /// Keeps the memory.
    _array: Bound<'py, PyAny>,
    shape: Vec<usize>,
    data: *const T,
}

// SAFETY: the memory may be read from any thread; the array itself is only released on the thread that has the interpreter.
unsafe impl<T: Sync> Sync for Argument<'_, T> {}

impl<'py, T: Element> Argument<'py, T> {
    /// Takes a NumPy array, or another one that has the DLPack protocol (a PyTorch tensor on the CPU, for example). `shape`
    /// is the expected one, with `None` for any length.
    ///
    /// # Errors
    /// `TypeError` for what is no array, `ValueError` for a wrong type of elements, shape, order or device.
    pub(crate) fn new(
        name: &str,
        value: &Bound<'py, PyAny>,
        expected: &[Option<usize>],
    ) -> PyResult<Self> {
        let fits = |shape: &[usize]| {
            let mut axes = shape.iter().zip(expected);
            shape.len() == expected.len()
                && axes.all(|(&found, &length)| length.is_none_or(|length| length == found))
        };
        Self::checked(name, value, fits, || pattern(expected))
    }

    /// The same for an array of vectors in the plane or in space, `[N, 2]` or `[N, 3]`.
    ///
    /// # Errors
    /// As [`Argument::new`].
    pub(crate) fn vectors(name: &str, value: &Bound<'py, PyAny>) -> PyResult<Self> {
        let fits = |shape: &[usize]| matches!(shape, [_, 2 | 3]);
        Self::checked(name, value, fits, || "shape [N, 2] or [N, 3]".to_owned())
    }

    fn checked(
        name: &str,
        value: &Bound<'py, PyAny>,
        fits: impl FnOnce(&[usize]) -> bool,
        expected: impl FnOnce() -> String,
    ) -> PyResult<Self> {
        let array = numpy_array(name, value)?;
        let Ok(array) = array.cast::<PyArrayDyn<T>>() else {
            let expected = T::get_dtype(array.py());
            let expected = format!("{expected}: {name}.astype('{expected}')");
            return Err(wrong(name, format!("dtype {}", array.dtype()), expected));
        };
        let shape = array.shape().to_vec();
        if !fits(&shape) {
            return Err(wrong(name, format!("shape {shape:?}"), expected()));
        }
        if !array.is_c_contiguous() {
            let found = "an array with gaps or another order";
            return Err(wrong(name, found, "C order: numpy.ascontiguousarray"));
        }
        let data = array.data().cast_const();
        if !data.is_aligned() {
            return Err(wrong(name, "unaligned memory", "an aligned array: numpy.copy"));
        }
        Ok(Self { _array: array.clone().into_any(), shape, data })
    }

    /// Length of each axis.
    pub(crate) fn shape(&self) -> &[usize] {
        &self.shape
    }

    /// The elements, last axis fastest.
    pub(crate) fn as_slice(&self) -> &[T] {
        let length = self.shape.iter().product();
        if length == 0 {
            return &[];
        }
        // SAFETY: NumPy's array has as many elements of this type, aligned and without gaps, and lives as long as this.
        unsafe { slice::from_raw_parts(self.data, length) }
    }
}

impl Argument<'_, f32> {
    /// The elements of an array whose last axis has length `D`.
    pub(crate) fn rows<const D: usize>(&self) -> &[[f32; D]] {
        debug_assert_eq!(self.shape.last(), Some(&D));
        self.as_slice().as_chunks().0
    }
}

/// A NumPy array that shares the memory of the value.
fn numpy_array<'py>(name: &str, value: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyUntypedArray>> {
    if let Ok(array) = value.cast::<PyUntypedArray>() {
        return Ok(array.clone());
    }
    if !value.hasattr("__dlpack__")? {
        return Err(PyTypeError::new_err(format!(
            "{name}: found {}, expected a NumPy array or one with the DLPack protocol",
            value.get_type().name()?
        )));
    }
    let unshared = |error: PyErr| {
        let found = format!("an array that cannot be shared ({error})");
        // Ctrl-C is not a matter of the array.
        let is_its_own = error.is_instance_of::<PyException>(value.py());
        if is_its_own { wrong(name, found, "plain memory of the CPU") } else { error }
    };
    let device = value.call_method0("__dlpack_device__").and_then(|found| found.extract());
    let (device, _): (i32, i32) = device.map_err(unshared)?;
    if device != CPU {
        let found = format!("memory of a device (DLPack device type {device})");
        return Err(wrong(name, found, "memory of the CPU"));
    }
    let array = value.py().import("numpy")?.call_method1("from_dlpack", (value,));
    Ok(array.map_err(unshared)?.cast_into()?)
}

/// `ValueError` in the form of all messages.
pub(crate) fn wrong(name: &str, found: impl Display, expected: impl Display) -> PyErr {
    PyValueError::new_err(format!("{name}: found {found}, expected {expected}"))
}

fn pattern(shape: &[Option<usize>]) -> String {
    let mut free = ["N", "M", "K", "L"].into_iter();
    let axis = |length: &Option<usize>| match length {
        Some(length) => length.to_string(),
        None => free.next().unwrap_or_default().to_owned(),
    };
    format!("shape [{}]", shape.iter().map(axis).collect::<Vec<_>>().join(", "))
}

/// A read-only array of values that belong to `owner`.
///
/// # Safety
/// `owner` must keep the values alive and unchanged as long as it lives.
pub(crate) unsafe fn view<'py, T: Element>(
    values: &[T],
    owner: Bound<'py, PyAny>,
) -> PyResult<Bound<'py, PyAny>> {
    // SAFETY: guaranteed by the caller.
    unsafe { read_only(ArrayView1::from(values), owner) }
}

/// A read-only array `[N, D]` of values that belong to `owner`.
///
/// # Safety
/// As [`view`].
pub(crate) unsafe fn view_rows<'py, const D: usize>(
    rows: &[[f32; D]],
    owner: Bound<'py, PyAny>,
) -> PyResult<Bound<'py, PyAny>> {
    // SAFETY: guaranteed by the caller.
    unsafe { read_only(ArrayView2::from(rows), owner) }
}

/// # Safety
/// As [`view`].
unsafe fn read_only<'py, T: Element, D: Dimension>(
    values: ArrayView<'_, T, D>,
    owner: Bound<'py, PyAny>,
) -> PyResult<Bound<'py, PyAny>> {
    // SAFETY: guaranteed by the caller; nobody can write to the array once Python has it.
    let array = unsafe { PyArray::borrow_from_array(&values, owner) }.into_any();
    // Not `readwrite`, which panics while another extension reads an earlier array of the same owner.
    array.call_method1(intern!(array.py(), "setflags"), (false,))?;
    Ok(array)
}

/// A new array that owns `values`; the product of `shape` is their number.
pub(crate) fn array<T: Element, D: Dimension>(
    py: Python<'_>,
    values: Vec<T>,
    shape: impl Into<StrideShape<D>>,
) -> Bound<'_, PyAny> {
    let values = Array::from_shape_vec(shape, values).expect("as many values as the shape has");
    values.into_pyarray(py).into_any()
}
