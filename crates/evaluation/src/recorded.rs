//! Rollouts that another program has written into bags, in the form in which a node publishes predictions.

use std::{
    collections::{BTreeMap, BTreeSet, HashMap, VecDeque},
    path::Path,
};

use super::{EvalError, Rollout, task::RolloutTask};
use eddy_bag::{BagError, BagReader, Selection, find_bags};
use eddy_frames::{Frame, State};
use eddy_messages::{FrameCdr, Message, ParticleFrame, PredictionStatus, cdr};

/// Topic of the predicted frames.
const PREDICTION_TOPIC: &str = "/prediction";
/// Topic that tells from which frame each of them was predicted.
const STATUS_TOPIC: &str = "/prediction/status";

/// The states of a rollout by the number of frames ahead, from 1.
type Ahead = BTreeMap<u32, State>;

/// Messages of one predicted sequence number whose counterpart has not been read yet.
#[derive(Default)]
struct Unmatched {
    frames: VecDeque<State>,
    /// Sequence number of the start, frames ahead.
    sources: VecDeque<(u64, u32)>,
}

/// Recorded rollouts of one predictor.
#[derive(Clone, Debug)]
pub struct Recorded {
    /// Name of the predictor.
    pub name: String,
    bags: Vec<BagReader>,
    /// The bags with rollouts of a stream, by its id.
    streams: BTreeMap<u64, Vec<usize>>,
}

/// Why recorded rollouts cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum RecordedError {
    /// A bag cannot be read, or lacks a topic.
    #[error("{name}: {reason}")]
    Bag {
        /// Name of the predictor.
        name: String,
        /// Why.
        reason: Box<BagError>,
    },
    /// A message is no valid status.
    #[error("{name}: {reason}")]
    Status {
        /// Name of the predictor.
        name: String,
        /// The bag and what is wrong.
        reason: String,
    },
}

/// Decodes a status of a bag; the error names the bag.
fn decode_status(bag: &Path, data: &[u8]) -> Result<PredictionStatus, String> {
    cdr::decode(data).map_err(|error| format!("{}: {STATUS_TOPIC}: {error}", bag.display()))
}

impl Recorded {
    /// Opens the bags at and below a path.
    ///
    /// # Errors
    /// [`RecordedError`].
    pub fn open(name: String, path: &Path) -> Result<Self, RecordedError> {
        let failed = |reason| RecordedError::Bag { name: name.clone(), reason: Box::new(reason) };
        let paths = find_bags(&[path.into()]).map_err(failed)?;
        let bags = paths.iter().map(|path| BagReader::open(path)).collect::<Result<Vec<_>, _>>();
        let bags = bags.map_err(failed)?;
        let mut streams: BTreeMap<u64, Vec<usize>> = BTreeMap::new();
        for (number, bag) in bags.iter().enumerate() {
            bag.messages_of(PREDICTION_TOPIC, ParticleFrame::TYPE).map_err(failed)?;
            let mut ids = BTreeSet::new();
            for message in bag.messages_of(STATUS_TOPIC, PredictionStatus::TYPE).map_err(failed)? {
                let status = decode_status(bag.path(), &message.map_err(failed)?.data);
                let invalid = |reason| RecordedError::Status { name: name.clone(), reason };
                ids.insert(status.map_err(invalid)?.stream);
            }
            ids.into_iter().for_each(|id| streams.entry(id).or_default().push(number));
        }
        Ok(Self { name, bags, streams })
    }

    /// The rollout from each start of a stream. Beyond the last recorded frame, a rollout stays in its last state.
    pub(super) fn roll_out(
        &self,
        task: &RolloutTask<'_>,
        each: &mut dyn FnMut(usize, Rollout),
    ) -> Result<(), EvalError> {
        let RolloutTask { stream, starts, horizon, reach, .. } = *task;
        let sequence = |start: usize| stream.first_sequence + start as u64;
        let wanted: BTreeSet<u64> = starts.iter().map(|&start| sequence(start)).collect();
        let invalid = |reason: String| EvalError::Recorded {
            name: self.name.clone(),
            stream: stream.id,
            reason,
        };
        let mut rollouts = self.read(stream.id, &wanted).map_err(invalid)?;
        for (number, &start) in starts.iter().enumerate() {
            let from = sequence(start);
            let ahead = rollouts.remove(&from).unwrap_or_default();
            let found = (1..).zip(ahead.keys()).take_while(|(frame, key)| frame == *key).count();
            let expected = horizon.min(stream.states.len() - 1 - start);
            if found < expected {
                return Err(invalid(format!(
                    "found {found} frames predicted from sequence {from}, expected {expected}; rollouts start from the sequences {wanted:?}"
                )));
            }
            let mut last = stream.states[start].clone();
            let expected = last.position.len();
            let particles = ahead.values().map(|state| state.position.len());
            if let Some(found) = particles.take(found).find(|found| *found != expected) {
                return Err(invalid(format!("found {found} particles, expected {expected}")));
            }
            let mut states = ahead.into_values().take(found);
            let next = || {
                if let Some(state) = states.next() {
                    last = state;
                }
                Some(last.clone())
            };
            each(number, Rollout::collect(&stream.states[start], reach, next));
        }
        Ok(())
    }

    /// The rollouts of a stream from the `wanted` sequence numbers.
    fn read(&self, stream: u64, wanted: &BTreeSet<u64>) -> Result<BTreeMap<u64, Ahead>, String> {
        let mut rollouts: BTreeMap<u64, Ahead> = BTreeMap::new();
        let topics = Some(vec![PREDICTION_TOPIC.into(), STATUS_TOPIC.into()]);
        let selection = Selection { topics, ..Selection::default() };
        for &number in self.streams.get(&stream).into_iter().flatten() {
            // Frames and statuses of the same predicted sequence belong together in the order in which they were written.
            let mut unmatched: HashMap<u64, Unmatched> = HashMap::new();
            for message in self.bags[number].select(&selection) {
                let message = message.map_err(|error| error.to_string())?;
                let predicted = if &*message.topic == PREDICTION_TOPIC {
                    let frame = Frame::from_cdr(&message.data).map_err(|error| {
                        format!(
                            "{}: {PREDICTION_TOPIC}: {error}",
                            self.bags[number].path().display()
                        )
                    })?;
                    if frame.stream != stream {
                        continue;
                    }
                    let Frame { sequence, position, velocity, .. } = frame;
                    let state = State { position, velocity };
                    unmatched.entry(sequence).or_default().frames.push_back(state);
                    sequence
                } else {
                    let status = decode_status(self.bags[number].path(), &message.data)?;
                    if status.stream != stream {
                        continue;
                    }
                    let sequence = status.source_sequence.saturating_add(status.horizon.into());
                    let source = (status.source_sequence, status.horizon);
                    unmatched.entry(sequence).or_default().sources.push_back(source);
                    sequence
                };
                let Some(Unmatched { frames, sources }) = unmatched.get_mut(&predicted) else {
                    continue;
                };
                if let (Some(_), Some(_)) = (frames.front(), sources.front()) {
                    let matched = frames.pop_front().zip(sources.pop_front());
                    if let Some((state, (source, horizon))) = matched
                        && wanted.contains(&source)
                    {
                        rollouts.entry(source).or_default().insert(horizon, state);
                    }
                }
            }
        }
        Ok(rollouts)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Evaluation, EvaluationError, EvaluationRequest, Report, Settings};
    use eddy_bag::{BagWriter, WriterOptions};
    use eddy_dataset::{LoadOptions, load_trajectories};
    use eddy_frames::{Stamp, progress::Silent};
    use eddy_inference::{checkpoint::Checkpoint, engine::Surrogate};

    fn request(recorded: Vec<Recorded>) -> EvaluationRequest {
        let bag = concat!(env!("CARGO_MANIFEST_DIR"), "/../../bags/sample");
        EvaluationRequest {
            checkpoints: vec![("shipped".to_owned(), Checkpoint::shipped().unwrap())],
            recorded,
            streams: load_trajectories(
                &[bag.into()],
                LoadOptions::within(u64::MAX),
                &mut |_, _| (),
            )
            .unwrap()
            .streams,
            stiffness: None,
            settings: Settings::full(6, 3),
            references: Vec::new(),
            join_late: false,
            threads: None,
        }
    }

    fn evaluate(recorded: Vec<Recorded>) -> Result<Report, EvaluationError> {
        Evaluation::new(request(recorded), &Silent).unwrap().run(&Silent)
    }

    /// Rollouts of the shipped model from every start, `horizon` frames each, as a program of another author would write them.
    fn record(folder: &Path, horizon: u32, change: impl Fn(&mut Frame)) {
        let request = request(Vec::new());
        let trajectory = &request.streams[0];
        let stream = trajectory.cut(0..trajectory.frames).unwrap();
        let surrogate = Surrogate::load(&Checkpoint::shipped().unwrap(), None).unwrap();
        let mut writer = BagWriter::create(folder, WriterOptions::default()).unwrap();
        let frames = writer.topic(PREDICTION_TOPIC, ParticleFrame::TYPE).unwrap();
        let statuses = writer.topic(STATUS_TOPIC, PredictionStatus::TYPE).unwrap();
        let evaluation = Evaluation::new(request.clone(), &Silent).unwrap();
        let (_, id, sequences) = evaluation.starts().next().unwrap();
        let mut stepper = surrogate.stepper();
        let mut hidden = surrogate.start(&stream.frame(0)).unwrap();
        let last = *sequences.last().unwrap();
        for sequence in stream.first_sequence..=last {
            let observed = stream.frame((sequence - stream.first_sequence) as usize);
            let mut frame = stepper.step(&mut hidden, &observed);
            if !sequences.contains(&sequence) {
                continue;
            }
            let mut ahead = hidden.clone();
            for frames_ahead in 1..=horizon {
                frame.sequence = sequence + u64::from(frames_ahead);
                let mut written = frame.clone();
                change(&mut written);
                let now = Stamp(frame.stamp.0);
                writer.write(frames, now, now, &written.to_cdr()).unwrap();
                let status = PredictionStatus {
                    stream: id,
                    source_sequence: sequence,
                    horizon: frames_ahead,
                    ..PredictionStatus::default()
                };
                writer.write(statuses, now, now, &cdr::encode(&status)).unwrap();
                frame = stepper.step(&mut ahead, &frame);
            }
        }
        writer.finish().unwrap();
    }

    #[test]
    fn recorded_rollouts_of_a_model_have_its_errors() {
        let folder = tempfile::tempdir().unwrap();
        record(&folder.path().join("mine"), 6, |_| ());
        let report = evaluate(vec![Recorded::open("mine".into(), folder.path()).unwrap()]).unwrap();
        let [model, mine, ..] = &report.predictors[..] else { panic!() };
        assert_eq!(mine.name, "mine");
        assert_eq!(mine.skill, model.skill);
        assert!(mine.skill[0] > 0.0, "{:?}", mine.skill);
        assert!(mine.cost.is_none() && model.cost.is_some());
    }

    #[test]
    fn rollouts_that_are_short_or_of_other_particles_are_rejected_with_what_is_expected() {
        let folder = tempfile::tempdir().unwrap();
        record(&folder.path().join("short"), 4, |_| ());
        record(&folder.path().join("few"), 6, |frame| {
            frame.position.truncate(9);
            frame.velocity.truncate(9);
            frame.material.truncate(9);
        });
        for (name, expected) in [
            ("short", "found 4 frames predicted from sequence 2, expected 6"),
            ("few", "found 9 particles, expected 2500"),
        ] {
            let recorded = Recorded::open(name.into(), &folder.path().join(name)).unwrap();
            let message = evaluate(vec![recorded]).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        }
        let bag = concat!(env!("CARGO_MANIFEST_DIR"), "/../../bags/sample");
        let message = Recorded::open("x".into(), Path::new(bag)).unwrap_err().to_string();
        assert!(message.contains("expected /prediction among them"), "{message}");
    }
}
