//! The loop of a running node: receives, predicts, publishes.
//!
//! A second thread receives into a [`FrameQueue`], so that the transport is read while the model works.

use std::{
    collections::BTreeMap,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    thread,
    time::Duration,
};

use super::{
    Arrival, CloudTopic, FrameQueue, GroupMember, InvalidSettings, LifecycleTransition, NodeHandle,
    NodeReport, Observer, Prediction, Rejected, Rejection, RosTime, SurrogateNode,
    diagnostics::Monitor,
    group::Epoch,
    load::{Load, Warnings},
};
use eddy_frames::clock::{self, Clock};
use eddy_inference::engine::ModelError;
use eddy_messages::{
    ParameterEvent, PredictionStatus, cdr,
    lifecycle::{TransitionDescription, TransitionEvent},
    services::Parameter,
};
use eddy_transport::{Link, Publisher, Subscriber, TransportError};

/// Longest wait before the stop flag is checked.
const MAX_WAIT: Duration = Duration::from_millis(100);
/// Longest wait during a free run on simulated time, which may advance at any moment.
const MAX_SIMULATED_WAIT: Duration = Duration::from_millis(2);
/// After the stop flag: how long messages that had already arrived are received, and predicted from.
const DRAIN_TIMEOUT: Duration = Duration::from_secs(1);
/// Minimum interval between warnings about an output.
const FAILURE_INTERVAL: Duration = Duration::from_secs(10);
const DIAGNOSTICS_INTERVAL: Duration = Duration::from_secs(1);

/// The topics of one output link of a node.
pub struct Outputs {
    /// Predicted frames; `None` for an output that carries point clouds only.
    pub prediction: Option<Box<dyn Publisher>>,
    /// Status of each prediction.
    pub status: Box<dyn Publisher>,
    /// Diagnostics of the node, once a second; on one output per transport.
    pub diagnostics: Option<Box<dyn Publisher>>,
    /// Changed parameters; on one output per transport.
    pub parameter_events: Option<Box<dyn Publisher>>,
    /// Transitions of a managed node; on one output per transport.
    pub transition_events: Option<Box<dyn Publisher>>,
    /// Predicted frames as point clouds.
    pub prediction_cloud: Option<CloudTopic>,
    /// Observed frames as point clouds; on one output per transport.
    pub input_cloud: Option<CloudTopic>,
    /// Observers within this process; on one output.
    pub observers: Vec<Box<dyn Observer>>,
}

impl Outputs {
    /// Predictions and their status only.
    pub fn new(prediction: Box<dyn Publisher>, status: Box<dyn Publisher>) -> Self {
        Self { prediction: Some(prediction), ..Self::status_only(status) }
    }

    /// The status of predictions only.
    pub fn status_only(status: Box<dyn Publisher>) -> Self {
        Self {
            prediction: None,
            status,
            diagnostics: None,
            parameter_events: None,
            transition_events: None,
            prediction_cloud: None,
            input_cloud: None,
            observers: Vec::new(),
        }
    }
}

/// Why a node ended.
#[derive(Debug, thiserror::Error)]
pub enum DriveError {
    /// Its input failed.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// Its network failed.
    #[error(transparent)]
    Model(#[from] ModelError),
}

/// What a node is connected to, beside its outputs.
pub struct NodeContext {
    /// Full name of the node, such as `/eddy_node`.
    pub name: String,
    /// The link that frames come from, for messages.
    pub input: Link,
    /// Time of free runs and of the node's own stamps.
    pub time: RosTime,
    /// Its place in its group, if it has one.
    pub group: Option<Arc<GroupMember>>,
}

/// Receives, predicts and publishes until `stop` is raised, then up to a second more for messages that had already
/// arrived. Answers requests through `handle` within 0.1 s.
///
/// # Errors
/// [`DriveError`] when the input or the device that predicts fails, or `/clock` cannot be subscribed to at the start. The
/// failure of an output is logged, and the node continues.
pub fn drive(
    node: &mut SurrogateNode,
    context: &mut NodeContext,
    input: &mut dyn Subscriber,
    outputs: &mut [Outputs],
    queue: &FrameQueue,
    handle: &NodeHandle,
    stop: &AtomicBool,
) -> Result<(), DriveError> {
    let clock = Clock::start();
    context.time.use_simulated(node.settings().use_sim_time)?;
    let lost = AtomicU64::new(0);
    let group = context.group.clone();
    let group = group.as_deref();
    thread::scope(|scope| -> Result<(), DriveError> {
        let receiver = scope.spawn(|| receive(input, queue, group, &clock, stop, &lost));
        // Whatever ends the loop, even a panic, must not leave the receiver waiting for a free slot.
        let _close = CloseOnDrop(queue, handle);
        let monitor = Monitor::start(clock.now());
        let digest = node.surrogate().digest().to_owned();
        let (published, unpublished) = (node.counters().published, node.counters().unpublished);
        let (status, bytes) = Default::default();
        let time = context.time.now(clock.now());
        let failures = Failures::default();
        let output = Output {
            outputs,
            clock,
            monitor,
            digest,
            status,
            bytes,
            published,
            unpublished,
            group,
            withheld: 0,
            failures,
        };
        let batch = Vec::with_capacity(node.batch_size());
        let mut running = Running {
            node,
            context,
            time,
            queue,
            lost: &lost,
            epoch: Epoch::default(),
            batch,
            output,
            warnings: Warnings::default(),
            load: Load::default(),
            busy: Duration::ZERO,
            reported: clock.now(),
        };
        let mut end = Duration::MAX;
        while !receiver.is_finished() && clock.now() < end && running.node.check().is_ok() {
            running.step();
            if end == Duration::MAX && stop.load(Ordering::Relaxed) {
                end = clock.now() + DRAIN_TIMEOUT;
            }
            let changed = running.answer(handle);
            if !changed.is_empty() {
                running.announce(changed);
            }
            running.announce_transitions();
            if clock.now() - running.reported >= DIAGNOSTICS_INTERVAL {
                running.report();
            }
        }
        end = end.min(clock.now() + DRAIN_TIMEOUT);
        while clock.now() < end && running.step() {}
        running.finish();
        // The receiver may be waiting for a free slot.
        queue.close();
        match receiver.join() {
            Ok(outcome) => Ok(outcome?),
            Err(panic) => std::panic::resume_unwind(panic),
        }
    })?;
    Ok(node.check()?)
}

/// Closes both queues on drop, so that nobody waits for a node that has ended.
struct CloseOnDrop<'a>(&'a FrameQueue, &'a NodeHandle);

impl Drop for CloseOnDrop<'_> {
    fn drop(&mut self) {
        self.0.close();
        self.1.close();
    }
}

/// Fills the queue with messages of the streams that the node observes until `stop` is raised, then with those that had
/// already arrived. Keeps `lost` at the number of messages dropped by the transport.
fn receive(
    input: &mut dyn Subscriber,
    queue: &FrameQueue,
    group: Option<&GroupMember>,
    clock: &Clock,
    stop: &AtomicBool,
    lost: &AtomicU64,
) -> Result<(), TransportError> {
    let mut end = None;
    while !queue.is_closed() && end.is_none_or(|end| clock.now() < end) {
        if end.is_none() && stop.load(Ordering::Relaxed) {
            end = Some(clock.now() + DRAIN_TIMEOUT);
        }
        let timeout = if end.is_some() { Duration::ZERO } else { MAX_WAIT };
        match input.receive(timeout)? {
            Some(payload) if group.is_none_or(|group| group.accepts(payload.stream())) => {
                queue.push(clock.now(), payload);
            }
            None if end.is_some() => break,
            Some(_) | None => {}
        }
        lost.store(input.lost(), Ordering::Relaxed);
    }
    Ok(())
}

/// The predicting side of a running node.
struct Running<'a> {
    node: &'a mut SurrogateNode,
    context: &'a mut NodeContext,
    /// Node time at the last step.
    time: Duration,
    queue: &'a FrameQueue,
    lost: &'a AtomicU64,
    /// Of the group, when the streams were last compared with it.
    epoch: Epoch,
    /// Messages of the current step; empty between steps.
    batch: Vec<Arrival>,
    output: Output<'a>,
    warnings: Warnings,
    load: Load,
    /// Time that the model has taken since the last report.
    busy: Duration,
    /// Time of the last report.
    reported: Duration,
}

/// The publishing side of a running node.
struct Output<'a> {
    outputs: &'a mut [Outputs],
    clock: Clock,
    monitor: Monitor,
    /// Digest of the model.
    digest: String,
    /// Buffers that are reused for every prediction.
    status: PredictionStatus,
    bytes: Vec<u8>,
    published: u64,
    unpublished: u64,
    group: Option<&'a GroupMember>,
    withheld: u64,
    failures: Failures,
}

/// Failures of outputs; the same failure is logged once in [`FAILURE_INTERVAL`].
#[derive(Default)]
struct Failures(BTreeMap<String, Duration>);

impl Failures {
    fn log(&mut self, now: Duration, outcome: Result<(), TransportError>) {
        let Err(error) = outcome else { return };
        let message = error.to_string();
        if self.0.get(&message).is_none_or(|logged| now - *logged > FAILURE_INTERVAL) {
            tracing::warn!("{message}");
            // Messages hardly differ; if they do, their number stays bounded.
            self.0.retain(|_, logged| now - *logged <= FAILURE_INTERVAL);
            self.0.insert(message, now);
        }
    }
}

impl Running<'_> {
    /// Predicts from waiting messages, one of each stream, then advances free runs. Returns whether there was a message.
    fn step(&mut self) -> bool {
        let timeout = self.until_tick().min(MAX_WAIT);
        self.queue.pop_batch(timeout, self.node.batch_size(), &mut self.batch);
        let had_message = !self.batch.is_empty();
        self.follow_group();
        let simulated = self.context.time.is_simulated().then(|| self.now());
        let Self { node, batch, output, busy, .. } = self;
        let started = output.clock.now();
        node.on_frames(batch, simulated, &mut |arrived, outcome| match outcome {
            Ok(prediction) => output.publish(&prediction, arrived),
            // Ignoring the input is the purpose of a free run.
            Err(Rejected { reason: Rejection::FreeRunning { .. }, .. }) => {}
            Err(rejected) => {
                tracing::debug!("frame rejected: {rejected}");
                output.monitor.rejected(rejected.to_string());
            }
        });
        *busy += output.clock.now() - started;
        if node.is_active() {
            output.show_observed(batch);
        }
        // Returns loaned samples to the transport.
        batch.clear();
        let now = self.now();
        let Self { node, output, .. } = self;
        let started = output.clock.now();
        node.on_tick(now, &mut |_, outcome| {
            if let Ok(prediction) = outcome {
                output.publish(&prediction, started);
            }
        });
        had_message
    }

    /// Forgets streams and waiting messages that another member of the group owns.
    fn follow_group(&mut self) {
        let Self { node, batch, output, epoch, .. } = self;
        let Some(group) = output.group else { return };
        group.set_active(node.is_active());
        let last = std::mem::replace(epoch, group.epoch());
        if epoch.left != last.left {
            node.hand_over(|_| false);
        } else if *epoch != last {
            node.hand_over(|stream| group.observes(stream));
        }
        batch.retain(|(_, payload)| group.accepts(payload.stream()));
    }

    /// Time until the next frame of a free run.
    fn until_tick(&mut self) -> Duration {
        let now = self.now();
        match self.node.next_tick() {
            None => Duration::MAX,
            Some(due) if due > now && self.context.time.is_simulated() => MAX_SIMULATED_WAIT,
            Some(due) => due.saturating_sub(now),
        }
    }

    /// Node time. When it jumps back, or is known for the first time, pending timers move with it.
    fn now(&mut self) -> Duration {
        let now = self.context.time.now(self.output.clock.now());
        if now < self.time || self.time.is_zero() {
            self.node.shift_time(self.time, now);
        }
        self.time = now;
        now
    }

    /// Answers requests. Returns the parameters that were set, among them `use_sim_time`, which switches the clock.
    fn answer(&mut self, handle: &NodeHandle) -> Vec<Parameter> {
        let mut before = self.now();
        let Self { node, context, time, output, .. } = self;
        handle.serve(node, |node, settings| {
            let change = context.time.use_simulated(settings.use_sim_time);
            if change.map_err(|error| InvalidSettings::Clock { reason: error.to_string() })? {
                *time = context.time.now(output.clock.now());
                node.shift_time(before, *time);
                before = *time;
            }
            Ok(())
        })
    }

    /// Publishes changed parameters on `/parameter_events`.
    fn announce(&mut self, changed_parameters: Vec<Parameter>) {
        let (stamp, node) = (self.context.time.stamp().into(), self.context.name.clone());
        let event = ParameterEvent { stamp, node, changed_parameters, ..ParameterEvent::default() };
        let bytes = cdr::encode(&event);
        let Output { outputs, failures, clock, .. } = &mut self.output;
        for events in outputs.iter_mut().filter_map(|o| o.parameter_events.as_mut()) {
            failures.log(clock.now(), events.publish_cdr(&bytes));
        }
    }

    /// Publishes the transitions of a managed node.
    fn announce_transitions(&mut self) {
        for transition in self.node.take_transitions() {
            let LifecycleTransition { start, goal, .. } = transition;
            tracing::info!("{} -> {}", start.label(), goal.label());
            if self.node.is_active() {
                self.warnings.waiting_since = self.output.clock.now();
            }
            let TransitionDescription { transition, start_state, goal_state } =
                (&transition).into();
            let timestamp = clock::wall().0.unsigned_abs();
            let event = TransitionEvent { timestamp, transition, start_state, goal_state };
            let bytes = cdr::encode(&event);
            let Output { outputs, failures, clock, .. } = &mut self.output;
            for events in outputs.iter_mut().filter_map(|o| o.transition_events.as_mut()) {
                failures.log(clock.now(), events.publish_cdr(&bytes));
            }
        }
    }

    /// Waits until subscribers have what was published, reports for the last time and says what was lost.
    fn finish(&mut self) {
        if let Some(group) = self.output.group {
            group.leave();
        }
        for output in self.output.outputs.iter_mut() {
            for publisher in output.prediction.iter_mut().chain([&mut output.status]) {
                match publisher.flush() {
                    Err(error @ TransportError::Undelivered { messages, .. }) => {
                        tracing::warn!("{error}");
                        self.output.unpublished += messages;
                    }
                    outcome => self.output.failures.log(self.output.clock.now(), outcome),
                }
            }
        }
        self.report();
        let lost = self.output.unpublished;
        if lost > 0 {
            tracing::warn!("{lost} messages were not delivered to all subscribers");
        }
    }

    fn report(&mut self) {
        let Self { node, queue, output, context, .. } = self;
        let (streams, is_active) = (node.streams(), node.is_active());
        let idle = node.lifecycle().filter(|_| !is_active);
        let (horizon, threads) = (node.settings().horizon, node.threads());
        let limit = node.settings().max_expected_error;
        let counters = node.counters_mut();
        counters.published = output.published;
        counters.unpublished = output.unpublished;
        counters.withheld = output.withheld;
        counters.foreign = output.group.map_or(0, GroupMember::foreign_frames);
        counters.group = output.group.map(|group| group.counts(streams));
        counters.dropped_from_queue = queue.dropped();
        counters.dropped_by_stream = queue.dropped_by_stream();
        counters.lost_in_transport = self.lost.load(Ordering::Relaxed);
        let (now, last) = (output.clock.now(), self.load);
        let (received, dropped) = (counters.received, counters.dropped_from_queue);
        self.load = Load {
            received,
            dropped,
            frames: received - last.received,
            arrived: received + dropped - last.received - last.dropped,
            busy: std::mem::take(&mut self.busy),
            interval: now - self.reported,
            horizon,
            streams,
            threads,
        };
        let since = std::mem::replace(&mut self.reported, now);
        match idle {
            Some(state) => output.monitor.idle(state.label()),
            None => self.warnings.check(now, &context.input, &self.load),
        }
        node.log_rejections(now);
        output.report(context, node, since, limit);
    }
}

impl Output<'_> {
    /// Passes observed frames to observers and point clouds.
    fn show_observed(&mut self, batch: &[Arrival]) {
        for observer in self.outputs.iter_mut().flat_map(|output| &mut output.observers) {
            for frame in batch.iter().filter_map(|(_, payload)| payload.view()) {
                observer.observed(&frame);
            }
        }
        for cloud in self.outputs.iter_mut().filter_map(|output| output.input_cloud.as_mut()) {
            for frame in batch.iter().filter_map(|(_, payload)| payload.view()) {
                cloud.publish(&frame);
            }
        }
    }

    fn publish(&mut self, prediction: &Prediction<'_>, arrived: Duration) {
        let latency = self.clock.now() - arrived;
        // Immediately before: the program may have been paused at any moment since the frame was received.
        if self.group.is_some_and(|group| !group.may_publish(prediction.frame.stream, latency)) {
            self.withheld += 1;
            return;
        }
        prediction.status(latency, &self.digest, &mut self.status);
        cdr::encode_into(&self.status, &mut self.bytes);
        for output in self.outputs.iter_mut() {
            match output.prediction.as_mut().map(|to| to.publish_frame(prediction.frame)) {
                Some(Ok(())) => self.published += 1,
                Some(failed) => {
                    self.failures.log(self.clock.now(), failed);
                    self.unpublished += 1;
                }
                None => {}
            }
            self.failures.log(self.clock.now(), output.status.publish_cdr(&self.bytes));
        }
        self.monitor.published(1, self.clock.now() - arrived);
        if let Some(error) = prediction.expected_error {
            self.monitor.expects(prediction.frame.stream, error);
        }
        // Point clouds and observers come last: predictions do not wait for them.
        for cloud in self.outputs.iter_mut().filter_map(|output| output.prediction_cloud.as_mut()) {
            cloud.publish(&prediction.frame.into());
        }
        for observer in self.outputs.iter_mut().flat_map(|output| &mut output.observers) {
            observer.predicted(prediction);
        }
    }

    fn report(
        &mut self,
        context: &NodeContext,
        node: &SurrogateNode,
        since: Duration,
        max_expected_error: Option<f64>,
    ) {
        let now = self.clock.now();
        let counters = node.counters();
        let report = NodeReport {
            rates: self.monitor.rates(now),
            counters,
            streams: node.streams(),
            rejected: node.rejections().last_since(since),
            warnings: node.warnings(),
        };
        for observer in self.outputs.iter_mut().flat_map(|output| &mut output.observers) {
            observer.reported(&report);
        }
        // Names in diagnostics have no leading slash.
        let name = context.name.trim_start_matches('/');
        let (stamp, digest) = (context.time.stamp(), &self.digest);
        let report = self.monitor.report(now, stamp, name, digest, counters, max_expected_error);
        let bytes = cdr::encode(&report);
        for diagnostics in self.outputs.iter_mut().filter_map(|o| o.diagnostics.as_mut()) {
            self.failures.log(now, diagnostics.publish_cdr(&bytes));
        }
    }
}
