//! The tools of streams, in bags.

use std::collections::{BTreeMap, btree_map::Entry};

use eddy_bag::{BagReader, RecordedTools};
use eddy_frames::{
    Frame,
    tool::{self, Contact, Outline, Pose, ToolFrame, ToolState, Tools, Wrench},
};
use eddy_messages::{Message as _, ToolDescription, cdr, tool_topics};
use pyo3::{prelude::*, types::PyDict};
use serde::{Deserialize, Serialize};

use crate::{
    arrays::{Argument, array, wrong},
    errors::{BagError, raise},
    values,
};

/// A tool as in a scene, without keyframes.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Tool {
    name: String,
    shape: Outline,
    #[serde(default)]
    contact: Contact,
}

/// The tools beside the frames of a stream of a topic, as dictionary.
///
/// # Errors
/// `BagError` if they cannot be used, `ValueError` if there are none of the stream, or of several streams without `stream`.
pub(crate) fn read<'py>(
    py: Python<'py>,
    bag: &BagReader,
    topic: &str,
    stream: Option<u64>,
) -> PyResult<Bound<'py, PyDict>> {
    let mut all = py.detach(|| bag.tools(topic)).map_err(raise::<BagError>)?;
    let known: Vec<u64> = all.keys().copied().collect();
    let RecordedTools { tools, frames } = match (stream, &known[..]) {
        (Some(stream), _) => all.remove(&stream),
        (None, [only]) => all.remove(only),
        (None, _) => None,
    }
    .ok_or_else(|| {
        let found = match stream {
            Some(stream) => format!("tools of streams {known:?}, none of {stream}"),
            None => format!("tools of streams {known:?}"),
        };
        wrong(topic, found, "tools of one stream (pass the id of another as `stream`)")
    })?;
    let shape = [frames.len(), tools.tools.len(), 3];
    let (mut pose, mut twist, mut wrench) = (Vec::new(), Vec::new(), Vec::new());
    for ToolFrame { states, wrenches, .. } in frames.values() {
        for (index, &ToolState { pose: at, velocity: [u, v], spin }) in states.iter().enumerate() {
            pose.extend([at.position[0], at.position[1], at.angle]);
            twist.extend([u, v, spin]);
            let known = wrenches.get(index);
            let [x, y, torque] =
                known.map_or([f64::NAN; 3], |it| [it.force[0], it.force[1], it.torque]);
            wrench.extend([x, y, torque]);
        }
    }
    let described = |tool::Tool { name, shape, contact }: tool::Tool| Tool { name, shape, contact };
    let described: Vec<Tool> = tools.tools.into_iter().map(described).collect();
    let found = PyDict::new(py);
    found.set_item("tools", values::render(py, &described)?)?;
    found.set_item("sequence", array(py, frames.keys().copied().collect(), shape[0]))?;
    found.set_item("pose", array(py, pose, shape))?;
    found.set_item("twist", array(py, twist, shape))?;
    found.set_item("wrench", array(py, wrench, shape))?;
    Ok(found)
}

/// The tools of the streams that a writer has described, by topic of frames and stream.
#[derive(Default)]
pub(crate) struct Described(BTreeMap<(String, u64), Tools>);

/// Poses, twists and wrenches of all tools at a frame.
pub(crate) struct At {
    tools: Tools,
    frame: ToolFrame,
}

impl At {
    /// From Python's arguments.
    ///
    /// # Errors
    /// `ValueError` for tools that cannot be, arrays of another shape, and numbers that are not finite.
    pub(crate) fn new(
        frame: &Frame,
        tools: &Bound<'_, PyAny>,
        pose: &Bound<'_, PyAny>,
        twist: Option<&Bound<'_, PyAny>>,
        wrench: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Self> {
        let tools: Vec<Tool> = values::parse("tools", tools)?;
        let tool = |Tool { name, shape, contact }: Tool| tool::Tool { name, shape, contact };
        let tools = Tools { stream: frame.stream, tools: tools.into_iter().map(tool).collect() };
        tool::check(&tools.tools).map_err(|it| wrong(&it.field, it.found, it.expected))?;
        let shape = [Some(tools.tools.len()), Some(3)];
        let poses = Argument::<f32>::new("pose", pose, &shape)?;
        let twists = twist.map(|twist| Argument::<f32>::new("twist", twist, &shape)).transpose()?;
        let twists = twists.as_ref().map_or(&[][..], |twists| twists.rows::<3>());
        let state = |(index, &[x, y, angle]): (usize, &[f32; 3])| {
            let [u, v, spin] = twists.get(index).copied().unwrap_or_default();
            ToolState { pose: Pose { position: [x, y], angle }, velocity: [u, v], spin }
        };
        let states = poses.rows::<3>().iter().enumerate().map(state).collect();
        let wrenches = wrench.map(|it| Argument::<f64>::new("wrench", it, &shape)).transpose()?;
        let wrenches = wrenches.as_ref().map_or(&[][..], Argument::as_slice).as_chunks().0;
        let wrench = |&[x, y, torque]: &[f64; 3]| Wrench { force: [x, y], torque };
        let frame = ToolFrame {
            stream: frame.stream,
            sequence: frame.sequence,
            stamp: frame.stamp,
            states,
            wrenches: wrenches.iter().map(wrench).collect(),
        };
        // The checks of a reader.
        eddy_messages::ToolFrame::of(&frame, &tools)
            .checked(&tools)
            .map_err(|it| wrong(&it.field, it.found, it.expected))?;
        Ok(Self { tools, frame })
    }

    /// Writes what the tools are, unless it has been written, and where they are. `false`, and nothing written, for other tools than those
    /// that have been described.
    ///
    /// # Errors
    /// As `BagWriter::write_stamped`.
    pub(crate) fn write(
        self,
        writer: &mut eddy_bag::BagWriter,
        described: &mut Described,
        topic: &str,
    ) -> Result<bool, eddy_bag::BagError> {
        let Self { tools, frame } = self;
        let [poses, description] = tool_topics(topic);
        let message = eddy_messages::ToolFrame::of(&frame, &tools);
        match described.0.entry((topic.to_owned(), tools.stream)) {
            Entry::Occupied(known) if *known.get() != tools => return Ok(false),
            Entry::Occupied(_) => {}
            Entry::Vacant(entry) => {
                let topic = writer.topic(&description, ToolDescription::TYPE)?;
                let message = ToolDescription::of(&tools, frame.stamp);
                writer.write_stamped(topic, frame.stamp, &cdr::encode(&message))?;
                entry.insert(tools);
            }
        }
        let topic = writer.topic(&poses, eddy_messages::ToolFrame::TYPE)?;
        writer.write_stamped(topic, frame.stamp, &cdr::encode(&message))?;
        Ok(true)
    }
}
