//! `Surrogate` and `Stream`: predictions with one hidden state per stream.

use std::{
    num::NonZeroUsize,
    path::{Path, PathBuf},
    sync::{Arc, Mutex},
};

use eddy_frames::{FrameView, Particles, Stamp};
use eddy_inference::{
    checkpoint::Checkpoint,
    engine::{self, HiddenState, ModelError, Stated, Stepper},
};
use pyo3::{exceptions::PyValueError, prelude::*};

use crate::{
    arrays::{Argument, array, wrong},
    detached,
    errors::{CheckpointError, raise},
    frame::Frame,
    lock, values,
};

/// A trained network, ready to predict.
///
/// One set of threads predicts for all its streams: calls from several Python threads wait for each other.
///
/// `checkpoint` is the directory of a checkpoint, by default the particle model that is part of the package. `threads` is
/// the number of threads of a prediction, by default one per core; it does not change the result.
#[pyclass(frozen, module = "eddy")]
pub(crate) struct Surrogate {
    pub(crate) inner: engine::Surrogate,
    stepper: Arc<Mutex<Stepper>>,
}

/// A stream of frames: what the network remembers of it.
#[pyclass(frozen, module = "eddy")]
pub(crate) struct Stream {
    surrogate: Py<Surrogate>,
    hidden: Mutex<HiddenState>,
    /// The first frame without its motion: domain, materials, interval of all others.
    first: Arc<eddy_frames::Frame>,
}

/// A frame to predict from, with the stream's memory.
struct Job<'a> {
    hidden: &'a mut HiddenState,
    frame: &'a eddy_frames::Frame,
    next: Option<eddy_frames::Frame>,
}

#[pymethods]
impl Surrogate {
    #[new]
    #[pyo3(signature = (checkpoint=None, *, threads=None))]
    fn new(py: Python<'_>, checkpoint: Option<PathBuf>, threads: Option<usize>) -> PyResult<Self> {
        let count =
            |threads| NonZeroUsize::new(threads).ok_or_else(|| wrong("threads", 0, "at least 1"));
        let threads = threads.map(count).transpose()?;
        let inner = load(py, checkpoint.as_deref(), threads)?;
        let stepper = Arc::new(Mutex::new(inner.stepper()));
        Ok(Self { inner, stepper })
    }

    /// Begins a stream with its first frame, which is not observed yet: pass it to `Stream.step` first. The particle model takes
    /// the shape of jelly and rope in this frame as their rest shape. A network that is conditioned on the stiffness takes that of the stream,
    /// Young's modulus (density x velocity^2), or what it assumes; others take none.
    #[pyo3(signature = (first, *, stiffness=None))]
    fn stream(
        slf: &Bound<'_, Self>,
        first: &Bound<'_, Frame>,
        stiffness: Option<f32>,
    ) -> PyResult<Stream> {
        let first = first.get().plane("first")?;
        let surrogate = &slf.get().inner;
        let hidden = surrogate.start_with_stiffness(first, stiffness).map_err(unfit)?;
        Ok(Stream {
            surrogate: slf.clone().unbind(),
            hidden: Mutex::new(hidden),
            first: Arc::new(without_motion(first)),
        })
    }

    /// Observes a frame of each stream and returns the predicted next frames, in the order of the streams. Streams run side by
    /// side, each on one thread.
    fn step(
        slf: &Bound<'_, Self>,
        streams: Vec<Bound<'_, Stream>>,
        frames: Vec<Bound<'_, Frame>>,
    ) -> PyResult<Vec<Frame>> {
        let py = slf.py();
        if streams.len() != frames.len() {
            let found = format!("{} frames", frames.len());
            return Err(wrong("frames", found, format!("{}, one for each stream", streams.len())));
        }
        for (index, stream) in streams.iter().enumerate() {
            if !stream.get().surrogate.is(slf) {
                let place = format!("streams[{index}]");
                return Err(wrong(&place, "a stream of another surrogate", "one of this"));
            }
            if streams[..index].iter().any(|other| other.is(stream)) {
                let place = format!("streams[{index}]");
                return Err(wrong(&place, "a stream that is there twice", "each stream once"));
            }
        }
        let frames = frames.iter().enumerate();
        let frames: Vec<&eddy_frames::Frame> = frames
            .map(|(index, frame)| frame.get().plane(&format!("frames[{index}]")))
            .collect::<PyResult<_>>()?;
        for (stream, frame) in streams.iter().zip(&frames) {
            stream.get().check(slf, FrameView::from(*frame))?;
        }
        let streams: Vec<&Stream> = streams.iter().map(Bound::get).collect();
        // The stepper before the streams, as everywhere: two calls with the same streams cannot wait for each other.
        let predicted = detached(py, &slf.get().stepper, |stepper| {
            let mut hidden: Vec<_> = streams.iter().map(|stream| lock(&stream.hidden)).collect();
            let mut jobs: Vec<Job<'_>> = hidden
                .iter_mut()
                .zip(frames)
                .map(|(hidden, frame)| Job { hidden, frame, next: None })
                .collect();
            stepper.for_each(&mut jobs, |stepper, Job { hidden, frame, next }| {
                *next = Some(stepper.step(hidden, frame));
            });
            jobs.into_iter().filter_map(|job| job.next).collect::<Vec<_>>()
        });
        Ok(predicted.into_iter().map(Frame::from).collect())
    }

    /// Observed frames after which predictions are as good as they become.
    #[getter]
    fn warm_up(&self) -> u32 {
        self.inner.description().warm_up
    }

    /// Time between two frames (s).
    #[getter]
    fn dt(&self) -> f64 {
        eddy_frames::decimal(self.inner.description().dt)
    }

    /// SHA-256 of the checkpoint, hexadecimal.
    #[getter]
    fn digest(&self) -> &str {
        self.inner.digest()
    }

    /// The checkpoint's `model.toml` as a dictionary.
    #[getter]
    fn description<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        values::render(py, self.inner.description())
    }

    /// What the network was not trained for in a stream that begins with this frame and has this stiffness, one sentence each.
    #[pyo3(signature = (first, *, stiffness=None))]
    fn warnings(&self, first: &Bound<'_, Frame>, stiffness: Option<f32>) -> PyResult<Vec<String>> {
        let stated = Stated { stiffness, ..Stated::default() };
        let warnings = self.inner.warnings(first.get().plane("first")?, stated);
        Ok(warnings.iter().map(ToString::to_string).collect())
    }

    fn __repr__(&self) -> String {
        let description = self.inner.description();
        format!(
            "Surrogate({} {}, digest={})",
            description.architecture.name(),
            description.core.name(),
            &self.inner.digest()[..12]
        )
    }
}

impl Stream {
    /// Checks that a frame belongs to this stream.
    fn check(&self, surrogate: &Bound<'_, Surrogate>, frame: FrameView<'_>) -> PyResult<()> {
        let expected = self.first.len();
        let found = frame.particles.len();
        if found != expected {
            return Err(wrong("frame", format!("{found} particles"), format!("{expected}")));
        }
        if !frame.particles.are_of(&self.first.material) {
            return Err(wrong("frame", "other materials", "those of the stream's first frame"));
        }
        surrogate.get().inner.fits(frame).map_err(unfit)
    }
}

#[pymethods]
impl Stream {
    /// Observes a frame, true or predicted, and returns the predicted next frame.
    fn step(&self, py: Python<'_>, frame: &Bound<'_, Frame>) -> PyResult<Frame> {
        let (surrogate, frame) = (self.surrogate.bind(py), frame.get().plane("frame")?);
        self.check(surrogate, FrameView::from(frame))?;
        let stepper = &surrogate.get().stepper;
        let next = detached(py, stepper, |stepper| stepper.step(&mut lock(&self.hidden), frame));
        Ok(next.into())
    }

    /// As `step`, with arrays: position and velocity are float32 [N, 2] and read in place; the results are new
    /// arrays, which may be written to.
    fn step_arrays<'py>(
        &self,
        py: Python<'py>,
        position: &Bound<'py, PyAny>,
        velocity: &Bound<'py, PyAny>,
    ) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyAny>)> {
        let shape = [Some(self.first.len()), Some(2)];
        let position = Argument::<f32>::new("position", position, &shape)?;
        let velocity = Argument::<f32>::new("velocity", velocity, &shape)?;
        let eddy_frames::Frame { stream, sequence, stamp, dt, domain, ref material, .. } =
            *self.first;
        let particles =
            Particles::Lists { position: position.rows(), velocity: velocity.rows(), material };
        let frame = FrameView { stream, sequence, stamp, dt, domain, particles };
        frame.check().map_err(|error| PyValueError::new_err(error.to_string()))?;
        let surrogate = self.surrogate.bind(py);
        let mut next = empty(&self.first);
        detached(py, &surrogate.get().stepper, |stepper| {
            stepper.step_into(&mut lock(&self.hidden), frame, &mut next);
        });
        let pairs = |values: Vec<[f32; 2]>| {
            let shape = [values.len(), 2];
            array(py, values.into_flattened(), shape)
        };
        Ok((pairs(next.position), pairs(next.velocity)))
    }

    /// Observes a frame, then its own predictions: a list of the next `frames` predicted frames.
    fn rollout(
        &self,
        py: Python<'_>,
        frame: &Bound<'_, Frame>,
        frames: usize,
    ) -> PyResult<Vec<Frame>> {
        let (surrogate, frame) = (self.surrogate.bind(py), frame.get().plane("frame")?);
        self.check(surrogate, FrameView::from(frame))?;
        let mut predicted: Vec<eddy_frames::Frame> = Vec::new();
        for _ in 0..frames {
            py.check_signals()?;
            let last = predicted.last().unwrap_or(frame);
            let step = |stepper: &mut Stepper| stepper.step(&mut lock(&self.hidden), last);
            let next = detached(py, &surrogate.get().stepper, step);
            predicted.push(next);
        }
        Ok(predicted.into_iter().map(Frame::from).collect())
    }

    /// A stream of its own with the same memory, for looking ahead.
    fn copy(&self, py: Python<'_>) -> Self {
        let hidden = Mutex::new(detached(py, &self.hidden, |hidden| hidden.clone()));
        Self { surrogate: self.surrogate.clone_ref(py), hidden, first: Arc::clone(&self.first) }
    }

    /// Forgets the observed frames, but keeps the rest shape of solids: after an interruption.
    fn forget(&self, py: Python<'_>) {
        detached(py, &self.hidden, HiddenState::forget);
    }

    fn __len__(&self) -> usize {
        self.first.len()
    }
}

/// The network of the checkpoint in a directory, or of the package's.
pub(crate) fn load(
    py: Python<'_>,
    checkpoint: Option<&Path>,
    threads: Option<NonZeroUsize>,
) -> PyResult<engine::Surrogate> {
    let load = || {
        let checkpoint = Checkpoint::load_or_shipped(checkpoint)?;
        engine::Surrogate::load(&checkpoint, threads)
    };
    py.detach(load).map_err(raise::<CheckpointError>)
}

/// A frame with the materials of another, which has no positions.
fn without_motion(of: &eddy_frames::Frame) -> eddy_frames::Frame {
    eddy_frames::Frame {
        sequence: of.sequence,
        stamp: of.stamp,
        material: of.material.clone(),
        ..empty(of)
    }
}

/// A frame to predict into.
fn empty(like: &eddy_frames::Frame) -> eddy_frames::Frame {
    eddy_frames::Frame {
        stream: like.stream,
        sequence: 0,
        stamp: Stamp(0),
        dt: like.dt,
        domain: like.domain,
        position: Vec::new(),
        velocity: Vec::new(),
        material: Vec::new(),
    }
}

/// A frame that the network cannot predict.
fn unfit(error: ModelError) -> PyErr {
    PyValueError::new_err(error.to_string())
}
