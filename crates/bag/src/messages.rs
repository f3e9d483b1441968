//! The messages of all files of a bag, merged by log time, one piece of a file in memory at a time
//! (more only where their times overlap).

use std::{collections::VecDeque, path::PathBuf, sync::Arc};

use mcap::records::Record;

use super::{
    channel::Channel,
    error::BagError,
    faults::Faults,
    reader::{ChannelOfFile, Contents},
    segment::Segment,
    walk::unknown_channel,
};
use eddy_frames::Stamp;

/// A message of a bag.
#[derive(Clone, Debug, PartialEq)]
pub struct BagMessage {
    /// The topic.
    pub topic: Arc<str>,
    /// The topic's type, such as `eddy_msgs/msg/ParticleFrame`.
    pub type_name: Arc<str>,
    /// Number that the writer gave it; 0 where writers do not count.
    pub sequence: u32,
    /// When it was received.
    pub log_time: Stamp,
    /// When it was sent.
    pub publish_time: Stamp,
    /// CDR with its 4-byte header, unchecked.
    pub data: Vec<u8>,
    /// The topic as the writer described it.
    pub channel: Arc<Channel>,
}

/// Which messages of a bag are wanted.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Selection {
    /// Only these topics; all if `None`.
    pub topics: Option<Vec<String>>,
    /// Only messages logged then or later.
    pub from: Option<Stamp>,
    /// Only messages logged then or earlier.
    pub until: Option<Stamp>,
}

/// The messages of a bag in the order of their log time; equal times in the order of the files.
///
/// When parts of the bag are damaged, all messages that are whole come first, then an error for each of the
/// first parts, then [`BagError::FurtherFaults`] if there are more.
#[derive(Debug)]
pub struct Messages {
    contents: Arc<Contents>,
    /// Which topics are wanted, by number.
    wanted: Vec<bool>,
    from: u64,
    until: u64,
    /// Pieces not read yet, in the order of their first message.
    pending: VecDeque<Segment>,
    /// Messages of the pieces that were read, in order.
    ready: VecDeque<BagMessage>,
    /// The faults met, for the end.
    faults: Faults<BagError>,
}

impl Messages {
    pub(super) fn new(contents: Arc<Contents>, selection: &Selection) -> Self {
        let wanted = contents
            .topics
            .iter()
            .map(|topic| selection.topics.as_ref().is_none_or(|names| names.contains(&topic.name)))
            .collect();
        let limit = |time: Option<Stamp>, none: u64| {
            time.map_or(none, |Stamp(time)| u64::try_from(time).unwrap_or_default())
        };
        let before_all = selection.until.is_some_and(|until| until < Stamp(0));
        let (from, until) = (limit(selection.from, 0), limit(selection.until, u64::MAX));
        let mut pending: Vec<Segment> = contents
            .files
            .iter()
            .flat_map(|file| &file.segments)
            .filter(|segment| segment.last >= from && segment.first <= until && !before_all)
            .cloned()
            .collect();
        pending.sort_by_key(|segment| (segment.first, segment.file, segment.position));
        let (pending, ready) = (pending.into(), VecDeque::new());
        let mut faults = Faults::default();
        for file in &contents.files {
            file.faults().for_each(|fault| faults.add(fault));
            faults.add_further(file.damage.further());
        }
        Self { contents, wanted, from, until, pending, ready, faults }
    }

    /// Whether a piece not read yet may hold a message that comes before all that are ready.
    fn must_read_on(&self) -> bool {
        match (self.pending.front(), self.ready.front()) {
            (None, _) => false,
            (Some(_), None) => true,
            (Some(segment), Some(message)) => {
                i64::try_from(segment.first).is_ok_and(|first| Stamp(first) < message.log_time)
            }
        }
    }

    fn read_next(&mut self) {
        let Some(segment) = self.pending.pop_front() else { return };
        let contents = self.contents.clone();
        let file = &contents.files[segment.file];
        let path: &PathBuf = &file.path;
        let topics = &contents.channels[segment.file];
        let ready = &mut self.ready;
        let sorted_until_now = ready.len();
        let outcome = segment.read(path, |record| {
            let Record::Message { header, data } = record else { return Ok(()) };
            let ChannelOfFile { topic, channel } =
                topics.get(&header.channel_id).ok_or_else(|| unknown_channel(header.channel_id))?;
            if !self.wanted[*topic] || header.log_time < self.from || header.log_time > self.until {
                return Ok(());
            }
            let topic = &contents.names[*topic];
            ready.push_back(BagMessage {
                topic: topic.name.clone(),
                type_name: topic.type_name.clone(),
                sequence: header.sequence,
                log_time: stamp("log_time", header.log_time)?,
                publish_time: stamp("publish_time", header.publish_time)?,
                data: data.into_owned(),
                channel: Arc::clone(channel),
            });
            Ok(())
        });
        if ready.len() > sorted_until_now {
            // Stable, and quick where both parts are sorted already.
            ready.make_contiguous().sort_by_key(|message| message.log_time);
        }
        match outcome {
            Ok(()) => {}
            // The system may give later what it refuses now: that is not to be lost among damage.
            Err(error @ BagError::Io { .. }) => self.faults.add_first(error),
            Err(error) => self.faults.add(error),
        }
    }
}

/// MCAP counts time in `u64`, ROS in `i64`: a larger time is a fault of the file.
fn stamp(field: &str, time: u64) -> Result<Stamp, String> {
    i64::try_from(time).map(Stamp).map_err(|_| format!("{field} {time} ns, more than ROS can tell"))
}

impl Iterator for Messages {
    type Item = Result<BagMessage, BagError>;

    fn next(&mut self) -> Option<Self::Item> {
        while self.must_read_on() {
            self.read_next();
        }
        match self.ready.pop_front() {
            Some(message) => Some(Ok(message)),
            None => self.faults.take_next(&self.contents.path).map(Err),
        }
    }
}
