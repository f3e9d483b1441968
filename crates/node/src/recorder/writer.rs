//! Writes messages into a bag as they arrive.

use eddy_bag::{BagError, BagSummary, BagWriter, TopicId};
use eddy_frames::Stamp;
use eddy_messages::{QosProfile, TypeSupport};
use eddy_transport::Payload;

/// Interval between flushes (ns of wall time). A killed recorder loses the messages of this interval and of one interval
/// between calls of [`Recorder::on_tick`], together less than a second.
const FLUSH_INTERVAL: i64 = 800_000_000;

/// Writes messages into a bag and ends each chunk before it is a second old.
pub struct Recorder {
    bag: BagWriter,
    flushed: Stamp,
    /// Whether messages were written since the last flush.
    dirty: bool,
}

impl Recorder {
    /// Records into `bag`; all times are wall times.
    pub fn new(bag: BagWriter, now: Stamp) -> Self {
        Self { bag, flushed: now, dirty: false }
    }

    /// Adds a topic, or returns its id.
    ///
    /// # Errors
    /// As [`BagWriter::topic`].
    pub fn topic(&mut self, name: &str, type_name: &str) -> Result<TopicId, BagError> {
        self.bag.topic(name, type_name)
    }

    /// Adds a topic of any type, or returns its id. Its publishers offer `offered`, ROS 2's default profile if unknown.
    ///
    /// # Errors
    /// As [`BagWriter::topic`].
    pub fn topic_of(
        &mut self,
        name: &str,
        of: &TypeSupport,
        offered: &[QosProfile],
    ) -> Result<TopicId, BagError> {
        let unknown = [QosProfile::default()];
        self.bag.offered_topic(name, of, if offered.is_empty() { &unknown } else { offered })
    }

    /// Adds an entry to `custom_data` in `metadata.yaml`.
    pub fn set_custom_data(&mut self, key: &str, value: String) {
        self.bag.set_custom_data(key, value);
    }

    /// Adds the number of messages that were lost before they reached the recorder to `metadata.yaml`.
    pub fn count_dropped(&mut self, messages: u64) {
        self.bag.count_dropped(messages);
    }

    /// Writes a message that arrived at `now`, its log time and publish time.
    ///
    /// # Errors
    /// As [`BagWriter::write`].
    pub fn on_message(
        &mut self,
        topic: TopicId,
        payload: Payload,
        now: Stamp,
    ) -> Result<(), BagError> {
        self.bag.write(topic, now, now, &payload.into_cdr())?;
        self.dirty = true;
        Ok(())
    }

    /// Flushes if the last flush was 0.8 s ago. To be called every 0.1 s with the current time, which may be later than
    /// the arrival of the last message.
    ///
    /// # Errors
    /// As [`BagWriter::flush`].
    pub fn on_tick(&mut self, now: Stamp) -> Result<(), BagError> {
        // The wall clock may be set back, hence the absolute difference.
        if now.0.abs_diff(self.flushed.0) < FLUSH_INTERVAL.unsigned_abs() {
            return Ok(());
        }
        self.flushed = now;
        if std::mem::take(&mut self.dirty) {
            self.bag.flush()?;
        }
        Ok(())
    }

    /// The bag so far.
    pub fn bag(&self) -> &BagWriter {
        &self.bag
    }

    /// Closes the bag.
    ///
    /// # Errors
    /// As [`BagWriter::finish`].
    pub fn finish(self) -> Result<BagSummary, BagError> {
        self.bag.finish()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use eddy_bag::{BagReader, WriterOptions};
    use eddy_frames::{Domain, Frame, Material};
    use eddy_messages::{FrameCdr, Message, ParticleFrame, RosString, cdr};

    fn frame(sequence: u64) -> Frame {
        Frame {
            stream: 0,
            sequence,
            stamp: Stamp(0).advance(0.016, sequence as u32),
            dt: 0.016,
            domain: Domain::UNIT,
            position: vec![[0.5, 0.5]],
            velocity: vec![[0.0, -1.0]],
            material: vec![Material::Snow],
        }
    }

    #[test]
    fn frames_and_bytes_are_recorded_with_their_arrival_time() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("run");
        let bag = BagWriter::create(&path, WriterOptions::default()).unwrap();
        let mut recorder = Recorder::new(bag, Stamp(5));
        let particles = recorder.topic("/particles", ParticleFrame::TYPE).unwrap();
        let words = recorder.topic("/words", RosString::TYPE).unwrap();
        let text = cdr::encode(&RosString { data: "eddy".into() });
        recorder.on_message(particles, Payload::Frame(frame(0)), Stamp(10)).unwrap();
        recorder.on_message(words, Payload::Cdr(text.clone()), Stamp(11)).unwrap();
        recorder.on_message(particles, Payload::Cdr(frame(1).to_cdr()), Stamp(12)).unwrap();
        assert_eq!(recorder.finish().unwrap().messages, 3);

        let bag = BagReader::open(&path).unwrap();
        let messages: Vec<_> = bag.messages().map(Result::unwrap).collect();
        let times: Vec<_> = messages.iter().map(|message| message.log_time).collect();
        assert_eq!(times, [Stamp(10), Stamp(11), Stamp(12)]);
        assert_eq!(messages[0].data, frame(0).to_cdr());
        assert_eq!(messages[1].data, text);
        assert_eq!(messages[2].data, frame(1).to_cdr());
    }

    #[test]
    fn messages_older_than_a_second_are_in_the_file_before_the_bag_is_closed() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("run");
        let bag = BagWriter::create(&path, WriterOptions::default()).unwrap();
        let mut recorder = Recorder::new(bag, Stamp(10_000_000_000));
        let topic = recorder.topic("/particles", ParticleFrame::TYPE).unwrap();
        let on_disk = || BagReader::open(&path).unwrap().message_count();
        let after = |seconds: f64| Stamp(10_000_000_000 + (seconds * 1e9) as i64);

        recorder.on_message(topic, Payload::Frame(frame(0)), after(0.5)).unwrap();
        assert_eq!(on_disk(), 0);
        recorder.on_tick(after(1.0)).unwrap();
        assert_eq!(on_disk(), 1);
        // Messages that have waited for seconds do not end a chunk each.
        for (arrived, number) in [(-3.0, 1), (-2.0, 2)] {
            let payload = Payload::Frame(frame(number));
            recorder.on_message(topic, payload, after(arrived)).unwrap();
            recorder.on_tick(after(1.1)).unwrap();
        }
        assert_eq!(on_disk(), 1);
        recorder.on_tick(after(2.0)).unwrap();
        assert_eq!(on_disk(), 3);
    }
}
