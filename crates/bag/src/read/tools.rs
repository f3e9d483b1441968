//! The tools of the streams of a bag.

use std::collections::{BTreeMap, btree_map::Entry};

use super::{messages::Selection, reader::BagReader};
use crate::{BagError, BagMessage, TopicInfo};
use eddy_frames::tool::{self, ForceScale, InvalidTool, Shape, Sweep, Tools, shapes};
use eddy_messages::{BadTool, Message, ToolDescription, ToolFrame, cdr, tool_topics};
use serde::de::DeserializeOwned;

/// The tools of a stream, and where they are at its frames.
#[derive(Clone, Debug, PartialEq)]
pub struct RecordedTools {
    /// What they are.
    pub tools: Tools,
    /// Where they are, by sequence number of the frame.
    pub frames: BTreeMap<u64, tool::ToolFrame>,
}

impl RecordedTools {
    /// How the tools move from a frame to the next, `dt` later (s). `None` before the first pose; they rest where poses are missing.
    pub fn sweep(&self, sequence: u64, dt: f32) -> Option<Sweep> {
        let (_, before) = self.frames.range(..=sequence).next_back()?;
        let after = self.frames.get(&(sequence + 1)).unwrap_or(before);
        Some(Sweep::new(&self.tools, &before.states, &after.states, dt))
    }

    /// The scale for all forces on them in a domain of this height.
    pub fn force_scale(&self, height: f32) -> ForceScale {
        let forces = self.frames.values().map(tool::ToolFrame::strongest_force);
        ForceScale::new(forces.fold(0.0, f64::max), height)
    }

    /// The tools at a frame and the forces on them, to draw; none if it is not known where they are.
    pub fn shapes_at(&self, sequence: u64, scale: ForceScale) -> Vec<Shape> {
        let frame = self.frames.get(&sequence);
        frame.map_or_else(Vec::new, |frame| shapes(&self.tools, frame, scale))
    }
}

impl BagReader {
    /// The tools beside a topic of frames, by stream; none if the bag has no topics of tools.
    ///
    /// # Errors
    /// [`BagError::Tools`] for the first message that is no description or no frame of tools, for a description that differs from the
    /// first one of its stream, poses of a stream without a description, and two frames of tools with one sequence number that differ; the
    /// damage of the bag.
    pub fn tools(&self, frames: &str) -> Result<BTreeMap<u64, RecordedTools>, BagError> {
        let [poses, description] = tool_topics(frames);
        let mut all = BTreeMap::new();
        self.for_each(&description, |message: ToolDescription| {
            let tools = message.checked()?;
            match all.entry(tools.stream) {
                Entry::Vacant(entry) => {
                    entry.insert(RecordedTools { tools, frames: BTreeMap::new() });
                }
                Entry::Occupied(entry) if entry.get().tools == tools => {}
                Entry::Occupied(entry) => {
                    let stream = entry.key();
                    let expected = "the description that the stream has begun with";
                    let found = format!("other tools of stream {stream}");
                    return Err(InvalidTool::new("tools", found, expected));
                }
            }
            Ok(())
        })?;
        self.for_each(&poses, |message: ToolFrame| {
            let Some(recorded) = all.get_mut(&message.stream) else {
                let found = format!("poses of stream {}", message.stream);
                let expected = format!("its ToolDescription on {description}");
                return Err(InvalidTool::new("stream", found, expected));
            };
            let frame = message.checked(&recorded.tools)?;
            match recorded.frames.entry(frame.sequence) {
                Entry::Vacant(entry) => {
                    entry.insert(frame);
                }
                Entry::Occupied(entry) if *entry.get() == frame => {}
                Entry::Occupied(entry) => {
                    let found = format!("other poses at frame {}", entry.key());
                    return Err(InvalidTool::new("sequence", found, "one frame of tools for each"));
                }
            }
            Ok(())
        })?;
        Ok(all)
    }

    /// Decodes the messages of a topic, if the bag has it with this type.
    fn for_each<M: Message + DeserializeOwned>(
        &self,
        topic: &str,
        mut use_it: impl FnMut(M) -> Result<(), InvalidTool>,
    ) -> Result<(), BagError> {
        let is_it = |info: &TopicInfo| info.name == topic && info.type_name == M::TYPE;
        if !self.topics().iter().any(is_it) {
            return Ok(());
        }
        let topics = Some(vec![topic.into()]);
        let messages = self.select(&Selection { topics, ..Selection::default() });
        for (number, message) in messages.enumerate() {
            let BagMessage { data, .. } = message?;
            let decoded = cdr::decode(&data).map_err(BadTool::from);
            decoded.and_then(|message| Ok(use_it(message)?)).map_err(|reason| BagError::Tools {
                path: self.path().to_owned(),
                topic: topic.to_owned(),
                message: number as u64,
                reason: Box::new(reason),
            })?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{BagWriter, WriterOptions};
    use eddy_frames::{
        Stamp,
        tool::{Contact, Outline, Pose, Tool, ToolState},
    };

    fn blade(width: f32) -> Tools {
        let shape = Outline::Rectangle { size: [width, 0.2] };
        Tools {
            stream: 3,
            tools: vec![Tool { name: "blade".into(), shape, contact: Contact::Slip }],
        }
    }

    fn at(sequence: u64, x: f32) -> tool::ToolFrame {
        let pose = Pose { position: [x, 0.5], angle: 0.25 };
        let states = vec![ToolState { pose, velocity: [1.0, 0.0], spin: 0.0 }];
        let stamp = Stamp(sequence as i64);
        tool::ToolFrame { stream: 3, sequence, stamp, states, wrenches: Vec::new() }
    }

    /// What is read of these messages.
    fn read(
        descriptions: &[Tools],
        frames: &[tool::ToolFrame],
    ) -> Result<BTreeMap<u64, RecordedTools>, String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("bag");
        let mut writer = BagWriter::create(&path, WriterOptions::default()).unwrap();
        let [poses, description] = tool_topics("/left/particles");
        let poses = writer.topic(&poses, ToolFrame::TYPE).unwrap();
        let description = writer.topic(&description, ToolDescription::TYPE).unwrap();
        for tools in descriptions {
            let message = cdr::encode(&ToolDescription::of(tools, Stamp(0)));
            writer.write_stamped(description, Stamp(0), &message).unwrap();
        }
        for frame in frames {
            let message = cdr::encode(&ToolFrame::of(frame, &blade(0.1)));
            writer.write_stamped(poses, frame.stamp, &message).unwrap();
        }
        writer.finish().unwrap();
        let bag = BagReader::open(&path).unwrap();
        assert_eq!(bag.tools("/particles").unwrap(), BTreeMap::new(), "of another namespace");
        let error = |error: BagError| error.to_string().replace(&*path.to_string_lossy(), "bag");
        bag.tools("/left/particles").map_err(error)
    }

    #[test]
    fn tools_are_read_by_stream_and_frame() {
        let found = read(&[blade(0.1), blade(0.1)], &[at(0, 0.25), at(1, 0.5), at(1, 0.5)]);
        let recorded = &found.unwrap()[&3];
        assert_eq!(recorded.tools, blade(0.1));
        assert_eq!(recorded.frames, BTreeMap::from([(0, at(0, 0.25)), (1, at(1, 0.5))]));
        let shapes_at = |sequence| recorded.shapes_at(sequence, recorded.force_scale(1.0));
        let [Shape { part, .. }] = &shapes_at(1)[..] else { panic!("one part without a force") };
        assert!(part.distance([0.5, 0.5]) < 0.0 && part.distance([0.25, 0.5]) > 0.0);
        assert_eq!(shapes_at(7).len(), 0);
    }

    #[test]
    fn tools_that_contradict_themselves_are_refused_with_topic_and_message() {
        let cases = [
            (
                read(&[blade(0.1), blade(0.2)], &[]),
                "bag: topic /left/tools/description, message 1: tools: found other tools of stream 3, expected the description that the stream has begun with",
            ),
            (
                read(&[], &[at(0, 0.25)]),
                "bag: topic /left/tools, message 0: stream: found poses of stream 3, expected its ToolDescription on /left/tools/description",
            ),
            (
                read(&[blade(0.1)], &[at(0, 0.25), at(0, 0.5)]),
                "bag: topic /left/tools, message 1: sequence: found other poses at frame 0, expected one frame of tools for each",
            ),
            (
                read(&[blade(0.1)], &[at(0, f32::NAN)]),
                "bag: topic /left/tools, message 0: poses[0].position: found NaN, expected finite numbers",
            ),
        ];
        for (found, expected) in cases {
            assert_eq!(found.unwrap_err(), expected);
        }
    }
}
