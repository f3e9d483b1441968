//! Frame in, predictions out.

use std::{collections::BTreeMap, time::Duration};

use super::{
    Counters, InvalidSettings, NodeSettings, Publish, Refusal,
    track::{Follows, StreamTrack},
};
use crate::{
    engine::{Memory, Surrogate},
    frame::Frame,
    msg::{BadFrame, Header, PredictionStatus, StreamState, services::Parameter},
};

/// A predicted frame, with how it came to be.
#[derive(Clone, Debug, PartialEq)]
pub struct Prediction {
    /// The predicted frame: sequence and stamp of the predicted instant.
    pub frame: Frame,
    /// Sequence of the last observed frame.
    pub source_sequence: u64,
    /// Frames predicted ahead of it.
    pub horizon: u32,
    /// What the node does with the stream.
    pub state: StreamState,
}

impl Prediction {
    /// The message that goes with the frame.
    pub fn status(&self, latency: Duration, model: &str) -> PredictionStatus {
        PredictionStatus {
            header: Header::world(self.frame.stamp),
            stream: self.frame.stream,
            source_sequence: self.source_sequence,
            horizon: self.horizon,
            state: self.state as u8,
            latency: latency.as_secs_f32(),
            model: model.to_owned(),
        }
    }
}

/// A surrogate with the state of every stream it observes.
///
/// Pure: the same calls give the same predictions, bit for bit, whatever else runs.
pub struct SurrogateNode {
    surrogate: Surrogate,
    settings: NodeSettings,
    streams: BTreeMap<u64, StreamTrack>,
    /// Room for the copy of a stream's state that looks ahead.
    ahead: Option<Memory>,
    /// Counted up with every use of a stream: which was used last must not depend on the time.
    uses: u64,
    counters: Counters,
}

impl SurrogateNode {
    /// A node without streams.
    ///
    /// # Errors
    /// [`InvalidSettings`] when a setting is out of its range.
    pub fn new(surrogate: Surrogate, settings: NodeSettings) -> Result<Self, InvalidSettings> {
        settings.check()?;
        let (streams, counters) = (BTreeMap::new(), Counters::default());
        Ok(Self { surrogate, settings, streams, ahead: None, uses: 0, counters })
    }

    /// The surrogate that predicts.
    pub fn surrogate(&self) -> &Surrogate {
        &self.surrogate
    }

    /// Everything counted so far.
    pub fn counters(&self) -> &Counters {
        &self.counters
    }

    /// For what happens outside of this node: publishing, queues.
    pub fn counters_mut(&mut self) -> &mut Counters {
        &mut self.counters
    }

    /// Streams that are known now.
    pub fn streams(&self) -> usize {
        self.streams.len()
    }

    /// How it behaves.
    pub fn settings(&self) -> &NodeSettings {
        &self.settings
    }

    /// Behaves otherwise from the next frame on.
    ///
    /// # Errors
    /// [`InvalidSettings`] with the first parameter that cannot be set; then nothing changes.
    pub fn set(&mut self, parameters: &[Parameter]) -> Result<(), InvalidSettings> {
        let mut settings = self.settings.clone();
        parameters.iter().try_for_each(|parameter| settings.set_running(parameter))?;
        self.settings = settings;
        Ok(())
    }

    /// The time is another one now: what is due in so much time of the old one is due in as much of the new.
    pub fn shift_time(&mut self, old: Duration, new: Duration) {
        for track in self.streams.values_mut() {
            track.free_run_due = track.free_run_due.map(|due| new + due.saturating_sub(old));
        }
    }

    /// Forgets every stream: each warms up again. Returns how many there were.
    pub fn reset(&mut self) -> usize {
        let streams = self.streams.len();
        self.counters.resets += streams as u64;
        self.streams.clear();
        streams
    }

    /// Observes one frame and returns what is to be published, in the order of the predicted instants.
    ///
    /// # Errors
    /// [`Refusal`] when the frame was not used; it is counted already and the node goes on.
    pub fn on_frame(
        &mut self,
        frame: Result<Frame, BadFrame>,
        now: Duration,
    ) -> Result<Vec<Prediction>, Refusal> {
        self.counters.received += 1;
        let outcome = frame.map_err(Refusal::from).and_then(|frame| self.observe(&frame, now));
        if let Err(refusal) = &outcome {
            self.counters.refuse(refusal);
        }
        outcome
    }

    /// Returns the frames of free runs that are due by `now`, at most one a stream.
    pub fn on_tick(&mut self, now: Duration) -> Vec<Prediction> {
        let mut due = Vec::new();
        let mut diverged = Vec::new();
        for (&stream, track) in &mut self.streams {
            let Some(when) = track.free_run_due else { continue };
            if when > now {
                continue;
            }
            let next = self.surrogate.step(&mut track.memory, &track.predicted);
            let frame = std::mem::replace(&mut track.predicted, next);
            self.uses += 1;
            track.used = self.uses;
            track.free_run_due = Some(when + interval(&frame));
            if frame.check().is_err() {
                diverged.push(stream);
                continue;
            }
            let ahead = frame.sequence - track.sequence;
            due.push(Prediction {
                source_sequence: track.sequence,
                horizon: u32::try_from(ahead).unwrap_or(u32::MAX),
                state: StreamState::FreeRunning,
                frame,
            });
        }
        for stream in diverged {
            self.diverge(stream);
        }
        due
    }

    /// When [`SurrogateNode::on_tick`] has something to do next.
    pub fn next_tick(&self) -> Option<Duration> {
        self.streams.values().filter_map(|track| track.free_run_due).min()
    }

    fn observe(&mut self, frame: &Frame, now: Duration) -> Result<Vec<Prediction>, Refusal> {
        // Before anything is touched: a bad frame must not cost its stream.
        self.surrogate.fits(frame)?;
        let mut track = match self.streams.remove(&frame.stream) {
            Some(track)
                if track.free_run_due.is_some() && track.follows(frame) != Follows::Restart =>
            {
                let refusal = Refusal::FreeRunning { stream: frame.stream, found: frame.sequence };
                self.streams.insert(frame.stream, track);
                return Err(refusal);
            }
            Some(track) => self.follow(track, frame)?,
            None => self.begin(frame)?,
        };
        track.observed += 1;
        self.uses += 1;
        (track.sequence, track.stamp, track.used) = (frame.sequence, frame.stamp, self.uses);

        let warm_up = u64::from(self.surrogate.description().warm_up);
        let predictions =
            if self.settings.free_run.is_some_and(|k| track.observed >= k.max(warm_up)) {
                track.free_run_due = Some(now + interval(frame));
                Vec::new()
            } else if track.observed < warm_up {
                Vec::new()
            } else {
                self.look_ahead(&track)
            };
        let stream = frame.stream;
        self.streams.insert(stream, track);
        if predictions.iter().any(|prediction| prediction.frame.check().is_err()) {
            self.diverge(stream);
            return Ok(Vec::new());
        }
        self.evict();
        Ok(predictions)
    }

    /// A stream whose first frame is `frame`.
    fn begin(&self, frame: &Frame) -> Result<StreamTrack, Refusal> {
        let mut memory = self.surrogate.start(frame)?;
        for remark in self.surrogate.remarks(frame) {
            tracing::warn!("stream {}: {remark}", frame.stream);
        }
        let predicted = self.surrogate.step(&mut memory, frame);
        Ok(StreamTrack {
            memory,
            predicted,
            sequence: frame.sequence,
            stamp: frame.stamp,
            observed: 0,
            free_run_due: None,
            used: self.uses,
        })
    }

    /// The stream after `frame`: stepped, filled up and stepped, or begun anew. A late frame leaves
    /// the stream as it was.
    fn follow(&mut self, mut track: StreamTrack, frame: &Frame) -> Result<StreamTrack, Refusal> {
        match track.follows(frame) {
            Follows::After { gap } if gap <= self.settings.max_gap => {
                for _ in 0..gap {
                    track.predicted = self.surrogate.step(&mut track.memory, &track.predicted);
                }
                self.counters.filled += gap;
                self.surrogate.step_into(&mut track.memory, frame, &mut track.predicted);
                Ok(track)
            }
            Follows::After { gap } => {
                self.counters.missing = self.counters.missing.saturating_add(gap);
                self.counters.resets += 1;
                // The particles are the same: solids still rest in the shape they had at first.
                track.memory.forget();
                self.surrogate.step_into(&mut track.memory, frame, &mut track.predicted);
                Ok(StreamTrack { observed: 0, free_run_due: None, ..track })
            }
            Follows::Restart => {
                self.counters.resets += 1;
                self.begin(frame)
            }
            Follows::Late => {
                let expected = track.sequence + 1;
                self.streams.insert(frame.stream, track);
                Err(Refusal::Late { stream: frame.stream, found: frame.sequence, expected })
            }
        }
    }

    /// Predicts up to the horizon, beyond the first frame from a copy of the stream's state.
    fn look_ahead(&mut self, track: &StreamTrack) -> Vec<Prediction> {
        let Self { surrogate, settings, ahead: memory, .. } = self;
        let prediction = |frame, horizon| Prediction {
            frame,
            source_sequence: track.sequence,
            horizon,
            state: StreamState::Tracking,
        };
        let mut predictions = vec![prediction(track.predicted.clone(), 1)];
        if settings.horizon > 1 {
            let memory = memory.get_or_insert_with(|| track.memory.clone());
            memory.clone_from(&track.memory);
            let mut frame = track.predicted.clone();
            for ahead in 2..=settings.horizon {
                frame = surrogate.step(memory, &frame);
                if settings.publish == Publish::Last {
                    predictions.clear();
                }
                predictions.push(prediction(frame.clone(), ahead));
            }
        }
        predictions
    }

    fn diverge(&mut self, stream: u64) {
        self.streams.remove(&stream);
        self.counters.diverged += 1;
        self.counters.resets += 1;
    }

    fn evict(&mut self) {
        while self.streams.len() > self.settings.max_streams {
            let oldest = self.streams.iter().min_by_key(|(_, track)| track.used).map(|(&id, _)| id);
            if let Some(stream) = oldest {
                self.streams.remove(&stream);
                self.counters.evicted_streams += 1;
            }
        }
    }
}

fn interval(frame: &Frame) -> Duration {
    Duration::from_secs_f64(crate::frame::decimal(frame.dt))
}
