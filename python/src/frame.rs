//! `Frame`: all particles at one instant.
#![expect(unsafe_code, reason = "arrays that borrow the memory of a frozen object")]

use std::sync::Arc;

use eddy_frames::{Domain, Material, Stamp};
use pyo3::{exceptions::PyValueError, prelude::*, types::PyString};

use crate::arrays::{Argument, view, view_pairs, wrong};

/// All particles at one instant. `N` is the number of particles; lengths are in domain lengths, times in seconds.
///
/// The arrays of a frame are read-only views without a copy.
///
/// `position`, `velocity`: float32 [N, 2]. `material`: uint8 [N] (0 liquid, 1 snow, 2 jelly, 3 rope), or the name of the one
/// material of all particles. These arrays are copied. `stream`: id of the simulated trajectory. `sequence`: number of the
/// frame in it. `time`: simulation time (s). `dt`: time between two frames (s). `lower`, `upper`: corners of the domain.
#[pyclass(frozen, module = "eddy")]
pub(crate) struct Frame {
    pub(crate) inner: Arc<eddy_frames::Frame>,
    /// The numbers of the materials, `[N]`.
    material: Vec<u8>,
}

impl From<eddy_frames::Frame> for Frame {
    fn from(frame: eddy_frames::Frame) -> Self {
        let material = frame.material.iter().map(|&material| material as u8).collect();
        Self { inner: Arc::new(frame), material }
    }
}

#[pymethods]
impl Frame {
    #[new]
    #[pyo3(signature = (position, velocity, material, *, stream=0, sequence=0, time=0.0, dt=0.016, lower=[0.0, 0.0], upper=[1.0, 1.0]))]
    #[expect(clippy::too_many_arguments, reason = "one argument for each field of a frame")]
    fn new(
        position: &Bound<'_, PyAny>,
        velocity: &Bound<'_, PyAny>,
        material: &Bound<'_, PyAny>,
        stream: u64,
        sequence: u64,
        time: f64,
        dt: f32,
        lower: [f32; 2],
        upper: [f32; 2],
    ) -> PyResult<Self> {
        let position = Argument::<f32>::new("position", position, &[None, Some(2)])?;
        let position = position.pairs().to_vec();
        let shape = [Some(position.len()), Some(2)];
        let velocity = Argument::<f32>::new("velocity", velocity, &shape)?.pairs().to_vec();
        let material = materials(material, position.len())?;
        if !time.is_finite() {
            return Err(wrong("time", time, "a finite number of seconds"));
        }
        let (stamp, domain) = (Stamp::from_seconds(time), Domain { lower, upper });
        eddy_frames::Frame::new(stream, sequence, stamp, dt, domain, position, velocity, material)
            .map(Self::from)
            .map_err(|error| PyValueError::new_err(error.to_string()))
    }

    /// Positions, float32 [N, 2] (domain lengths), read-only.
    #[getter]
    fn position<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        // SAFETY: the object is frozen and owns the positions.
        unsafe { view_pairs(&slf.get().inner.position, slf.clone().into_any()) }
    }

    /// Velocities, float32 [N, 2] (domain lengths per second), read-only.
    #[getter]
    fn velocity<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        // SAFETY: the object is frozen and owns the velocities.
        unsafe { view_pairs(&slf.get().inner.velocity, slf.clone().into_any()) }
    }

    /// Materials, uint8 [N]: 0 liquid, 1 snow, 2 jelly, 3 rope; read-only.
    #[getter]
    fn material<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        // SAFETY: the object is frozen and owns the numbers.
        unsafe { view(&slf.get().material, slf.clone().into_any()) }
    }

    /// Id of the simulated trajectory.
    #[getter]
    fn stream(&self) -> u64 {
        self.inner.stream
    }

    /// Number of the frame in its stream.
    #[getter]
    fn sequence(&self) -> u64 {
        self.inner.sequence
    }

    /// Simulation time (s).
    #[getter]
    fn time(&self) -> f64 {
        self.inner.stamp.seconds()
    }

    /// Simulation time (ns).
    #[getter]
    fn stamp(&self) -> i64 {
        self.inner.stamp.0
    }

    /// Time between two frames (s).
    #[getter]
    fn dt(&self) -> f64 {
        eddy_frames::decimal(self.inner.dt)
    }

    /// Corner of the domain with the smallest coordinates.
    #[getter]
    fn lower(&self) -> (f32, f32) {
        self.inner.domain.lower.into()
    }

    /// Corner of the domain with the largest coordinates.
    #[getter]
    fn upper(&self) -> (f32, f32) {
        self.inner.domain.upper.into()
    }

    /// Raises ValueError if a number is not finite: predictions may diverge.
    fn check(&self) -> PyResult<()> {
        self.inner.check().map_err(|error| PyValueError::new_err(error.to_string()))
    }

    fn __len__(&self) -> usize {
        self.inner.len()
    }

    fn __eq__(&self, other: &Bound<'_, PyAny>) -> bool {
        other.cast::<Self>().is_ok_and(|other| other.get().inner == self.inner)
    }

    fn __repr__(&self) -> String {
        let Self { inner, .. } = self;
        format!(
            "Frame(stream={}, sequence={}, time={}, particles={})",
            inner.stream,
            inner.sequence,
            inner.stamp.seconds(),
            inner.len()
        )
    }
}

/// Materials by number, or one name for all.
fn materials(value: &Bound<'_, PyAny>, particles: usize) -> PyResult<Vec<Material>> {
    if let Ok(name) = value.cast::<PyString>() {
        let name = name.to_str()?;
        let known = Material::ALL.into_iter().find(|material| material.name() == name);
        let material =
            known.ok_or_else(|| wrong("material", name, "liquid, snow, jelly or rope"))?;
        return Ok(vec![material; particles]);
    }
    let numbers = Argument::<u8>::new("material", value, &[Some(particles)])?;
    let numbers = numbers.as_slice().iter().enumerate();
    let known = |(particle, &number): (usize, &u8)| {
        Material::try_from(number).map_err(|found| {
            let place = format!("material[{particle}]");
            wrong(&place, found, "0 (liquid), 1 (snow), 2 (jelly) or 3 (rope)")
        })
    };
    numbers.map(known).collect()
}
