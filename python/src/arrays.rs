//! NumPy arrays: arguments that are read in place, and results that are views of the library's memory.
//!
//! Both through the array interface (<https://numpy.org/doc/stable/reference/arrays.interface.html>), which needs no bindings
//! of NumPy's own interface in C.
#![expect(unsafe_code, reason = "the memory of NumPy arrays, and arrays of the library's memory")]

use std::{fmt::Display, slice};

use pyo3::{
    exceptions::{PyException, PyTypeError, PyValueError},
    prelude::*,
    sync::PyOnceLock,
    types::{PyDict, PyTuple, PyType},
};

/// The type of ordinary memory in the DLPack protocol (kDLCPU).
const CPU: i32 = 1;

/// Types of elements, with their names in NumPy and in the array interface.
pub(crate) trait Element: Copy + Send + Sync + 'static {
    const NAME: &str;
    const CODE: &str;
}

impl Element for f32 {
    const NAME: &str = "float32";
    const CODE: &str = "<f4";
}

impl Element for f64 {
    const NAME: &str = "float64";
    const CODE: &str = "<f8";
}

impl Element for u8 {
    const NAME: &str = "uint8";
    const CODE: &str = "|u1";
}

impl Element for u64 {
    const NAME: &str = "uint64";
    const CODE: &str = "<u8";
}

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
        let array = numpy_array(name, value)?;
        let interface = array.getattr("__array_interface__")?.cast_into::<PyDict>()?;
        let item = |key: &str| -> PyResult<Bound<'py, PyAny>> {
            interface
                .get_item(key)?
                .ok_or_else(|| PyTypeError::new_err(format!("{name}: no {key}")))
        };
        if item("typestr")?.extract::<String>()? != T::CODE {
            let found = array.getattr("dtype")?;
            return Err(wrong(name, format!("dtype {found}"), T::NAME));
        }
        let shape: Vec<usize> = item("shape")?.extract()?;
        let fits = shape.len() == expected.len()
            && shape
                .iter()
                .zip(expected)
                .all(|(&found, &length)| length.is_none_or(|l| l == found));
        if !fits {
            return Err(wrong(name, format!("shape {shape:?}"), pattern(expected)));
        }
        // Absent or None for arrays without gaps in C order.
        if interface.get_item("strides")?.is_some_and(|strides| !strides.is_none()) {
            let found = "an array with gaps or another order";
            return Err(wrong(name, found, "C order: numpy.ascontiguousarray"));
        }
        let (address, _): (usize, bool) = item("data")?.extract()?;
        let data = address as *const T;
        if !data.is_aligned() {
            return Err(wrong(name, "unaligned memory", "an aligned array: numpy.copy"));
        }
        Ok(Self { _array: array, shape, data })
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
    /// The elements of an array whose last axis has length two.
    pub(crate) fn pairs(&self) -> &[[f32; 2]] {
        bytemuck::cast_slice(self.as_slice())
    }
}

/// NumPy's array of this very type, so that its interface can be trusted, which shares the memory of the value.
fn numpy_array<'py>(name: &str, value: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
    static NDARRAY: PyOnceLock<Py<PyType>> = PyOnceLock::new();
    let ndarray = NDARRAY.import(value.py(), "numpy", "ndarray")?;
    if value.is_exact_instance(ndarray) {
        return Ok(value.clone());
    }
    let numpy = value.py().import("numpy")?;
    if value.is_instance(ndarray)? {
        return numpy.call_method1("asarray", (value,));
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
    numpy.call_method1("from_dlpack", (value,)).map_err(unshared)
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

/// Memory with an array interface: NumPy makes an array of it, which keeps this object and so the owner.
#[pyclass(frozen, module = "eddy")]
struct Memory {
    address: usize,
    shape: Vec<usize>,
    code: &'static str,
    read_only: bool,
    _owner: Py<PyAny>,
}

#[pymethods]
impl Memory {
    #[getter]
    fn __array_interface__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let interface = PyDict::new(py);
        interface.set_item("version", 3)?;
        interface.set_item("data", (self.address, self.read_only))?;
        interface.set_item("shape", PyTuple::new(py, &self.shape)?)?;
        interface.set_item("typestr", self.code)?;
        Ok(interface)
    }
}

impl Memory {
    fn into_array(self, py: Python<'_>) -> PyResult<Bound<'_, PyAny>> {
        static ASARRAY: PyOnceLock<Py<PyAny>> = PyOnceLock::new();
        ASARRAY.import(py, "numpy", "asarray")?.call1((Bound::new(py, self)?,))
    }
}

/// A read-only array of values that belong to `owner`.
///
/// # Safety
/// `owner` must keep the values alive and unchanged as long as it lives.
pub(crate) unsafe fn view<'py, T: Element>(
    values: &[T],
    owner: Bound<'py, PyAny>,
) -> PyResult<Bound<'py, PyAny>> {
    let py = owner.py();
    let (address, shape) = (values.as_ptr() as usize, vec![values.len()]);
    Memory { address, shape, code: T::CODE, read_only: true, _owner: owner.unbind() }.into_array(py)
}

/// A read-only array `[N, 2]` of values that belong to `owner`.
///
/// # Safety
/// As [`view`].
pub(crate) unsafe fn view_pairs<'py>(
    pairs: &[[f32; 2]],
    owner: Bound<'py, PyAny>,
) -> PyResult<Bound<'py, PyAny>> {
    let py = owner.py();
    let (address, shape) = (pairs.as_ptr() as usize, vec![pairs.len(), 2]);
    Memory { address, shape, code: f32::CODE, read_only: true, _owner: owner.unbind() }
        .into_array(py)
}

/// Owns the values of an array.
#[pyclass(frozen, module = "eddy")]
struct Values {
    _values: Box<dyn Send + Sync>,
}

/// A new array that owns `values`; the product of `shape` is their number.
pub(crate) fn array<T: Element>(
    py: Python<'_>,
    values: Vec<T>,
    shape: Vec<usize>,
) -> PyResult<Bound<'_, PyAny>> {
    debug_assert_eq!(shape.iter().product::<usize>(), values.len());
    let address = values.as_ptr() as usize;
    let owner = Py::new(py, Values { _values: Box::new(values) })?.into_any();
    Memory { address, shape, code: T::CODE, read_only: false, _owner: owner }.into_array(py)
}
