//! `Scene`: initial conditions and settings of a simulation.

use std::{ffi::CString, path::PathBuf};

use eddy_mpm::{Extent, Preset};
use pyo3::{exceptions::PyUserWarning, prelude::*, types::PyDict};

use crate::{
    errors::{SimulationError, raise},
    values,
};

/// Initial conditions and settings of a simulation: bodies, emitters, drains, materials, timing.
///
/// `settings` has the keys of a scene file, for example
/// `Scene({"bodies": [{"material": "jelly", "shape": "disc", ...}]})`.
#[pyclass(frozen, module = "eddy")]
pub(crate) struct Scene {
    pub(crate) inner: eddy_mpm::Scene,
}

impl Scene {
    fn checked(py: Python<'_>, mut inner: eddy_mpm::Scene) -> PyResult<Self> {
        if let Some(note) = inner.read_older_form() {
            let note = CString::new(note).map_err(PyErr::from)?;
            PyErr::warn(py, &py.get_type::<PyUserWarning>(), &note, 1)?;
        }
        inner.check().map_err(raise::<SimulationError>)?;
        Ok(Self { inner })
    }
}

#[pymethods]
impl Scene {
    #[new]
    fn new(settings: &Bound<'_, PyDict>) -> PyResult<Self> {
        Self::checked(settings.py(), values::parse("settings", settings)?)
    }

    /// A random scene of a preset (kinds, sand, multi-material, fluid, stiff; with a tool push, pour, scoop). The same seed and id give the same scene.
    #[staticmethod]
    #[pyo3(signature = (preset, *, seed=0, id=0, particles=None))]
    fn generate(preset: &str, seed: u64, id: u64, particles: Option<usize>) -> PyResult<Self> {
        let preset: Preset = values::word("preset", preset)?;
        let extent = match particles {
            None => Extent::usual(preset),
            Some(particles) => Extent::of(preset, particles).map_err(raise::<SimulationError>)?,
        };
        Ok(Self { inner: eddy_mpm::Scene::generate_in(&extent, seed, id) })
    }

    /// Reads a scene file (TOML).
    #[staticmethod]
    fn load(py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        Self::checked(py, eddy_settings::load(&path).map_err(raise::<SimulationError>)?)
    }

    /// The settings as a dictionary with the keys of a scene file.
    fn to_dict<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        values::render(py, &self.inner)
    }

    /// Simulated time after which the scene ends (s).
    #[getter]
    fn duration(&self) -> f64 {
        self.inner.frames.duration
    }

    /// Time between two frames (s).
    #[getter]
    fn dt(&self) -> f64 {
        eddy_frames::decimal(self.inner.frames.interval)
    }

    /// Width and height (domain lengths).
    #[getter]
    fn domain(&self) -> (f32, f32) {
        self.inner.domain.into()
    }

    fn __eq__(&self, other: &Bound<'_, PyAny>) -> bool {
        other.cast::<Self>().is_ok_and(|other| other.get().inner == self.inner)
    }

    fn __repr__(&self) -> String {
        let eddy_mpm::Scene { id, domain: [width, height], bodies, .. } = &self.inner;
        format!("Scene(id={id}, domain={width} x {height}, bodies={})", bodies.len())
    }
}
