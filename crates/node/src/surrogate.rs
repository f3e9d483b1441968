//! Frame in, predictions out.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use super::{
    Counters, InvalidSettings, NodeSettings, Prediction, Refusal,
    step::{Ahead, Step, interval},
    track::{Follows, StreamTrack},
};
use eddy_frames::{Frame, FrameView};
use eddy_inference::engine::{Stepper, Surrogate};
use eddy_messages::{StreamState, services::Parameter};
use eddy_transport::Payload;

/// A message with its time of arrival.
pub type Arrival = (Duration, Payload);

/// Is told what is to be published, in the order of the predicted instants, and what was not used; each
/// with the arrival of the frame it comes from. What was not used is counted already.
pub type Tell<'a> = dyn FnMut(Duration, Result<Prediction<'_>, Refusal>) + 'a;

/// Streams that have a frame stepped at once, at most: more threads are of no use here.
const TOGETHER: usize = 16;

/// A surrogate with the state of every stream it observes.
///
/// Pure: the same calls give the same predictions, bit for bit, whatever else runs.
pub struct SurrogateNode {
    surrogate: Surrogate,
    stepper: Stepper,
    settings: NodeSettings,
    streams: BTreeMap<u64, StreamTrack>,
    /// Room for looking ahead, for each of the streams that are stepped at once.
    ahead: Vec<Ahead>,
    /// Frames that are to be stepped at once; empty between calls.
    waiting: Vec<Waiting>,
    /// The time now, where it is not that of arrivals.
    simulated: Option<Duration>,
    /// Counted up with every use of a stream: which was used last must not depend on the time.
    uses: u64,
    counters: Counters,
    /// Streams about which the model's remarks were made: once, however often they begin anew.
    remarked: BTreeSet<u64>,
}

/// Streams that are kept in mind beyond those that are tracked.
const REMARKED: usize = 4096;

/// A frame that is to be stepped.
struct Waiting {
    /// Which of the frames that arrived together.
    index: usize,
    stream: u64,
    /// Missing frames that the model fills.
    gap: u64,
}

impl SurrogateNode {
    /// A node without streams.
    ///
    /// # Errors
    /// [`InvalidSettings`] when a setting is out of its range.
    pub fn new(surrogate: Surrogate, settings: NodeSettings) -> Result<Self, InvalidSettings> {
        settings.check()?;
        let (streams, counters) = (BTreeMap::new(), Counters::default());
        let (ahead, waiting) = (Vec::new(), Vec::new());
        let simulated = None;
        let remarked = BTreeSet::new();
        let uses = 0;
        let stepper = surrogate.stepper();
        Ok(Self {
            surrogate,
            stepper,
            settings,
            streams,
            ahead,
            waiting,
            simulated,
            uses,
            counters,
            remarked,
        })
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
        self.set_and(parameters, |_, _| Ok(()))
    }

    /// Sets the parameters and does `then`, which knows the new settings, or neither.
    ///
    /// # Errors
    /// As [`SurrogateNode::set`], and those of `then`; then nothing changes.
    pub fn set_and(
        &mut self,
        parameters: &[Parameter],
        then: impl FnOnce(&mut Self, &NodeSettings) -> Result<(), InvalidSettings>,
    ) -> Result<(), InvalidSettings> {
        let mut settings = self.settings.clone();
        parameters.iter().try_for_each(|parameter| settings.set_running(parameter))?;
        then(self, &settings)?;
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

    /// How many frames [`SurrogateNode::on_frames`] works on at once.
    pub fn together(&self) -> usize {
        self.stepper.threads().min(TOGETHER)
    }

    /// Observes frames, one after the other. Those of different streams that wait together are stepped at
    /// once, which changes no bit of the predictions. Free runs begin at `simulated`, the time now of a
    /// node that follows `/clock`, else at the arrival of the last observed frame.
    pub fn on_frames(
        &mut self,
        arrivals: &mut [Arrival],
        simulated: Option<Duration>,
        tell: &mut Tell<'_>,
    ) {
        self.simulated = simulated;
        let mut waiting = std::mem::take(&mut self.waiting);
        for (arrived, payload) in &mut *arrivals {
            self.counters.received += 1;
            if let Err(bad) = payload.decode() {
                self.refuse(*arrived, bad.into(), tell);
            }
        }
        for (index, (arrived, payload)) in arrivals.iter().enumerate() {
            let Some(frame) = payload.view() else { continue };
            if let Err(refusal) = self.prepare(index, &frame, arrivals, &mut waiting, tell) {
                self.refuse(*arrived, refusal, tell);
            }
        }
        self.step(arrivals, &mut waiting, tell);
        self.waiting = waiting;
        // There may be room for fewer than before.
        self.evict();
    }

    /// Publishes the frames of free runs that are due by `now`, at most one a stream.
    pub fn on_tick(&mut self, now: Duration, tell: &mut Tell<'_>) {
        let mut diverged = Vec::new();
        for (&stream, track) in &mut self.streams {
            let Some(when) = track.free_run_due else { continue };
            if when > now {
                continue;
            }
            let StreamTrack { memory, predicted: next, spare: frame, .. } = track;
            std::mem::swap(next, frame);
            self.stepper.step_into(memory, &*frame, next);
            self.uses += 1;
            track.used = self.uses;
            track.free_run_due = Some(when + interval(frame.dt));
            if frame.check().is_err() {
                diverged.push(stream);
                continue;
            }
            let ahead = frame.sequence - track.sequence;
            tell(
                now,
                Ok(Prediction {
                    source_sequence: track.sequence,
                    horizon: u32::try_from(ahead).unwrap_or(u32::MAX),
                    state: StreamState::FreeRunning,
                    frame,
                }),
            );
        }
        for stream in diverged {
            self.diverge(stream);
        }
    }

    /// When [`SurrogateNode::on_tick`] has something to do next.
    pub fn next_tick(&self) -> Option<Duration> {
        self.streams.values().filter_map(|track| track.free_run_due).min()
    }

    /// Decides what a frame does to its stream, and has it wait for its step. What cannot wait together
    /// with others is stepped at once: a stream's second frame, and one that begins a stream, as it may
    /// send another one away.
    fn prepare(
        &mut self,
        index: usize,
        frame: &FrameView<'_>,
        arrivals: &[Arrival],
        waiting: &mut Vec<Waiting>,
        tell: &mut Tell<'_>,
    ) -> Result<(), Refusal> {
        // Before anything is touched: a bad frame must not cost its stream.
        self.surrogate.fits(*frame)?;
        let stream = frame.stream;
        if waiting.len() >= self.together() || waiting.iter().any(|other| other.stream == stream) {
            self.step(arrivals, waiting, tell);
        }
        let Self { streams, settings, counters, .. } = self;
        let gap = match streams.get_mut(&stream) {
            None => None,
            Some(track) => match track.follows(frame) {
                Follows::Restart => {
                    counters.resets += 1;
                    None
                }
                _ if track.free_run_due.is_some() => {
                    return Err(Refusal::FreeRunning { stream, found: frame.sequence });
                }
                Follows::After { gap } if gap <= settings.max_gap => {
                    counters.filled += gap;
                    Some(gap)
                }
                Follows::After { gap } => {
                    counters.missing = counters.missing.saturating_add(gap);
                    counters.resets += 1;
                    // The particles are the same: solids still rest in the shape they had at first.
                    track.memory.forget();
                    track.observed = 0;
                    Some(0)
                }
                Follows::Late => {
                    let (found, expected) = (frame.sequence, track.sequence + 1);
                    return Err(Refusal::Late { stream, found, expected });
                }
            },
        };
        if let Some(gap) = gap {
            waiting.push(Waiting { index, stream, gap });
            return Ok(());
        }
        self.step(arrivals, waiting, tell);
        self.begin(&frame.to_frame())?;
        waiting.push(Waiting { index, stream, gap: 0 });
        self.step(arrivals, waiting, tell);
        self.evict();
        Ok(())
    }

    /// A stream whose first frame is `frame`, which it has yet to observe.
    fn begin(&mut self, frame: &Frame) -> Result<(), Refusal> {
        let memory = self.surrogate.start(frame)?;
        if self.remarked.len() >= REMARKED {
            self.remarked.clear();
        }
        let is_new = self.remarked.insert(frame.stream);
        for remark in self.surrogate.warnings(frame) {
            match is_new {
                true => tracing::warn!("stream {}: {remark}", frame.stream),
                false => tracing::debug!("stream {}: {remark}", frame.stream),
            }
        }
        let track = StreamTrack {
            memory,
            predicted: frame.clone(),
            spare: frame.clone(),
            sequence: frame.sequence,
            stamp: frame.stamp,
            observed: 0,
            free_run_due: None,
            used: self.uses,
        };
        self.streams.insert(frame.stream, track);
        Ok(())
    }

    /// Steps every stream that waits, and publishes.
    fn step(&mut self, arrivals: &[Arrival], waiting: &mut Vec<Waiting>, tell: &mut Tell<'_>) {
        let Self { surrogate, stepper, settings, streams, ahead, simulated, uses, .. } = self;
        ahead.resize_with(waiting.len().max(ahead.len()), Ahead::default);
        let mut steps = [const { None }; TOGETHER];
        // One stream is looked up; several are picked out of all, as only so all can be written at once.
        let mut prepare = |number: usize, track, ahead| {
            let Waiting { index, gap, .. } = waiting[number];
            let (arrived, payload) = &arrivals[index];
            let Some(frame) = payload.view() else { return };
            let (arrived, tracking, finite) = (*arrived, false, true);
            let now = simulated.unwrap_or(arrived);
            steps[number] = Some(Step { track, frame, arrived, now, gap, ahead, tracking, finite });
        };
        match &waiting[..] {
            [] => return,
            [one] => {
                if let Some(track) = streams.get_mut(&one.stream) {
                    prepare(0, track, &mut ahead[0]);
                }
            }
            several => {
                let mut room = ahead.iter_mut();
                for (stream, track) in streams.iter_mut() {
                    let number = several.iter().position(|waiting| waiting.stream == *stream);
                    if let (Some(number), Some(ahead)) = (number, number.and_then(|_| room.next()))
                    {
                        prepare(number, track, ahead);
                    }
                }
            }
        }
        let warm_up = u64::from(surrogate.description().warm_up);
        stepper.for_each(&mut steps[..waiting.len()], |stepper, step| {
            if let Some(step) = step {
                step.run(stepper, settings, warm_up);
            }
        });
        let mut diverged = [const { None }; TOGETHER];
        for (step, diverged) in steps.iter_mut().flatten().zip(&mut diverged) {
            *uses += 1;
            step.track.used = *uses;
            if !step.finite {
                *diverged = Some(step.frame.stream);
            } else if step.tracking {
                for prediction in step.predictions(settings) {
                    tell(step.arrived, Ok(prediction));
                }
            }
        }
        waiting.clear();
        for stream in diverged.into_iter().flatten() {
            self.diverge(stream);
        }
    }

    fn refuse(&mut self, arrived: Duration, refusal: Refusal, tell: &mut Tell<'_>) {
        self.counters.refuse(&refusal);
        tell(arrived, Err(refusal));
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
