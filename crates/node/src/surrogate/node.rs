//! Which frames are used, and what they do to the set of streams.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::{Arc, atomic::AtomicBool},
    time::Duration,
};

use super::{
    Counters, InvalidSettings, LifecycleState, LifecycleTransition, NodeSettings, Prediction,
    Rejected, Rejection, RejectionLog,
    steps::{BatchContext, HorizonBuffers, StreamSteps, interval},
    stream::{Order, StreamState, expected_error},
};
use eddy_frames::{Frame, FrameView};
use eddy_inference::{
    engine::{ModelError, Stated, StepRequest, Stepper, Surrogate, Warning},
    error_model::ErrorTracker,
};
use eddy_messages::{StreamState as Phase, lifecycle::Transition, services::Parameter};
use eddy_transport::Payload;

/// A message with its time of arrival.
pub type Arrival = (Duration, Payload);

/// Receives each prediction to publish, in the order of the predicted instants, and each rejected frame, with the
/// arrival time of the frame that caused it. Rejections are already counted, and logged.
pub type OutputCallback<'a> = dyn FnMut(Duration, Result<Prediction<'_>, Rejected>) + 'a;

/// Maximum number of streams stepped at once: as many as a GPU takes; a processor has one a thread.
const MAX_BATCH: usize = 64;

/// Largest number of frames that a free run makes up for.
const MAX_CATCH_UP: u32 = 16;

/// Streams of which it is remembered that the model's warnings were logged.
const MAX_WARNED: usize = 4096;
/// Logged once per stream.
const PARTICLES_CHANGED: &str = "the number of particles changed and the stream was reset; a stream must have the same particles in all frames";
/// Warnings that are kept for observers.
const MAX_WARNINGS: usize = 64;

/// A surrogate with the state of every stream that it observes.
///
/// Deterministic: the same calls give bit-identical predictions, whatever the number of threads.
pub struct SurrogateNode {
    surrogate: Surrogate,
    stepper: Stepper,
    settings: NodeSettings,
    streams: BTreeMap<u64, StreamState>,
    /// One for each stream of a batch.
    buffers: Vec<HorizonBuffers>,
    /// The batch; empty between calls.
    batch: Vec<Scheduled>,
    /// Node time, if it is not the time of arrival.
    simulated: Option<Duration>,
    /// Incremented at every use of a stream: eviction must not depend on time.
    uses: u64,
    counters: Counters,
    rejections: RejectionLog,
    /// What the source of the streams states.
    stated: Stated,
    /// Streams whose warnings were logged: once each, however often they restart.
    warned: BTreeSet<u64>,
    /// The last of these warnings, with their streams.
    warnings: Vec<(u64, String)>,
    /// See [`SurrogateNode::stop_with`].
    stop: Arc<AtomicBool>,
    /// State of a managed node; others are always active.
    lifecycle: Option<LifecycleState>,
    /// Transitions since they were last taken.
    transitions: Vec<LifecycleTransition>,
}

/// A frame to step with the batch.
struct Scheduled {
    /// Index into the arrivals.
    index: usize,
    stream: u64,
    /// Missing frames for the model to fill in.
    gap: u64,
}

/// The steps of the streams of a batch, in its order.
fn prepare<'a>(
    batch: &[Scheduled],
    arrivals: &'a [Arrival],
    streams: &'a mut BTreeMap<u64, StreamState>,
    buffers: &'a mut [HorizonBuffers],
    context: BatchContext<'a>,
) -> [Option<StreamSteps<'a>>; MAX_BATCH] {
    let steps_of = |scheduled: &Scheduled, stream, buffers| {
        let (arrived, payload) = &arrivals[scheduled.index];
        let frame = payload.view()?;
        Some(StreamSteps::new(stream, buffers, frame, *arrived, scheduled.gap, context))
    };
    let mut steps = [const { None }; MAX_BATCH];
    let mut buffers = buffers.iter_mut();
    // One stream is looked up; several are found by iteration, which gives mutable references to all of them.
    if let [one] = batch {
        let found = streams.get_mut(&one.stream).zip(buffers.next());
        steps[0] = found.and_then(|(stream, buffers)| steps_of(one, stream, buffers));
        return steps;
    }
    for (id, stream) in streams {
        let number = batch.iter().position(|scheduled| scheduled.stream == *id);
        let found = number.and_then(|number| Some((number, buffers.next()?)));
        if let Some((number, buffers)) = found {
            steps[number] = steps_of(&batch[number], stream, buffers);
        }
    }
    steps
}

/// When the next frame of a free run is due after one that was due at `due`, and the number of frames skipped before it.
fn next_due(due: Duration, now: Duration, interval: Duration) -> (Duration, u64) {
    let behind = now.saturating_sub(due);
    if interval.is_zero() || behind <= interval * MAX_CATCH_UP {
        return (due + interval, 0);
    }
    let (behind, interval) = (behind.as_nanos(), interval.as_nanos());
    let until = interval - behind % interval;
    let until = Duration::from_nanos(u64::try_from(until).unwrap_or(u64::MAX));
    (now + until, u64::try_from(behind / interval).unwrap_or(u64::MAX))
}

impl SurrogateNode {
    /// A node without streams.
    ///
    /// # Errors
    /// [`InvalidSettings`] when a setting is out of range, or the model requires a stiffness that is missing, or does not use
    /// one.
    pub fn new(surrogate: Surrogate, settings: NodeSettings) -> Result<Self, InvalidSettings> {
        settings.check()?;
        surrogate
            .check_stiffness(settings.stream_stiffness())
            .map_err(|error| InvalidSettings::Stiffness { reason: error.to_string() })?;
        Ok(Self {
            stepper: surrogate.stepper(),
            surrogate,
            settings,
            streams: BTreeMap::new(),
            buffers: Vec::new(),
            batch: Vec::new(),
            simulated: None,
            uses: 0,
            counters: Counters::default(),
            rejections: RejectionLog::default(),
            stated: Stated::default(),
            warned: BTreeSet::new(),
            warnings: Vec::new(),
            stop: Arc::default(),
            lifecycle: None,
            transitions: Vec::new(),
        })
    }

    /// The surrogate that predicts.
    pub fn surrogate(&self) -> &Surrogate {
        &self.surrogate
    }

    /// Checks that the device that predicts has not failed.
    ///
    /// # Errors
    /// [`ModelError::Device`]; then nothing is predicted any more.
    pub fn check(&self) -> Result<(), ModelError> {
        self.stepper.check()
    }

    /// Once `stop` is raised, the predictions of a frame up to a far horizon are given up.
    pub fn stop_with(&mut self, stop: Arc<AtomicBool>) {
        self.stop = stop;
    }

    /// Makes this a managed node, which is unconfigured at first.
    pub fn manage(&mut self) {
        self.lifecycle = Some(LifecycleState::Unconfigured);
    }

    /// The state of a managed node.
    pub fn lifecycle(&self) -> Option<LifecycleState> {
        self.lifecycle
    }

    /// Whether frames are observed; they are ignored otherwise.
    pub fn is_active(&self) -> bool {
        self.lifecycle.is_none_or(|state| state == LifecycleState::Active)
    }

    /// Changes the state of a managed node. A node that is no longer active resets its streams. Returns whether there is
    /// such a transition from the current state.
    pub fn change_state(&mut self, wanted: &Transition) -> bool {
        let Some([first, second]) = self.lifecycle.and_then(|state| state.after(wanted)) else {
            return false;
        };
        if self.is_active() {
            self.reset();
        }
        self.lifecycle = Some(second.goal);
        self.transitions.extend([first, second]);
        true
    }

    /// The transitions since the last call.
    pub fn take_transitions(&mut self) -> Vec<LifecycleTransition> {
        std::mem::take(&mut self.transitions)
    }

    /// Counts since the start.
    pub fn counters(&self) -> &Counters {
        &self.counters
    }

    /// For counts that arise outside of this node: publishing, queues.
    pub fn counters_mut(&mut self) -> &mut Counters {
        &mut self.counters
    }

    /// What the source of the streams states about those that begin from now on, to be compared with the model.
    pub fn streams_state(&mut self, stated: Stated) {
        self.stated = stated;
    }

    /// How streams differ from what the model was trained on, as logged: the stream and a sentence.
    pub fn warnings(&self) -> &[(u64, String)] {
        &self.warnings
    }

    /// The rejected frames, but for those ignored during a free run.
    pub fn rejections(&self) -> &RejectionLog {
        &self.rejections
    }

    /// Logs rejections that have gone on for a while; `now` is a time of arrival.
    pub fn log_rejections(&mut self, now: Duration) {
        self.rejections.overdue(now).iter().for_each(|sentence| tracing::warn!("{sentence}"));
    }

    /// Number of streams kept.
    pub fn streams(&self) -> usize {
        self.streams.len()
    }

    /// The current settings.
    pub fn settings(&self) -> &NodeSettings {
        &self.settings
    }

    /// Changes parameters, effective with the next frame.
    ///
    /// # Errors
    /// [`InvalidSettings`] with the first parameter that cannot be set; then nothing changes.
    pub fn set(&mut self, parameters: &[Parameter]) -> Result<(), InvalidSettings> {
        self.set_and(parameters, |_, _| Ok(()))
    }

    /// Changes parameters if `apply`, called with the new settings, succeeds.
    ///
    /// # Errors
    /// As [`SurrogateNode::set`], and those of `apply`; then nothing changes.
    pub fn set_and(
        &mut self,
        parameters: &[Parameter],
        apply: impl FnOnce(&mut Self, &NodeSettings) -> Result<(), InvalidSettings>,
    ) -> Result<(), InvalidSettings> {
        let mut settings = self.settings.clone();
        parameters.iter().try_for_each(|parameter| settings.set_running(parameter))?;
        apply(self, &settings)?;
        self.settings = settings;
        Ok(())
    }

    /// Moves pending timers from a clock that shows `old` to one that shows `new`; the remaining times stay.
    pub fn shift_time(&mut self, old: Duration, new: Duration) {
        for stream in self.streams.values_mut() {
            stream.free_run_due = stream.free_run_due.map(|due| new + due.saturating_sub(old));
        }
    }

    /// Resets every stream: each warms up again. Returns how many there were.
    pub fn reset(&mut self) -> usize {
        let streams = self.streams.len();
        self.counters.resets += streams as u64;
        self.streams.clear();
        streams
    }

    /// Forgets the streams that another member of the group owns.
    pub(super) fn hand_over(&mut self, is_kept: impl Fn(u64) -> bool) {
        let before = self.streams.len();
        self.streams.retain(|&stream, _| is_kept(stream));
        self.counters.handed_over += (before - self.streams.len()) as u64;
    }

    /// Maximum number of frames that [`SurrogateNode::on_frames`] steps in parallel.
    pub fn batch_size(&self) -> usize {
        self.stepper.streams().min(MAX_BATCH)
    }

    /// Threads that step one stream each; `None` on a GPU, which steps all at once.
    pub(super) fn threads(&self) -> Option<usize> {
        self.stepper.threads()
    }

    /// Observes frames in order, if the node is active. Frames of different streams are stepped in parallel, with bit-identical predictions.
    /// Free runs start at `simulated`, the time of a node that follows `/clock`, otherwise at the arrival of the last
    /// observed frame.
    pub fn on_frames(
        &mut self,
        arrivals: &mut [Arrival],
        simulated: Option<Duration>,
        output: &mut OutputCallback<'_>,
    ) {
        if !self.is_active() {
            return;
        }
        self.simulated = simulated;
        let mut batch = std::mem::take(&mut self.batch);
        for (arrived, payload) in &mut *arrivals {
            self.counters.received += 1;
            let stream = payload.stream();
            if let Err(bad) = payload.decode() {
                self.reject(*arrived, Rejected { stream, reason: bad.into() }, output);
            }
        }
        for (index, (arrived, payload)) in arrivals.iter().enumerate() {
            let Some(frame) = payload.view() else { continue };
            if let Err(reason) = self.schedule(index, &frame, arrivals, &mut batch, output) {
                self.reject(*arrived, Rejected { stream: Some(frame.stream), reason }, output);
            }
        }
        self.step(arrivals, &mut batch, output);
        self.batch = batch;
        // `max_streams` may have been lowered.
        self.evict();
    }

    /// Publishes the frames of free runs that are due at `now`, at most one per stream. A free run that is more than
    /// [`MAX_CATCH_UP`] frames behind skips what it missed, as timers in ROS do, and counts it: its next frame follows the
    /// last one, one interval after `now` at the latest.
    pub fn on_tick(&mut self, now: Duration, output: &mut OutputCallback<'_>) {
        let mut diverged = Vec::new();
        let due = self.streams.iter_mut().filter_map(|(&id, stream)| {
            Some((id, stream.free_run_due.filter(|&due| due <= now)?, stream))
        });
        let mut due: Vec<_> = due.collect();
        let mut requests: Vec<_> = due
            .iter_mut()
            .map(|(.., stream)| {
                let StreamState { memory: hidden, predicted: next, spare, .. } = &mut **stream;
                std::mem::swap(next, spare);
                StepRequest { hidden, frame: (&*spare).into(), next }
            })
            .collect();
        self.stepper.step_all(&mut requests);
        for (id, due, stream) in due {
            let frame = &stream.spare;
            self.uses += 1;
            stream.used = self.uses;
            let interval = interval(frame.dt);
            let (next, skipped) = next_due(due, now, interval);
            stream.free_run_due = Some(next);
            self.counters.skipped_in_free_run =
                self.counters.skipped_in_free_run.saturating_add(skipped);
            if frame.check().is_err() {
                diverged.push(id);
                continue;
            }
            let ahead = frame.sequence - stream.sequence;
            let horizon = u32::try_from(ahead).unwrap_or(u32::MAX);
            let model = self.surrogate.error_model();
            let expected_error = expected_error(&mut stream.error_tracker, model, frame, horizon);
            output(
                now,
                Ok(Prediction {
                    source_sequence: stream.sequence,
                    horizon,
                    state: Phase::FreeRunning,
                    frame,
                    expected_error,
                }),
            );
        }
        for stream in diverged {
            self.diverge(stream);
        }
    }

    /// When [`SurrogateNode::on_tick`] has to be called next.
    pub fn next_tick(&self) -> Option<Duration> {
        self.streams.values().filter_map(|stream| stream.free_run_due).min()
    }

    /// Decides what a frame does to its stream and adds it to the batch. The batch is stepped first where frames cannot
    /// share it: a stream's second frame, and a frame that starts a stream, as it may evict another.
    fn schedule(
        &mut self,
        index: usize,
        frame: &FrameView<'_>,
        arrivals: &[Arrival],
        batch: &mut Vec<Scheduled>,
        output: &mut OutputCallback<'_>,
    ) -> Result<(), Rejection> {
        // First of all: an invalid frame must not reset its stream.
        self.surrogate.fits(*frame)?;
        let stream = frame.stream;
        if batch.len() >= self.batch_size() || batch.iter().any(|other| other.stream == stream) {
            self.step(arrivals, batch, output);
        }
        let Self { streams, settings, counters, .. } = self;
        let mut particles_changed = false;
        let gap = match streams.get_mut(&stream) {
            None => None,
            Some(state) => match state.order(frame) {
                Order::Restart => {
                    counters.resets += 1;
                    particles_changed = frame.particles.len() != state.predicted.len();
                    None
                }
                _ if state.free_run_due.is_some() => {
                    return Err(Rejection::FreeRunning { found: frame.sequence });
                }
                Order::Next { gap } if gap <= settings.max_gap => {
                    counters.filled += gap;
                    Some(gap)
                }
                Order::Next { gap } => {
                    counters.lost_in_gaps = counters.lost_in_gaps.saturating_add(gap);
                    counters.resets += 1;
                    // The particles are the same: the rest shape of solids stays valid.
                    state.memory.forget();
                    state.error_tracker.iter_mut().for_each(ErrorTracker::forget);
                    state.observed = 0;
                    Some(0)
                }
                Order::Late => {
                    let (found, expected) = (frame.sequence, state.sequence + 1);
                    return Err(Rejection::Late { found, expected });
                }
            },
        };
        if let Some(gap) = gap {
            batch.push(Scheduled { index, stream, gap });
            return Ok(());
        }
        self.step(arrivals, batch, output);
        self.start(&frame.to_frame())?;
        // No more once the list is full, so that many such streams do not flood the log.
        if particles_changed
            && self.warnings.len() < MAX_WARNINGS
            && !self.warnings.contains(&(stream, PARTICLES_CHANGED.to_owned()))
        {
            self.warn(stream, PARTICLES_CHANGED.to_owned());
        }
        batch.push(Scheduled { index, stream, gap: 0 });
        self.step(arrivals, batch, output);
        self.evict();
        Ok(())
    }

    /// Adds the stream of `frame`, its first frame, which is yet to be observed.
    fn start(&mut self, frame: &Frame) -> Result<(), Rejection> {
        let stiffness = self.settings.stream_stiffness();
        let memory = self.surrogate.start_with_stiffness(frame, stiffness)?;
        if self.warned.len() >= MAX_WARNED {
            self.warned.clear();
        }
        let is_new = self.warned.insert(frame.stream);
        let stated = Stated { stiffness: stiffness.or(self.stated.stiffness), ..self.stated };
        for warning in self.surrogate.warnings(frame, stated) {
            // The assumed stiffness is the same for all streams: one warning is enough.
            let of_node = matches!(warning, Warning::AssumedStiffness { .. });
            let text = warning.to_string();
            if !is_new || of_node && self.warnings.iter().any(|(_, said)| *said == text) {
                tracing::debug!("stream {}: {warning}", frame.stream);
                continue;
            }
            self.warn(frame.stream, text);
        }
        let error_tracker = self.surrogate.error_model().map(|_| {
            ErrorTracker::new(self.surrogate.description(), &frame.domain, &frame.material)
        });
        let state = StreamState {
            memory,
            predicted: frame.clone(),
            spare: frame.clone(),
            error_tracker,
            sequence: frame.sequence,
            stamp: frame.stamp,
            observed: 0,
            free_run_due: None,
            used: self.uses,
        };
        self.streams.insert(frame.stream, state);
        Ok(())
    }

    /// Logs a warning about a stream and keeps it for the diagnostics.
    fn warn(&mut self, stream: u64, text: String) {
        tracing::warn!("stream {stream}: {text}");
        if self.warnings.len() >= MAX_WARNINGS {
            self.warnings.remove(0);
        }
        self.warnings.push((stream, text));
    }

    /// Steps the batch in parallel and passes on the predictions.
    fn step(
        &mut self,
        arrivals: &[Arrival],
        batch: &mut Vec<Scheduled>,
        output: &mut OutputCallback<'_>,
    ) {
        if batch.is_empty() {
            return;
        }
        let Self { surrogate, stepper, settings, streams, buffers, uses, .. } = self;
        let context = BatchContext {
            settings,
            warm_up: u64::from(surrogate.description().warm_up),
            error_model: surrogate.error_model(),
            simulated: self.simulated,
            stop: &self.stop,
        };
        buffers.resize_with(batch.len().max(buffers.len()), HorizonBuffers::default);
        let mut steps = prepare(batch, arrivals, streams, buffers, context);
        stepper.run_all(&mut steps[..batch.len()], |steps| steps.as_mut()?.next());
        let mut diverged = [const { None }; MAX_BATCH];
        for (steps, diverged) in steps.iter_mut().flatten().zip(&mut diverged) {
            *uses += 1;
            steps.stream.used = *uses;
            if steps.has_diverged() {
                *diverged = Some(steps.frame.stream);
                continue;
            }
            for prediction in steps.predictions() {
                output(steps.arrived, Ok(prediction));
            }
        }
        batch.clear();
        for stream in diverged.into_iter().flatten() {
            self.diverge(stream);
        }
    }

    fn reject(&mut self, arrived: Duration, rejected: Rejected, output: &mut OutputCallback<'_>) {
        let counter = self.counters.reject(&rejected.reason);
        // Ignoring the input is the purpose of a free run.
        if !matches!(rejected.reason, Rejection::FreeRunning { .. })
            && let Some(sentence) = self.rejections.add(arrived, counter, &rejected)
        {
            tracing::warn!("{sentence}");
        }
        output(arrived, Err(rejected));
    }

    fn diverge(&mut self, stream: u64) {
        self.streams.remove(&stream);
        self.counters.diverged += 1;
        self.counters.resets += 1;
    }

    /// Removes the least recently used streams beyond `max_streams`.
    fn evict(&mut self) {
        while self.streams.len() > self.settings.max_streams {
            let oldest = self.streams.iter().min_by_key(|(_, stream)| stream.used);
            if let Some(stream) = oldest.map(|(&id, _)| id) {
                self.streams.remove(&stream);
                self.counters.forgotten_streams += 1;
            }
        }
    }
}
