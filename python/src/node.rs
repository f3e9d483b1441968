//! `Node`: predictions of live streams, on a thread of its own.

use std::{
    path::PathBuf,
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, Ordering},
    },
    thread::{self, JoinHandle},
    time::Duration,
};

use eddy_frames::{FrameView, clock::Clock};
use eddy_messages::services::{Parameter, ParameterKind, ParameterValue};
use eddy_node::{
    Counters, DriveError, LiveNode, NodeHandle, NodeLinks, NodeReport, NodeRequest, NodeResponse,
    NodeSettings, Observer, PARAMETERS, Prediction, RequestError, SurrogateNode,
    diagnostics::Rates,
    ros::{RosNode, TopicQos},
};
use eddy_transport::{Link, Reliability};
use pyo3::{
    exceptions::{PyTypeError, PyValueError},
    prelude::*,
    types::{PyBool, PyDict, PyFloat, PyInt, PyString},
};

use crate::{
    arrays::wrong,
    detached,
    errors::{NodeError, chain, raise},
    lock,
    surrogate::{self, Surrogate},
};

/// Time between two looks at a running node, and for signals.
const INTERVAL: Duration = Duration::from_millis(50);
/// How long a running node may take to accept a request.
const TIMEOUT: Duration = Duration::from_secs(5);

/// A node that receives frames on one link and publishes predictions on others, as `eddy node` does: on Zenoh, shared memory
/// (`shm`) or DDS, for ROS 2 and for programs of eddy. It runs on a thread of its own.
///
/// Use it in a `with` statement, or call `start` and `stop`. A node that was stopped can be started again.
///
/// `input` and `output` are links, such as `zenoh:/particles`, or for `output` a list of them; topics may be relative to
/// the `namespace` of the node, which ROS knows by its `name`. `surrogate` is a loaded one, or the directory of a
/// checkpoint, by default the particle model of the package. `settings` has the parameters of the node, such as
/// `{"horizon": 5}`. With `reliability="block"` the node waits for subscribers, with `drop` it never does.
#[pyclass(frozen, module = "eddy")]
pub(crate) struct Node {
    surrogate: eddy_inference::engine::Surrogate,
    links: NodeLinks,
    ros: RosNode,
    reliability: Reliability,
    /// What the next start begins with.
    settings: Mutex<NodeSettings>,
    running: Mutex<Option<Running>>,
    seen: Arc<Mutex<Seen>>,
}

/// A node on its thread.
struct Running {
    stop: Arc<AtomicBool>,
    handle: Arc<NodeHandle>,
    thread: Option<JoinHandle<Result<(), DriveError>>>,
}

impl Running {
    fn is_finished(&self) -> bool {
        self.thread.as_ref().is_none_or(JoinHandle::is_finished)
    }

    /// Stops the node, which predicts from the frames that have arrived, and waits for it.
    fn end(mut self) -> PyResult<()> {
        self.stop.store(true, Ordering::Relaxed);
        match self.thread.take().map(JoinHandle::join) {
            None => Ok(()),
            Some(Ok(outcome)) => outcome.map_err(raise::<NodeError>),
            Some(Err(panic)) => std::panic::resume_unwind(panic),
        }
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // A node that nobody asks any more.
            let _ = thread.join();
        }
    }
}

/// What the node reported last.
#[derive(Default)]
struct Seen {
    counters: Counters,
    rates: Option<Rates>,
    streams: usize,
}

/// Keeps the reports of a running node.
struct Reports(Arc<Mutex<Seen>>);

impl Observer for Reports {
    fn observed(&mut self, _: &FrameView<'_>) {}

    fn predicted(&mut self, _: &Prediction<'_>) {}

    fn reported(&mut self, report: &NodeReport<'_>) {
        let &NodeReport { rates, counters, streams, .. } = report;
        *lock(&self.0) = Seen { counters: counters.clone(), rates: Some(rates), streams };
    }
}

/// A loaded surrogate, or where a checkpoint is.
#[derive(FromPyObject)]
enum Model<'py> {
    Loaded(Bound<'py, Surrogate>),
    Path(PathBuf),
}

/// One output, or several.
#[derive(FromPyObject)]
enum Outputs {
    One(String),
    Several(Vec<String>),
}

#[pymethods]
impl Node {
    #[new]
    #[pyo3(signature = (input="zenoh:particles", output=Outputs::One("zenoh:prediction".to_owned()), surrogate=None, *, settings=None, reliability="drop", name="eddy_node", namespace="/"), text_signature = "(input='zenoh:particles', output='zenoh:prediction', surrogate=None, *, settings=None, reliability='drop', name='eddy_node', namespace='/')")]
    #[expect(clippy::too_many_arguments, reason = "the options of a node")]
    fn new(
        py: Python<'_>,
        input: &str,
        output: Outputs,
        surrogate: Option<Model<'_>>,
        settings: Option<&Bound<'_, PyDict>>,
        reliability: &str,
        name: &str,
        namespace: &str,
    ) -> PyResult<Self> {
        let reliability = match reliability {
            "block" => Reliability::Block,
            "drop" => Reliability::Drop,
            other => return Err(wrong("reliability", other, "block or drop")),
        };
        let ros = RosNode::named(name, namespace).map_err(invalid)?;
        let outputs = match output {
            Outputs::One(output) => vec![output],
            Outputs::Several(outputs) => outputs,
        };
        let link = |text: &str| Link::parse_of_node(text).map_err(invalid);
        let outputs = outputs.iter().map(|text| link(text)).collect::<PyResult<Vec<_>>>()?;
        if outputs.is_empty() {
            return Err(wrong("output", "no links", "at least 1"));
        }
        let links = NodeLinks { input: link(input)?, outputs };
        let mut node_settings = NodeSettings::default();
        for parameter in settings.map(parameters).transpose()?.unwrap_or_default() {
            node_settings.set(&parameter).map_err(invalid)?;
        }
        let is_in_group = !node_settings.group.is_empty();
        links.renamed(&ros).check(false, is_in_group).map_err(invalid)?;
        let surrogate = match surrogate {
            Some(Model::Loaded(surrogate)) => surrogate.get().inner.clone(),
            Some(Model::Path(path)) => surrogate::load(py, Some(&path), None)?,
            None => surrogate::load(py, None, None)?,
        };
        Ok(Self {
            surrogate,
            links,
            ros,
            reliability,
            settings: Mutex::new(node_settings),
            running: Mutex::default(),
            seen: Arc::default(),
        })
    }

    /// Opens the topics and starts to predict. Counters begin at zero.
    ///
    /// Raises `NodeError` if a topic cannot be opened, and `ValueError` if the node runs.
    fn start(&self, py: Python<'_>) -> PyResult<()> {
        detached(py, &self.running, |running| {
            if running.as_ref().is_some_and(|running| !running.is_finished()) {
                return Err(PyValueError::new_err("this node is running"));
            }
            if let Some(ended) = running.take() {
                ended.end()?;
            }
            let stop = Arc::new(AtomicBool::new(false));
            let node = SurrogateNode::new(self.surrogate.clone(), lock(&self.settings).clone());
            let node = node.map_err(invalid)?;
            let (qos, ends) = (TopicQos::default(), Arc::clone(&stop));
            let live = LiveNode::open(node, &self.links, &self.ros, self.reliability, qos, ends);
            let mut live = live.map_err(|error| raise::<NodeError>(chain(&error)))?;
            *lock(&self.seen) = Seen::default();
            if let Some(first) = live.outputs.first_mut() {
                first.observers.push(Box::new(Reports(Arc::clone(&self.seen))));
            }
            let handle = Arc::clone(live.handle());
            let thread = thread::Builder::new()
                .name(self.ros.name().to_owned())
                .spawn(move || live.run())
                .map_err(|error| raise::<NodeError>(format!("cannot start a thread: {error}")))?;
            *running = Some(Running { stop, handle, thread: Some(thread) });
            Ok(())
        })
    }

    /// Stops the node, which first predicts from the frames that have arrived (up to a second). Does nothing if it does not run.
    ///
    /// Raises `NodeError` if its input has failed meanwhile.
    fn stop(&self, py: Python<'_>) -> PyResult<()> {
        detached(py, &self.running, |running| running.take().map_or(Ok(()), Running::end))
    }

    /// Waits until the node has ended (its input failed, or another thread stopped it), at most `timeout` seconds. Returns
    /// whether it has ended. Ctrl-C ends the waiting, not the node.
    ///
    /// Raises `NodeError` if its input has failed.
    #[pyo3(signature = (timeout=None))]
    fn wait(&self, py: Python<'_>, timeout: Option<f64>) -> PyResult<bool> {
        let timeout = match timeout {
            None => None,
            Some(seconds) => Some(
                Duration::try_from_secs_f64(seconds)
                    .map_err(|_| wrong("timeout", seconds, "seconds, not negative"))?,
            ),
        };
        let clock = Clock::start();
        loop {
            py.check_signals()?;
            let ended = detached(py, &self.running, |running| match running {
                Some(live) if !live.is_finished() => None,
                _ => Some(running.take().map_or(Ok(()), Running::end)),
            });
            if let Some(outcome) = ended {
                return outcome.map(|()| true);
            }
            let left = timeout.map(|timeout| timeout.saturating_sub(clock.now()));
            if left.is_some_and(|left| left.is_zero()) {
                return Ok(false);
            }
            py.detach(|| thread::sleep(left.unwrap_or(INTERVAL).min(INTERVAL)));
        }
    }

    /// Whether the node runs.
    #[getter]
    fn running(&self, py: Python<'_>) -> bool {
        detached(py, &self.running, |running| {
            running.as_ref().is_some_and(|running| !running.is_finished())
        })
    }

    /// Changes parameters, all or none, of the running node and of its next start.
    ///
    /// Raises `ValueError` with the parameter, the value found and those expected.
    fn set(&self, py: Python<'_>, settings: &Bound<'_, PyDict>) -> PyResult<()> {
        let parameters = parameters(settings)?;
        let mut changed = detached(py, &self.settings, |settings| settings.clone());
        for parameter in &parameters {
            changed.set(parameter).map_err(invalid)?;
        }
        self.request(py, NodeRequest::Set(parameters))?;
        detached(py, &self.settings, |settings| *settings = changed);
        Ok(())
    }

    /// Forgets all streams, which then warm up again. Returns their number.
    fn reset(&self, py: Python<'_>) -> PyResult<usize> {
        match self.request(py, NodeRequest::Reset)? {
            Some(NodeResponse::Reset(streams)) => Ok(streams),
            _ => Ok(0),
        }
    }

    /// The parameters of the node.
    #[getter]
    fn settings<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        // ROS may have changed those of a running node.
        let settings = match self.request(py, NodeRequest::Settings) {
            Ok(Some(NodeResponse::Settings(settings))) => settings,
            _ => detached(py, &self.settings, |settings| settings.clone()),
        };
        let entries = PyDict::new(py);
        for spec in PARAMETERS {
            let value = spec.get(&settings);
            match value.kind() {
                Ok(ParameterKind::Bool) => entries.set_item(spec.name, value.bool_value)?,
                Ok(ParameterKind::Integer) => entries.set_item(spec.name, value.integer_value)?,
                Ok(ParameterKind::Double) => entries.set_item(spec.name, value.double_value)?,
                _ => entries.set_item(spec.name, value.string_value)?,
            }
        }
        Ok(entries)
    }

    /// Counts since the start, as of the last second: `received`, `published`, `missing`, `late`, ...
    #[getter]
    fn counters<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let counters = detached(py, &self.seen, |seen| seen.counters.named());
        let entries = PyDict::new(py);
        for (name, count) in counters {
            entries.set_item(name, count)?;
        }
        Ok(entries)
    }

    /// Predictions per second (`rate`), median and 99th percentile of the time from a frame to its prediction (`latency_p50`,
    /// `latency_p99`, s), both of the last second, and the number of `streams`.
    #[getter]
    fn status<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let (rates, streams) = detached(py, &self.seen, |seen| (seen.rates, seen.streams));
        let entries = PyDict::new(py);
        let seconds = |latency: fn(&Rates) -> Duration| {
            rates.as_ref().map_or(0.0, |rates| latency(rates).as_secs_f64())
        };
        entries.set_item("rate", rates.map_or(0.0, |rates| rates.rate))?;
        entries.set_item("latency_p50", seconds(|rates| rates.latency_p50))?;
        entries.set_item("latency_p99", seconds(|rates| rates.latency_p99))?;
        entries.set_item("streams", streams)?;
        Ok(entries)
    }

    /// The link that frames come from, with the absolute name of its topic.
    #[getter]
    fn input(&self) -> String {
        self.ros.link(&self.links.input).to_string()
    }

    /// The links that predictions go to, with the absolute names of their topics.
    #[getter]
    fn outputs(&self) -> Vec<String> {
        self.links.outputs.iter().map(|link| self.ros.link(link).to_string()).collect()
    }

    /// Namespace and name, such as `/robot1/eddy_node`.
    #[getter]
    fn name(&self) -> String {
        self.ros.full_name()
    }

    /// Starts the node.
    fn __enter__(slf: Bound<'_, Self>) -> PyResult<Bound<'_, Self>> {
        slf.get().start(slf.py())?;
        Ok(slf)
    }

    /// Stops the node.
    #[pyo3(signature = (*_error))]
    fn __exit__(&self, py: Python<'_>, _error: &Bound<'_, pyo3::types::PyTuple>) -> PyResult<bool> {
        self.stop(py)?;
        Ok(false)
    }

    fn __repr__(&self) -> String {
        format!("Node({}, {} -> {})", self.name(), self.input(), self.outputs().join(", "))
    }
}

impl Node {
    /// Sends a request to the running node; `None` if it does not run.
    fn request(&self, py: Python<'_>, request: NodeRequest) -> PyResult<Option<NodeResponse>> {
        let handle = detached(py, &self.running, |running| {
            let running = running.as_ref().filter(|running| !running.is_finished());
            running.map(|running| Arc::clone(&running.handle))
        });
        let Some(handle) = handle else { return Ok(None) };
        py.detach(|| handle.request(request, TIMEOUT)).map(Some).map_err(|error| match error {
            RequestError::Rejected(error) => invalid(error),
            RequestError::Timeout { .. } => raise::<NodeError>(error),
        })
    }
}

/// Parameters by their names.
fn parameters(settings: &Bound<'_, PyDict>) -> PyResult<Vec<Parameter>> {
    let parameter = |(name, value): (Bound<'_, PyAny>, Bound<'_, PyAny>)| {
        let name: String = name.extract()?;
        // A bool is an int in Python.
        let value = if value.is_instance_of::<PyBool>() {
            ParameterValue::bool(value.extract()?)
        } else if value.is_instance_of::<PyInt>() {
            ParameterValue::integer(value.extract()?)
        } else if value.is_instance_of::<PyFloat>() {
            ParameterValue::double(value.extract()?)
        } else if value.is_instance_of::<PyString>() {
            ParameterValue::string(value.extract()?)
        } else {
            let found = value.get_type().name()?;
            let message =
                format!("{name}: found {found}, expected a bool, an int, a float or a str");
            return Err(PyTypeError::new_err(message));
        };
        Ok(Parameter { name, value })
    };
    settings.iter().map(parameter).collect()
}

/// Arguments that are wrong by themselves.
fn invalid(error: impl std::fmt::Display) -> PyErr {
    PyValueError::new_err(error.to_string())
}
