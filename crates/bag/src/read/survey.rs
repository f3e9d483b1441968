//! Checks everything in a bag and collects its streams, in one pass over all messages.

use std::{
    collections::{BTreeMap, BTreeSet},
    fmt,
    io::Read,
    path::Path,
};

use eddy_storage::File;
use mcap::{
    McapError,
    sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions},
};

use super::{
    agreement, contents::TopicInfo, messages::BagMessage, reader::BagReader, records::SIZE_LIMIT,
};
use crate::{
    error::{BagError, in_stream},
    format::channel::{Channel, ROS2MSG},
};
use eddy_frames::{AnyDomain, AnyFrame, Frame, Stamp, decimal, with_frame};
use eddy_messages::{
    BadFrame, FrameCdr, Message, ParticleFrame, TypeSupport, cdr, dynamic, tool_topics,
    type_support,
};

/// Maximum number of groups of findings; findings beyond them are only counted.
const MAX_FINDING_GROUPS: usize = 50;

/// Bytes of a file that are read at a time.
const BLOCK: usize = 1 << 16;

/// Result of a check of all messages of a bag.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Survey {
    /// For each topic of [`BagReader::topics`], in the same order.
    pub topics: Vec<TopicSurvey>,
    /// What is wrong, equal findings together; at most 50 groups.
    pub findings: Vec<Finding>,
    /// Number of findings beyond these groups.
    pub further_findings: u64,
}

/// Findings of one kind in one place.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Finding {
    /// What they have in common.
    group: String,
    /// The first of them.
    pub first: String,
    /// How many there are.
    pub count: u64,
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.first)?;
        match self.count {
            0 | 1 => Ok(()),
            2 => f.write_str(" (and 1 more of this kind)"),
            count => write!(f, " (and {} more of this kind)", count - 1),
        }
    }
}

/// A topic of a [`Survey`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TopicSurvey {
    /// Number of messages read.
    pub messages: u64,
    /// Their size without compression (bytes).
    pub bytes: u64,
    /// Log times of the first and the last one.
    pub times: Option<(Stamp, Stamp)>,
    /// Streams of a topic of frames, by stream id.
    pub streams: BTreeMap<u64, StreamSurvey>,
}

/// A stream of a [`TopicSurvey`].
#[derive(Clone, Debug, PartialEq)]
pub struct StreamSurvey {
    /// Number of valid frames.
    pub frames: u64,
    /// Smallest and largest number of particles of a frame.
    pub particles: (usize, usize),
    /// Time between two frames (s), from the first frame.
    pub dt: f32,
    /// Domain of the first frame.
    pub domain: AnyDomain,
    /// How often the stream restarted, as in the recording of a loop.
    pub restarts: u64,
    /// Highest sequence so far, and its stamp.
    highest: (u64, Stamp),
}

impl TopicSurvey {
    /// Mean rate of the messages (Hz); `None` for fewer than two, and without time between them.
    pub fn rate(&self) -> Option<f64> {
        let (first, last) = self.times?;
        let seconds = last.seconds() - first.seconds();
        (self.messages > 1 && seconds > 0.0).then(|| (self.messages - 1) as f64 / seconds)
    }
}

impl Survey {
    /// Reads every message and checks chunk checksums, CDR by the definition of the type, whether every frame is valid and plausible,
    /// sequences and stamps of every stream, type hashes and versions, and what `metadata.yaml` says. Calls `progress` with the number
    /// of messages read so far.
    ///
    /// On topics whose name ends in `prediction` sequence numbers may repeat: every observed frame may be
    /// followed by several predictions.
    pub fn of(bag: &BagReader, mut progress: impl FnMut(u64)) -> Self {
        let mut survey =
            Self { topics: vec![TopicSurvey::default(); bag.topics().len()], ..Self::default() };
        for topic in bag.topics() {
            survey.check_hash(topic);
        }
        let decoders: Vec<_> = bag.channels().iter().map(|of| decoder_of(of)).collect();
        let mut read = 0;
        for message in bag.messages() {
            match message {
                Ok(message) => survey.check_message(bag, &decoders, &message),
                Err(BagError::MoreErrors { count, .. }) => survey.further_findings += count,
                Err(error) => survey.add_finding(error.to_string()),
            }
            read += 1;
            progress(read);
        }
        survey.check_counts(bag);
        survey.check_tools(bag);
        agreement::disagreements(bag).into_iter().for_each(|finding| survey.add_finding(finding));
        survey
    }

    /// Checks what reading messages does not use: the checksums of the data and summary sections, and indexes and times that a file
    /// states beside its messages.
    pub fn check_files(&mut self, bag: &BagReader) {
        if bag.is_unfinished() {
            let files: BTreeSet<_> = bag.files().map(|file| file.display().to_string()).collect();
            let files = files.into_iter().collect::<Vec<_>>().join(", ");
            self.add_finding(format!("{files}: found an unfinished file, expected a finished bag"));
            return;
        }
        if bag.damage().is_some() {
            return;
        }
        for file in bag.files() {
            match checksums(file) {
                Ok(()) => {}
                Err(McapError::Io(error)) => {
                    self.add_finding(BagError::io(file, "reading")(error).to_string());
                }
                Err(error) => self.add_finding(format!("{}: {error}", file.display())),
            }
        }
        for file in bag.contradictions() {
            match file {
                Ok((found, further)) => {
                    found.into_iter().for_each(|error| self.add_finding(error.to_string()));
                    self.further_findings += further;
                }
                Err(error) => self.add_finding(error.to_string()),
            }
        }
    }

    /// Number of findings.
    pub fn finding_count(&self) -> u64 {
        self.findings.iter().map(|finding| finding.count).sum::<u64>() + self.further_findings
    }

    /// Adds a finding that is grouped only with identical ones.
    fn add_finding(&mut self, finding: String) {
        self.found(finding.clone(), finding);
    }

    /// Adds a finding to the others of its group.
    fn found(&mut self, group: String, finding: String) {
        if let Some(known) = self.findings.iter_mut().find(|known| known.group == group) {
            known.count += 1;
        } else if self.findings.len() < MAX_FINDING_GROUPS {
            self.findings.push(Finding { group, first: finding, count: 1 });
        } else {
            self.further_findings += 1;
        }
    }

    /// Checks the tools beside each topic of frames; other damage is found with the messages.
    fn check_tools(&mut self, bag: &BagReader) {
        let frames = bag.topics().iter().filter(|topic| topic.type_name == ParticleFrame::TYPE);
        // Several topics of frames may have the same tools.
        let beside: BTreeMap<_, _> =
            frames.map(|topic| (tool_topics(&topic.name), &topic.name)).collect();
        for topic in beside.into_values() {
            if let Err(error @ BagError::Tools { .. }) = bag.tools(topic) {
                self.add_finding(error.to_string());
            }
        }
    }

    fn check_hash(&mut self, topic: &TopicInfo) {
        // Other versions of ROS 2 define some types differently: the definition in the bag counts.
        let defined = topic.defined_type().and_then(Result::ok).map(|defined| defined.hash);
        let built_in = || type_support(&topic.type_name).ok().map(|ours| ours.hash.clone());
        let Some(expected) = defined.or_else(built_in) else { return };
        if let Some(hash) = topic.hash.as_ref().filter(|hash| **hash != expected) {
            let TopicInfo { name, type_name, .. } = topic;
            self.add_finding(format!(
                "topic {name}: hash of {type_name}: found {hash}, expected {expected}"
            ));
        }
    }

    fn check_message(
        &mut self,
        bag: &BagReader,
        decoders: &[Option<TypeSupport>],
        message: &BagMessage,
    ) {
        let Some((channel, index)) = bag.place_of(message) else { return };
        let number = self.topics[index].messages;
        self.topics[index].messages += 1;
        self.topics[index].bytes += message.data.len() as u64;
        let times = self.topics[index].times.get_or_insert((message.log_time, message.log_time));
        times.1 = message.log_time;
        let data = &message.data;
        let decoded = match (&*message.type_name, &decoders[channel]) {
            (ParticleFrame::TYPE, _) => match AnyFrame::from_cdr(data) {
                Ok(frame) => with_frame!(frame, frame => {
                    self.check_frame(index, message, &frame);
                    // Predictions may diverge.
                    let checked = if is_prediction(&message.topic) {
                        Ok(())
                    } else {
                        frame.check_plausible()
                    };
                    checked.map_err(BadFrame::from)
                }),
                Err(error) => Err(error),
            }
            .map_err(|reason| format!("{}: {reason}", in_stream(cdr::place_of_frame(data)))),
            (_, Some(support)) => {
                dynamic::check(support, data).map_err(|error| format!(": {error}"))
            }
            (_, None) => Ok(()),
        };
        if let Err(reason) = decoded {
            let topic = &message.topic;
            let finding = format!("topic {topic}, message {number}{reason}");
            self.found(format!("topic {topic}{}", without_numbers(&reason)), finding);
        }
    }

    fn check_frame<const D: usize>(
        &mut self,
        topic: usize,
        message: &BagMessage,
        frame: &Frame<D>,
    ) {
        let streams = &mut self.topics[topic].streams;
        let Some(stream) = streams.get_mut(&frame.stream) else {
            streams.insert(frame.stream, StreamSurvey::new(frame));
            return;
        };
        let may_repeat = is_prediction(&message.topic);
        for fault in stream.follow(frame, may_repeat).into_iter().flatten() {
            let place = format!("topic {}, stream {}", message.topic, frame.stream);
            let group = format!("{place}: {}", without_numbers(&fault));
            self.found(group, format!("{place}: {fault}"));
        }
    }

    fn check_counts(&mut self, bag: &BagReader) {
        for (index, topic) in bag.topics().iter().enumerate() {
            let (found, expected) = (self.topics[index].messages, topic.message_count);
            if found != expected {
                let name = &topic.name;
                self.add_finding(format!(
                    "topic {name}: found {found} messages, expected {expected}"
                ));
            }
        }
    }
}

/// Whether a topic holds predictions, of which every observed frame may have several.
fn is_prediction(topic: &str) -> bool {
    topic.ends_with("prediction")
}

/// The type that the messages of a channel are decoded with, as `eddy topic echo` does: as the bag defines it, else a built-in one of
/// the same version. `None` where there is none, and for messages that are not CDR or have wide strings.
fn decoder_of(channel: &Channel) -> Option<TypeSupport> {
    let definition = channel.definition();
    let defined = match channel.definition_encoding() {
        ROS2MSG => TypeSupport::from_schema(channel.type_name(), &definition).ok(),
        _ if !definition.is_empty() => None,
        _ => {
            let built_in = type_support(channel.type_name()).ok().cloned();
            built_in.filter(|ours| channel.type_hash().is_none_or(|hash| hash == ours.hash))
        }
    };
    defined.filter(|support| channel.encoding == "cdr" && dynamic::is_decodable(support))
}

/// A description without its numbers, which is the same for findings of one kind.
fn without_numbers(description: &str) -> String {
    description.chars().filter(|c| !c.is_ascii_digit()).collect()
}

impl StreamSurvey {
    fn new<const D: usize>(frame: &Frame<D>) -> Self {
        Self {
            frames: 1,
            particles: (frame.len(), frame.len()),
            dt: frame.dt,
            domain: frame.domain.into(),
            restarts: 0,
            highest: (frame.sequence, frame.stamp),
        }
    }

    /// Adds the next frame; returns what contradicts the frames before it. A stream that restarts contradicts nothing.
    fn follow<const D: usize>(
        &mut self,
        frame: &Frame<D>,
        may_repeat: bool,
    ) -> [Option<String>; 3] {
        let (fewest, most) = self.particles;
        self.frames += 1;
        self.particles = (fewest.min(frame.len()), most.max(frame.len()));
        let (before, stamp_before) = self.highest;
        let (sequence, stamp) = (frame.sequence, frame.stamp);
        let is_restart = sequence <= before && stamp_before.restarts_at(stamp, frame.dt);
        let order = if is_restart {
            self.restarts += 1;
            None
        } else if sequence > before + 1 {
            Some(format!("found sequence {sequence} after {before}, expected {}", before + 1))
        } else if sequence <= before {
            let fault =
                format!("found sequence {sequence} (repeated or late), expected {}", before + 1);
            (!may_repeat).then_some(fault)
        } else if stamp <= stamp_before {
            let (found, last) = (stamp.seconds(), stamp_before.seconds());
            Some(format!("sequence {sequence}: found stamp {found} s, expected more than {last} s"))
        } else {
            None
        };
        if sequence > before || !may_repeat || is_restart {
            self.highest = (sequence, stamp);
        }
        let (found, expected) = (decimal(frame.dt), decimal(self.dt));
        let interval = (frame.dt != self.dt)
            .then(|| format!("sequence {sequence}: found dt {found} s, expected {expected} s"));
        let (found, expected) = (AnyDomain::from(frame.domain), self.domain);
        let domain = (found != expected)
            .then(|| format!("sequence {sequence}: found domain {found}, expected {expected}"));
        [order, interval, domain]
    }
}

/// Checks the checksums of the data and summary sections of a file.
fn checksums(path: &Path) -> Result<(), McapError> {
    let mut file = File::open(path)?.reader()?;
    let mut reader = LinearReader::new_with_options(
        LinearReaderOptions::default()
            .with_emit_chunks(true)
            .with_validate_data_section_crc(true)
            .with_validate_summary_section_crc(true)
            .with_check_finishes_after_end_magic(true)
            .with_record_length_limit(SIZE_LIMIT as usize),
    );
    while let Some(event) = reader.next_event() {
        if let LinearReadEvent::ReadRequest(_) = event? {
            let read = file.read(reader.insert(BLOCK))?;
            reader.notify_read(read);
        }
    }
    Ok(())
}
