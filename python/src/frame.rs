//! `Frame`: all particles at one instant.
#![expect(unsafe_code, reason = "arrays that borrow the memory of a frozen object")]

use eddy_frames::{AnyFrame, Domain, InvalidFrame, Material, Stamp, with_frame};
use pyo3::{
    exceptions::PyValueError,
    prelude::*,
    types::{PyString, PyTuple},
};

use crate::arrays::{Argument, view, view_rows, wrong};

/// All particles at one instant. `N` is the number of particles; lengths are in domain lengths, times in seconds.
///
/// The arrays of a frame are read-only views without a copy.
///
/// `position`, `velocity`: float32 [N, 2], or [N, 3] in space. `material`: uint8 [N] (0 liquid, 1 snow, 2 jelly, 3 rope, 4 sand), or the name of the one
/// material of all particles. These arrays are copied. `stream`: id of the simulated trajectory. `sequence`: number of the
/// frame in it. `time`: simulation time (s). `dt`: time between two frames (s). `lower`, `upper`: corners of the domain, by
/// default the unit square or cube. `Surrogate`, `Stream`, `Player` and `skill` know two dimensions, and raise ValueError for three.
#[pyclass(frozen, module = "eddy")]
pub(crate) struct Frame {
    pub(crate) inner: AnyFrame,
    /// The numbers of the materials, `[N]`.
    material: Vec<u8>,
}

impl<F: Into<AnyFrame>> From<F> for Frame {
    fn from(frame: F) -> Self {
        let inner = frame.into();
        let material = with_frame!(&inner, frame => {
            frame.material.iter().map(|&material| material as u8).collect()
        });
        Self { inner, material }
    }
}

impl Frame {
    /// The frame, an argument of this name, for what knows two dimensions.
    ///
    /// # Errors
    /// `ValueError` for a frame of three.
    pub(crate) fn plane(&self, name: &str) -> PyResult<&eddy_frames::Frame> {
        let plane = (&self.inner).try_into();
        plane.map_err(|_: InvalidFrame| wrong(name, "a frame of 3 dimensions", "one of 2"))
    }
}

/// The fields of a new frame besides position and velocity.
struct Fields {
    stream: u64,
    sequence: u64,
    stamp: Stamp,
    dt: f32,
    lower: Option<Vec<f32>>,
    upper: Option<Vec<f32>>,
    material: Vec<Material>,
}

impl Fields {
    fn frame<const D: usize>(
        self,
        position: &Argument<'_, f32>,
        velocity: &Argument<'_, f32>,
    ) -> PyResult<Frame>
    where
        eddy_frames::Frame<D>: Into<AnyFrame>,
    {
        let Self { stream, sequence, stamp, dt, lower, upper, material } = self;
        let domain: Domain<D> =
            Domain { lower: corner("lower", lower, 0.0)?, upper: corner("upper", upper, 1.0)? };
        let (position, velocity) = (position.rows().to_vec(), velocity.rows().to_vec());
        eddy_frames::Frame::new(stream, sequence, stamp, dt, domain, position, velocity, material)
            .map(Frame::from)
            .map_err(invalid)
    }
}

fn invalid(error: InvalidFrame) -> PyErr {
    PyValueError::new_err(error.to_string())
}

#[pymethods]
impl Frame {
    #[new]
    #[pyo3(signature = (position, velocity, material, *, stream=0, sequence=0, time=0.0, dt=0.016, lower=None, upper=None))]
    #[expect(clippy::too_many_arguments, reason = "one argument for each field of a frame")]
    fn new(
        position: &Bound<'_, PyAny>,
        velocity: &Bound<'_, PyAny>,
        material: &Bound<'_, PyAny>,
        stream: u64,
        sequence: u64,
        time: f64,
        dt: f32,
        lower: Option<Vec<f32>>,
        upper: Option<Vec<f32>>,
    ) -> PyResult<Self> {
        let position = Argument::<f32>::vectors("position", position)?;
        let (particles, dimension) = (position.shape()[0], position.shape()[1]);
        let shape = [Some(particles), Some(dimension)];
        let velocity = Argument::<f32>::new("velocity", velocity, &shape)?;
        let material = materials(material, particles)?;
        if !time.is_finite() {
            return Err(wrong("time", time, "a finite number of seconds"));
        }
        let stamp = Stamp::from_seconds(time);
        let fields = Fields { stream, sequence, stamp, dt, lower, upper, material };
        match dimension {
            3 => fields.frame::<3>(&position, &velocity),
            _ => fields.frame::<2>(&position, &velocity),
        }
    }

    /// Positions, float32 [N, 2] or [N, 3] (domain lengths), read-only.
    #[getter]
    fn position<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        // SAFETY: the object is frozen and owns the positions.
        with_frame!(&slf.get().inner, frame => unsafe {
            view_rows(&frame.position, slf.clone().into_any())
        })
    }

    /// Velocities, float32 [N, 2] or [N, 3] (domain lengths per second), read-only.
    #[getter]
    fn velocity<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        // SAFETY: the object is frozen and owns the velocities.
        with_frame!(&slf.get().inner, frame => unsafe {
            view_rows(&frame.velocity, slf.clone().into_any())
        })
    }

    /// Materials, uint8 [N]: 0 liquid, 1 snow, 2 jelly, 3 rope, 4 sand; read-only.
    #[getter]
    fn material<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        // SAFETY: the object is frozen and owns the numbers.
        unsafe { view(&slf.get().material, slf.clone().into_any()) }
    }

    /// Id of the simulated trajectory.
    #[getter]
    fn stream(&self) -> u64 {
        with_frame!(&self.inner, frame => frame.stream)
    }

    /// Number of the frame in its stream.
    #[getter]
    fn sequence(&self) -> u64 {
        with_frame!(&self.inner, frame => frame.sequence)
    }

    /// Simulation time (s).
    #[getter]
    fn time(&self) -> f64 {
        with_frame!(&self.inner, frame => frame.stamp.seconds())
    }

    /// Simulation time (ns).
    #[getter]
    fn stamp(&self) -> i64 {
        with_frame!(&self.inner, frame => frame.stamp.0)
    }

    /// Time between two frames (s).
    #[getter]
    fn dt(&self) -> f64 {
        eddy_frames::decimal(with_frame!(&self.inner, frame => frame.dt))
    }

    /// Corner of the domain with the smallest coordinates.
    #[getter]
    fn lower<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyTuple>> {
        with_frame!(&self.inner, frame => PyTuple::new(py, frame.domain.lower))
    }

    /// Corner of the domain with the largest coordinates.
    #[getter]
    fn upper<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyTuple>> {
        with_frame!(&self.inner, frame => PyTuple::new(py, frame.domain.upper))
    }

    /// Raises ValueError if a number is not finite: predictions may diverge.
    fn check(&self) -> PyResult<()> {
        with_frame!(&self.inner, frame => frame.check()).map_err(invalid)
    }

    fn __len__(&self) -> usize {
        self.material.len()
    }

    fn __eq__(&self, other: &Bound<'_, PyAny>) -> bool {
        other.cast::<Self>().is_ok_and(|other| other.get().inner == self.inner)
    }

    fn __repr__(&self) -> String {
        format!(
            "Frame(stream={}, sequence={}, time={}, particles={})",
            self.stream(),
            self.sequence(),
            self.time(),
            self.material.len()
        )
    }
}

/// A corner of the domain, by default with one number along all axes.
fn corner<const D: usize>(name: &str, given: Option<Vec<f32>>, default: f32) -> PyResult<[f32; D]> {
    let Some(corner) = given else { return Ok([default; D]) };
    corner.try_into().map_err(|found| {
        wrong(name, format!("{found:?}"), format!("{D} numbers, one for each axis of position"))
    })
}

/// Materials by number, or one name for all.
fn materials(value: &Bound<'_, PyAny>, particles: usize) -> PyResult<Vec<Material>> {
    if let Ok(name) = value.cast::<PyString>() {
        let name = name.to_str()?;
        let known = Material::ALL.into_iter().find(|material| material.name() == name);
        let material =
            known.ok_or_else(|| wrong("material", name, "liquid, snow, jelly, rope or sand"))?;
        return Ok(vec![material; particles]);
    }
    let numbers = Argument::<u8>::new("material", value, &[Some(particles)])?;
    let numbers = numbers.as_slice().iter().enumerate();
    let known = |(particle, &number): (usize, &u8)| {
        Material::try_from(number)
            .map_err(|found| invalid(InvalidFrame::Material { particle, found }))
    };
    numbers.map(known).collect()
}
