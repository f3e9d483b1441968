//! `Solver`: the Material Point Method, frame by frame.

use std::sync::Mutex;

use eddy_dataset::available_memory;
use eddy_mpm::{Law, Pose, Settings, Simulation};
use pyo3::{prelude::*, types::PyDict};

use crate::{
    arrays::{Argument, wrong},
    detached,
    errors::{SimulationError, raise},
    frame::Frame,
    scene::Scene,
    values,
};

/// A running simulation (MLS-MPM). It is an iterator of frames.
///
/// Settings that are None are those of `scene`: `stiffness` is Young's modulus E, `law` is `water`, `settling` or `taichi`, `viscosity`
/// is in domain lengths^2 per s, `substeps` are per frame, `duration` is in s. The number of `threads` does not change the
/// result.
#[pyclass(frozen, module = "eddy")]
pub(crate) struct Solver {
    simulation: Mutex<Simulation>,
}

#[pymethods]
impl Solver {
    #[new]
    #[pyo3(signature = (scene, *, stiffness=None, law=None, viscosity=None, substeps=None, duration=None, threads=1))]
    #[expect(clippy::too_many_arguments, reason = "the settings that override a scene's")]
    fn new(
        py: Python<'_>,
        scene: &Bound<'_, Scene>,
        stiffness: Option<f32>,
        law: Option<&str>,
        viscosity: Option<f32>,
        substeps: Option<u32>,
        duration: Option<f64>,
        threads: usize,
    ) -> PyResult<Self> {
        if threads == 0 {
            return Err(wrong("threads", 0, "at least 1"));
        }
        let law: Option<Law> = law.map(|law| values::word("law", law)).transpose()?;
        let settings =
            Settings { stiffness, law, viscosity, substeps, duration, ..Settings::default() };
        let scene = scene.get().inner.clone();
        let (needed, free) =
            (scene.memory().map_err(raise::<SimulationError>)?, available_memory());
        if needed > free {
            let found = format!("a scene that needs {} MiB", needed >> 20);
            return Err(wrong("scene", found, format!("at most the {} MiB available", free >> 20)));
        }
        let simulation = py.detach(|| Simulation::on_threads(scene, &settings, threads));
        Ok(Self { simulation: Mutex::new(simulation.map_err(raise::<SimulationError>)?) })
    }

    /// The next frame; None when the scene has ended. The first one is the state at the start.
    fn step(&self, py: Python<'_>) -> PyResult<Option<Frame>> {
        let frame = detached(py, &self.simulation, Simulation::next_frame);
        Ok(frame.map_err(raise::<SimulationError>)?.map(Frame::from))
    }

    fn __iter__(slf: Bound<'_, Self>) -> Bound<'_, Self> {
        slf
    }

    fn __next__(&self, py: Python<'_>) -> PyResult<Option<Frame>> {
        self.step(py)
    }

    /// Moves every particle by a vector, float32 [N, 2] (domain lengths).
    fn displace(&self, py: Python<'_>, by: &Bound<'_, PyAny>) -> PyResult<()> {
        let by = Argument::<f32>::new("by", by, &[None, Some(2)])?;
        let pairs = by.rows::<2>();
        if let Some(row) = pairs.iter().position(|[x, y]| !(x.is_finite() && y.is_finite())) {
            return Err(wrong(
                &format!("by[{row}]"),
                format!("{:?}", pairs[row]),
                "finite numbers",
            ));
        }
        let displace = |simulation: &mut Simulation| {
            let particles = simulation.particles();
            if pairs.len() != particles {
                return Err(wrong("by", format!("{} rows", pairs.len()), particles));
            }
            let mut pairs = pairs.iter().copied();
            let next = || pairs.next().unwrap_or_default();
            simulation.displace(next).map_err(raise::<SimulationError>)
        };
        detached(py, &self.simulation, displace)
    }

    /// Moves the tools of the scene by hand, in place of their keyframes: float32 [T, 3] with x, y (domain lengths) and the angle (rad, a
    /// whole turn more is a whole turn) that each has at the next frame. It rests there until it is moved again. To be called after the first frame.
    fn move_tools(&self, py: Python<'_>, poses: &Bound<'_, PyAny>) -> PyResult<()> {
        let poses = Argument::<f32>::new("poses", poses, &[None, Some(3)])?;
        let pose = |&[x, y, angle]: &[f32; 3]| Pose { position: [x, y], angle };
        let poses: Vec<Pose> = poses.rows::<3>().iter().map(pose).collect();
        let moved = detached(py, &self.simulation, |simulation| simulation.move_tools(&poses));
        moved.map_err(raise::<SimulationError>)
    }

    /// What each tool has got from matter in the interval before the last frame: `impulse` x, y (density x domain lengths^3 per s; the mean
    /// force is this by dt), `angular_impulse` about its position, and `work` of matter on it (density x domain lengths^4 per s^2).
    fn tool_loads<'py>(&self, py: Python<'py>) -> PyResult<Vec<Bound<'py, PyDict>>> {
        let loads = detached(py, &self.simulation, |simulation| simulation.loads());
        let load = |load: eddy_mpm::ToolLoad| {
            let parts = PyDict::new(py);
            parts.set_item("impulse", (load.impulse[0], load.impulse[1]))?;
            parts.set_item("angular_impulse", load.angular)?;
            parts.set_item("work", load.work)?;
            Ok(parts)
        };
        loads.into_iter().map(load).collect()
    }

    /// The present energy: `kinetic`, `elastic`, `potential` (density x domain lengths^4 per s^2).
    fn energy<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let energy = detached(py, &self.simulation, |simulation| simulation.energy());
        let parts = PyDict::new(py);
        parts.set_item("kinetic", energy.kinetic)?;
        parts.set_item("elastic", energy.elastic)?;
        parts.set_item("potential", energy.potential)?;
        Ok(parts)
    }

    /// The scene with the settings of this solver.
    #[getter]
    fn scene(&self, py: Python<'_>) -> Scene {
        Scene { inner: detached(py, &self.simulation, |simulation| simulation.scene().clone()) }
    }

    /// Substeps per frame.
    #[getter]
    fn substeps(&self, py: Python<'_>) -> u32 {
        detached(py, &self.simulation, |simulation| simulation.substeps_per_frame())
    }
}
