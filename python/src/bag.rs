//! `Bag` and `BagWriter`: MCAP bags in rosbag2's format.

use std::{path::PathBuf, sync::Mutex};

use eddy_bag::{
    BagReader, Compression, Selection, TopicId, WriterOptions,
    custom_data::{CustomData, check_entry},
};
use eddy_frames::{AnyFrame, Stamp, clock, with_frame};
use eddy_messages::{
    FrameCdr, Header, Message as _, ParticleFrame, PredictionStatus, QosProfile, StreamState,
    TypeSupport, cdr,
};
use pyo3::{
    exceptions::PyValueError,
    prelude::*,
    types::{PyBytes, PyDict, PyMapping, PyString},
};

use crate::{
    arrays::{array, wrong},
    detached,
    errors::{BagError, raise},
    frame::Frame,
    lock,
    tools::{self, At, Described},
};

/// A bag opened for reading: `path` is a directory with metadata.yaml, or an MCAP file.
#[pyclass(frozen, module = "eddy")]
pub(crate) struct Bag {
    inner: BagReader,
}

#[pymethods]
impl Bag {
    #[new]
    fn new(py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        let inner = py.detach(|| BagReader::open(&path)).map_err(raise::<BagError>)?;
        Ok(Self { inner })
    }

    /// The topics: dictionaries with `name`, `type`, `messages` and `definition`.
    #[getter]
    fn topics<'py>(&self, py: Python<'py>) -> PyResult<Vec<Bound<'py, PyDict>>> {
        let topics = self.inner.topics().iter().map(|topic| {
            let entry = PyDict::new(py);
            entry.set_item("name", &topic.name)?;
            entry.set_item("type", &topic.type_name)?;
            entry.set_item("messages", topic.message_count)?;
            entry.set_item("definition", &topic.schema)?;
            Ok(entry)
        });
        topics.collect()
    }

    /// The entries of `custom_data` in metadata.yaml.
    #[getter]
    fn custom_data(&self) -> CustomData {
        self.inner.custom_data().clone()
    }

    /// An iterator over the frames of a topic in the order of their log time.
    #[pyo3(signature = (topic="/particles"))]
    fn frames(&self, topic: &str) -> PyResult<Frames> {
        let frames = self.inner.frames_of(topic).map_err(raise::<BagError>)?;
        Ok(Frames { inner: Mutex::new(frames) })
    }

    /// The frames of a stream of a topic as arrays: `position`, `velocity` float32 [T, N, 2] or [T, N, 3], `material` uint8 [N],
    /// `sequence` uint64 [T], `time` float64 [T] (s). The stream may be omitted if there is one only.
    #[pyo3(signature = (topic="/particles", *, stream=None))]
    fn arrays<'py>(
        &self,
        py: Python<'py>,
        topic: &str,
        stream: Option<u64>,
    ) -> PyResult<Bound<'py, PyDict>> {
        let frames = self.inner.frames_of(topic).map_err(raise::<BagError>)?;
        let read = || stack(topic, frames, stream);
        let Stacked { dimension, particles, position, velocity, material, sequence, time } =
            py.detach(read)?;
        let frames = sequence.len();
        let cube = |numbers: Vec<f32>| array(py, numbers, [frames, particles, dimension]);
        let arrays = PyDict::new(py);
        arrays.set_item("position", cube(position))?;
        arrays.set_item("velocity", cube(velocity))?;
        arrays.set_item("material", array(py, material, [particles]))?;
        arrays.set_item("sequence", array(py, sequence, [frames]))?;
        arrays.set_item("time", array(py, time, [frames]))?;
        Ok(arrays)
    }

    /// The tools beside the frames of a stream of a topic: `tools`, what they are, dictionaries with `name`, `shape` and `contact` as in a
    /// scene; at each of T frames, by their `sequence` uint64 [T], of each of K tools `pose` float32 [T, K, 3] (x, y, angle; domain lengths,
    /// rad), `twist` float32 [T, K, 3] (their rates before the frame, per s) and `wrench` float64 [T, K, 3] (mean force x, y, density x domain lengths^3
    /// per s^2, and torque about its position, x domain lengths, before the frame; NaN where unknown). The stream may be omitted if there is one only.
    #[pyo3(signature = (topic="/particles", *, stream=None))]
    fn tools<'py>(
        &self,
        py: Python<'py>,
        topic: &str,
        stream: Option<u64>,
    ) -> PyResult<Bound<'py, PyDict>> {
        tools::read(py, &self.inner, topic, stream)
    }

    /// An iterator over messages in the order of their log time: of all topics, or of some; from `start` to `end` (log time
    /// in ns, inclusive).
    #[pyo3(signature = (topics=None, *, start=None, end=None))]
    fn messages(
        &self,
        topics: Option<Topics>,
        start: Option<i64>,
        end: Option<i64>,
    ) -> PyResult<Messages> {
        let topics: Option<Vec<String>> = topics.map(Topics::into);
        let known = |name: &str| self.inner.topics().iter().any(|topic| topic.name == name);
        if let Some(unknown) = topics.iter().flatten().find(|name| !known(name)) {
            let names: Vec<_> = self.inner.topics().iter().map(|topic| &*topic.name).collect();
            return Err(wrong("topics", unknown, names.join(", ")));
        }
        let selection = Selection { topics, from: start.map(Stamp), until: end.map(Stamp) };
        Ok(Messages { inner: Mutex::new(self.inner.select(&selection)) })
    }

    /// Smallest log time (ns); None without messages.
    #[getter]
    fn start(&self) -> Option<i64> {
        self.inner.start().map(|stamp| stamp.0)
    }

    /// Largest log time (ns); None without messages.
    #[getter]
    fn end(&self) -> Option<i64> {
        self.inner.end().map(|stamp| stamp.0)
    }

    /// The first damage found when the bag was opened, in words; None for an intact bag.
    #[getter]
    fn damage(&self) -> Option<String> {
        self.inner.damage().map(|damage| damage.to_string())
    }

    /// The path it was opened with.
    #[getter]
    fn path(&self) -> PathBuf {
        self.inner.path().to_owned()
    }

    fn __len__(&self) -> usize {
        self.inner.message_count() as usize
    }

    fn __repr__(&self) -> String {
        let topics = self.inner.topics().len();
        format!(
            "Bag({:?}, topics={topics}, messages={})",
            self.inner.path(),
            self.inner.message_count()
        )
    }
}

/// One topic, or several.
#[derive(FromPyObject)]
enum Topics {
    One(String),
    Several(Vec<String>),
}

impl From<Topics> for Vec<String> {
    fn from(topics: Topics) -> Self {
        match topics {
            Topics::One(topic) => vec![topic],
            Topics::Several(topics) => topics,
        }
    }
}

/// The frames of one stream, one after the other.
#[derive(Default)]
struct Stacked {
    dimension: usize,
    particles: usize,
    position: Vec<f32>,
    velocity: Vec<f32>,
    material: Vec<u8>,
    sequence: Vec<u64>,
    time: Vec<f64>,
}

impl Stacked {
    fn add<const D: usize>(&mut self, topic: &str, frame: &eddy_frames::Frame<D>) -> PyResult<()> {
        let material = frame.material.iter().map(|&material| material as u8);
        if self.sequence.is_empty() {
            (self.dimension, self.particles) = (D, frame.len());
            self.material = material.collect();
        } else if D != self.dimension {
            let found = format!("{D} dimensions at sequence {}", frame.sequence);
            return Err(wrong(topic, found, self.dimension));
        } else if !material.eq(self.material.iter().copied()) {
            let found = format!("other particles at sequence {}", frame.sequence);
            return Err(wrong(topic, found, "those of the first frame (use Bag.frames)"));
        }
        self.position.extend_from_slice(frame.position.as_flattened());
        self.velocity.extend_from_slice(frame.velocity.as_flattened());
        self.sequence.push(frame.sequence);
        self.time.push(frame.stamp.seconds());
        Ok(())
    }
}

/// Reads the frames of a stream, whose particles must be the same in each.
fn stack(
    topic: &str,
    frames: eddy_bag::Frames<AnyFrame>,
    stream: Option<u64>,
) -> PyResult<Stacked> {
    let mut stacked = Stacked::default();
    let mut only = stream;
    for frame in frames {
        let frame = frame.map_err(raise::<BagError>)?;
        let found = with_frame!(&frame, frame => frame.stream);
        let expected = *only.get_or_insert(found);
        if found == expected {
            with_frame!(&frame, frame => stacked.add(topic, frame))?;
        } else if stream.is_none() {
            let found = format!("frames of streams {expected} and {found}");
            return Err(wrong(topic, found, "one stream: pass its id as `stream`"));
        }
    }
    if stacked.sequence.is_empty() {
        let found = format!("no frames of stream {}", stream.unwrap_or_default());
        return Err(wrong(topic, found, "at least one"));
    }
    Ok(stacked)
}

/// An iterator over frames.
#[pyclass(frozen, module = "eddy")]
pub(crate) struct Frames {
    inner: Mutex<eddy_bag::Frames<AnyFrame>>,
}

#[pymethods]
impl Frames {
    fn __iter__(slf: Bound<'_, Self>) -> Bound<'_, Self> {
        slf
    }

    fn __next__(&self, py: Python<'_>) -> PyResult<Option<Frame>> {
        let next =
            detached(py, &self.inner, Iterator::next).transpose().map_err(raise::<BagError>)?;
        Ok(next.map(Frame::from))
    }
}

/// An iterator over messages.
#[pyclass(frozen, module = "eddy")]
pub(crate) struct Messages {
    inner: Mutex<eddy_bag::Messages>,
}

#[pymethods]
impl Messages {
    fn __iter__(slf: Bound<'_, Self>) -> Bound<'_, Self> {
        slf
    }

    fn __next__(&self, py: Python<'_>) -> PyResult<Option<Message>> {
        let next =
            detached(py, &self.inner, Iterator::next).transpose().map_err(raise::<BagError>)?;
        Ok(next.map(|inner| Message { inner }))
    }
}

/// A message of a bag.
#[pyclass(frozen, module = "eddy")]
pub(crate) struct Message {
    inner: eddy_bag::BagMessage,
}

#[pymethods]
impl Message {
    /// Name of the topic.
    #[getter]
    fn topic<'py>(&self, py: Python<'py>) -> Bound<'py, PyString> {
        PyString::new(py, &self.inner.topic)
    }

    /// Name of its type, such as `eddy_msgs/msg/ParticleFrame`.
    #[getter]
    fn r#type<'py>(&self, py: Python<'py>) -> Bound<'py, PyString> {
        PyString::new(py, &self.inner.type_name)
    }

    /// Time of reception (ns).
    #[getter]
    fn log_time(&self) -> i64 {
        self.inner.log_time.0
    }

    /// Time of publication (ns).
    #[getter]
    fn publish_time(&self) -> i64 {
        self.inner.publish_time.0
    }

    /// CDR with its 4-byte header.
    #[getter]
    fn data<'py>(&self, py: Python<'py>) -> Bound<'py, PyBytes> {
        PyBytes::new(py, &self.inner.data)
    }

    fn __repr__(&self) -> String {
        let Self { inner } = self;
        format!("Message({}, {}, {} bytes)", inner.topic, inner.type_name, inner.data.len())
    }
}

/// Writes a bag. Use it in a `with` statement, or call `close`.
///
/// `path` is the directory of the bag, which must not exist. `compression` is none, lz4 or zstd. `custom_data` are entries of
/// custom_data in metadata.yaml; eddy_stiffness is Young's modulus of the recorded matter (density x velocity^2), a positive number
/// as text, and eddy_gravity is gravity along y, negative is down (domain lengths per s^2).
#[pyclass(frozen, module = "eddy")]
pub(crate) struct BagWriter {
    /// None after `close`.
    inner: Mutex<Option<eddy_bag::BagWriter>>,
    /// The tools that it has.
    described: Mutex<Described>,
}

impl BagWriter {
    fn with<T: Send>(
        &self,
        py: Python<'_>,
        work: impl FnOnce(&mut eddy_bag::BagWriter) -> Result<T, eddy_bag::BagError> + Send,
    ) -> PyResult<T> {
        detached(py, &self.inner, |writer| writer.as_mut().map(work))
            .ok_or_else(|| PyValueError::new_err("this bag is closed"))?
            .map_err(raise::<BagError>)
    }
}

#[pymethods]
impl BagWriter {
    #[new]
    #[pyo3(signature = (path, *, compression="zstd", custom_data=None))]
    fn new(
        path: PathBuf,
        compression: &str,
        custom_data: Option<&Bound<'_, PyMapping>>,
    ) -> PyResult<Self> {
        let compression = match compression {
            "none" => Compression::None,
            "lz4" => Compression::Lz4,
            "zstd" => Compression::Zstd,
            other => return Err(wrong("compression", other, "none, lz4 or zstd")),
        };
        let entries = custom_data.map(|entries| entries.items()).transpose()?;
        let custom_data: Vec<(String, String)> =
            entries.map(|entries| entries.extract()).transpose()?.unwrap_or_default();
        for (key, value) in &custom_data {
            check_entry(key, value)
                .map_err(|expected| wrong("custom_data", format!("{key}={value}"), expected))?;
        }
        let options = WriterOptions { compression, ..WriterOptions::default() };
        let mut inner = eddy_bag::BagWriter::create(&path, options).map_err(raise::<BagError>)?;
        inner.extend_custom_data(custom_data);
        Ok(Self { inner: Mutex::new(Some(inner)), described: Mutex::default() })
    }

    /// Appends a frame. Its log time is its simulation time, counted from that of the first frame if the bag begins before 0, unless
    /// given (ns).
    #[pyo3(signature = (frame, topic="/particles", *, log_time=None))]
    fn write_frame(
        &self,
        py: Python<'_>,
        frame: &Bound<'_, Frame>,
        topic: &str,
        log_time: Option<i64>,
    ) -> PyResult<()> {
        let frame = &frame.get().inner;
        self.with(py, |writer| {
            let topic = writer.topic(topic, ParticleFrame::TYPE)?;
            let stamp = with_frame!(frame, frame => frame.stamp);
            match log_time {
                None => writer.write_stamped(topic, stamp, &frame.to_cdr()),
                Some(time) => writer.write(topic, Stamp(time), Stamp(time), &frame.to_cdr()),
            }
        })
    }

    /// Appends where the tools are at a frame, and before the first one of its stream what they are: `tools` and the arrays `pose`, `twist`,
    /// `wrench` of K tools, [K, 3] each, as in `Bag.tools`. Without `twist` they rest; without `wrench` it is unknown.
    #[pyo3(signature = (frame, tools, pose, topic="/particles", *, twist=None, wrench=None))]
    #[expect(clippy::too_many_arguments, reason = "the parameters of a Python method")]
    fn write_tools(
        &self,
        py: Python<'_>,
        frame: &Bound<'_, Frame>,
        tools: &Bound<'_, PyAny>,
        pose: &Bound<'_, PyAny>,
        topic: &str,
        twist: Option<&Bound<'_, PyAny>>,
        wrench: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<()> {
        let at = At::new(frame.get().plane("frame")?, tools, pose, twist, wrench)?;
        match self.with(py, |writer| at.write(writer, &mut lock(&self.described), topic))? {
            true => Ok(()),
            false => Err(wrong("tools", "other tools", "those of the stream's first frame")),
        }
    }

    /// Appends a predicted frame, and on `topic`/status from which frame it was predicted, as a node publishes both: what
    /// `evaluate(predictions=)` and `eddy eval --predictions` read. `source_sequence` is the number of the last observed frame;
    /// that of the prediction is larger. `model` names the predictor.
    #[pyo3(signature = (frame, source_sequence, topic="/prediction", *, model=""))]
    fn write_prediction(
        &self,
        py: Python<'_>,
        frame: &Bound<'_, Frame>,
        source_sequence: u64,
        topic: &str,
        model: &str,
    ) -> PyResult<()> {
        let frame = &frame.get().inner;
        let (stream, sequence, stamp) =
            with_frame!(frame, frame => (frame.stream, frame.sequence, frame.stamp));
        let ahead = sequence.checked_sub(source_sequence).filter(|ahead| *ahead > 0);
        let Some(horizon) = ahead.and_then(|ahead| u32::try_from(ahead).ok()) else {
            return Err(wrong(
                "source_sequence",
                source_sequence,
                format!("below {sequence}, that of the frame"),
            ));
        };
        let status = PredictionStatus {
            header: Header::world(stamp),
            stream,
            source_sequence,
            horizon,
            state: StreamState::FreeRunning as u8,
            latency: 0.0,
            model: model.to_owned(),
        };
        let status = cdr::encode(&status);
        self.with(py, |writer| {
            let frames = writer.topic(topic, ParticleFrame::TYPE)?;
            let statuses = writer.topic(&format!("{topic}/status"), PredictionStatus::TYPE)?;
            writer.write_stamped(frames, stamp, &frame.to_cdr())?;
            writer.write_stamped(statuses, stamp, &status)
        })
    }

    /// Appends a message of any type: CDR bytes with their header. Without a definition (the .msg text of the type and all its
    /// dependencies), the type must be one that eddy knows. Times are in ns; by default now.
    #[pyo3(signature = (topic, r#type, data, *, definition=None, log_time=None, publish_time=None))]
    #[expect(clippy::too_many_arguments, reason = "the fields of a message")]
    fn write(
        &self,
        py: Python<'_>,
        topic: &str,
        r#type: &str,
        data: &[u8],
        definition: Option<&str>,
        log_time: Option<i64>,
        publish_time: Option<i64>,
    ) -> PyResult<()> {
        let log_time = log_time.map_or_else(clock::wall, Stamp);
        let publish_time = publish_time.map_or(log_time, Stamp);
        let support = definition.map(|definition| TypeSupport::from_schema(r#type, definition));
        let support = support
            .transpose()
            .map_err(|error| PyValueError::new_err(format!("definition: {error}")))?;
        self.with(py, |writer| {
            let topic: TopicId = match &support {
                None => writer.topic(topic, r#type)?,
                Some(support) => writer.offered_topic(topic, support, &[QosProfile::default()])?,
            };
            writer.write(topic, log_time, publish_time, data)
        })
    }

    /// Finishes the bag and returns the number of its messages. A bag that is closed stays as it is.
    fn close(&self, py: Python<'_>) -> PyResult<u64> {
        let finish = |writer: eddy_bag::BagWriter| {
            let messages = writer.messages();
            writer.finish().map(|_| messages)
        };
        let finished = detached(py, &self.inner, |writer| writer.take().map(finish));
        finished.unwrap_or(Ok(0)).map_err(raise::<BagError>)
    }

    fn __enter__(slf: Bound<'_, Self>) -> Bound<'_, Self> {
        slf
    }

    #[pyo3(signature = (*_error))]
    fn __exit__(&self, py: Python<'_>, _error: &Bound<'_, pyo3::types::PyTuple>) -> PyResult<bool> {
        self.close(py)?;
        Ok(false)
    }
}
