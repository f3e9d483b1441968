//! NumPy arrays: arguments that are read in place, and results that are views of the library's memory.
//!
//! Both through the array interface's struct (<https://numpy.org/doc/stable/reference/arrays.interface.html>), which needs no
//! bindings of NumPy's own interface in C, and unlike the dictionary of that interface costs less than a microsecond.
#![expect(unsafe_code, reason = "the memory of NumPy arrays, and arrays of the library's memory")]

use std::{
    ffi::{c_char, c_int, c_void},
    fmt::Display,
    ptr, slice,
};

use pyo3::{
    exceptions::{PyException, PyTypeError, PyValueError},
    ffi, intern,
    prelude::*,
    sync::PyOnceLock,
    types::{PyCapsule, PyType},
};

/// The type of ordinary memory in the DLPack protocol (kDLCPU).
const CPU: i32 = 1;

/// Most axes of a view.
const MOST_AXES: usize = 4;

/// `PyArrayInterface` of NumPy.
#[repr(C)]
struct Interface {
    /// Always 2.
    two: c_int,
    axes: c_int,
    /// The kind of elements: `f` for floating point, `u` for unsigned integers.
    kind: c_char,
    element_bytes: c_int,
    flags: c_int,
    shape: *const isize,
    /// Bytes from an element to the next one along each axis.
    strides: *const isize,
    data: *mut c_void,
    description: *mut ffi::PyObject,
}

/// Flags of the interface: without gaps in C order, aligned, bytes in the machine's order, may be written.
const C_ORDER: c_int = 0x1;
const ALIGNED: c_int = 0x100;
const NATIVE: c_int = 0x200;
const WRITEABLE: c_int = 0x400;

/// Types of elements, with their names in NumPy and their kind in the array interface.
pub(crate) trait Element: Copy + Send + Sync + 'static {
    const NAME: &str;
    const KIND: u8;
}

impl Element for f32 {
    const NAME: &str = "float32";
    const KIND: u8 = b'f';
}

impl Element for f64 {
    const NAME: &str = "float64";
    const KIND: u8 = b'f';
}

impl Element for u8 {
    const NAME: &str = "uint8";
    const KIND: u8 = b'u';
}

impl Element for u64 {
    const NAME: &str = "uint64";
    const KIND: u8 = b'u';
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
        let capsule = array.getattr(intern!(array.py(), "__array_struct__"))?;
        let capsule = capsule.cast_into::<PyCapsule>()?;
        // SAFETY: the capsule of NumPy's own array has this struct, with as many lengths as axes; both live until it is dropped.
        let (interface, shape) = unsafe {
            let interface = capsule.pointer_checked(None)?.cast::<Interface>().as_ref();
            (interface, lengths(interface))
        };
        let element = (interface.kind as u8, interface.element_bytes as usize);
        if element != (T::KIND, size_of::<T>()) || interface.flags & NATIVE == 0 {
            let found = array.getattr("dtype")?;
            return Err(wrong(name, format!("dtype {found}"), T::NAME));
        }
        let fits = shape.len() == expected.len()
            && shape
                .iter()
                .zip(expected)
                .all(|(&found, &length)| length.is_none_or(|l| l == found));
        if !fits {
            return Err(wrong(name, format!("shape {shape:?}"), pattern(expected)));
        }
        if interface.flags & C_ORDER == 0 {
            let found = "an array with gaps or another order";
            return Err(wrong(name, found, "C order: numpy.ascontiguousarray"));
        }
        let data = interface.data.cast_const().cast::<T>();
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

/// The lengths of an array's axes.
///
/// # Safety
/// The struct is one of NumPy, or has been filled like one.
unsafe fn lengths(interface: &Interface) -> Vec<usize> {
    if interface.axes == 0 {
        return Vec::new(); // the pointer may be null
    }
    // SAFETY: guaranteed by the caller.
    let shape = unsafe { slice::from_raw_parts(interface.shape, interface.axes as usize) };
    shape.iter().map(|&length| length as usize).collect()
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
    kind: u8,
    element_bytes: usize,
    read_only: bool,
    _owner: Py<PyAny>,
}

/// What a capsule holds: the struct, and the numbers it points to.
#[repr(C)]
struct Described {
    interface: Interface,
    shape: [isize; MOST_AXES],
    strides: [isize; MOST_AXES],
}

#[pymethods]
impl Memory {
    #[getter]
    fn __array_struct__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let mut flags = C_ORDER | ALIGNED | NATIVE;
        if !self.read_only {
            flags |= WRITEABLE;
        }
        let interface = Interface {
            two: 2,
            axes: self.shape.len() as c_int,
            kind: self.kind as c_char,
            element_bytes: self.element_bytes as c_int,
            flags,
            shape: ptr::null(),
            strides: ptr::null(),
            data: self.address as *mut c_void,
            description: ptr::null_mut(),
        };
        let (shape, strides) = ([0; MOST_AXES], [0; MOST_AXES]);
        let mut described = Box::new(Described { interface, shape, strides });
        let mut step = self.element_bytes;
        for axis in (0..self.shape.len()).rev() {
            described.shape[axis] = self.shape[axis] as isize;
            described.strides[axis] = step as isize;
            step *= self.shape[axis];
        }
        described.interface.shape = described.shape.as_ptr();
        described.interface.strides = described.strides.as_ptr();
        let described = Box::into_raw(described);
        // SAFETY: NumPy asks for a capsule without a name, which takes the box and gives it back to `free`.
        unsafe {
            let capsule = ffi::PyCapsule_New(described.cast(), ptr::null(), Some(free));
            if capsule.is_null() {
                drop(Box::from_raw(described));
            }
            Bound::from_owned_ptr_or_err(py, capsule)
        }
    }
}

/// Drops what a capsule holds.
unsafe extern "C" fn free(capsule: *mut ffi::PyObject) {
    // SAFETY: called once for a capsule of `__array_struct__`.
    unsafe {
        let described = ffi::PyCapsule_GetPointer(capsule, ptr::null());
        drop(Box::from_raw(described.cast::<Described>()));
    }
}

impl Memory {
    /// Values of `owner`, last axis fastest.
    fn new<T: Element>(
        values: *const T,
        shape: Vec<usize>,
        owner: Py<PyAny>,
        read_only: bool,
    ) -> Self {
        assert!(shape.len() <= MOST_AXES, "at most {MOST_AXES} axes");
        let (kind, element_bytes) = (T::KIND, size_of::<T>());
        Self { address: values as usize, shape, kind, element_bytes, read_only, _owner: owner }
    }

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
    Memory::new(values.as_ptr(), vec![values.len()], owner.unbind(), true).into_array(py)
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
    let values = pairs.as_flattened().as_ptr();
    Memory::new(values, vec![pairs.len(), 2], owner.unbind(), true).into_array(py)
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
    let address = values.as_ptr();
    let owner = Py::new(py, Values { _values: Box::new(values) })?.into_any();
    Memory::new(address, shape, owner, false).into_array(py)
}
