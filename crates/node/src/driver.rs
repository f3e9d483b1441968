//! Connects a [`SurrogateNode`] with its topics.

use std::{
    sync::atomic::{AtomicBool, AtomicU64, Ordering},
    thread,
    time::Duration,
};

use super::{
    Arrival, CloudTopic, Control, Counters, FrameQueue, InvalidSettings, Onlooker, Prediction,
    Refusal, RosTime, SurrogateNode, diagnostics::Monitor,
};
use eddy_frames::clock::Clock;
use eddy_messages::{ParameterEvent, PredictionStatus, cdr, services::Parameter};
use eddy_transport::{Publisher, Subscriber, TransportError};

/// How long a wait may last before the stop flag is looked at.
const PATIENCE: Duration = Duration::from_millis(100);
/// The same while a free run waits for simulated time, which may go on at any moment.
const SIMULATED_PATIENCE: Duration = Duration::from_millis(2);
/// How long messages that had arrived at the end are still taken, and predicted from.
const LAST_ARRIVALS: Duration = Duration::from_secs(1);
/// How long nothing may come before it is said.
const SILENCE: Duration = Duration::from_secs(5);
/// Time between two words on dropped frames.
const SLOWNESS_INTERVAL: Duration = Duration::from_secs(10);
/// Time between two diagnostics.
const DIAGNOSTICS_INTERVAL: Duration = Duration::from_secs(1);

/// The topics that one link of a node publishes on.
pub struct Outputs {
    /// Predicted frames. Who only looks has their clouds instead.
    pub prediction: Option<Box<dyn Publisher>>,
    /// How each prediction came to be.
    pub status: Box<dyn Publisher>,
    /// The state of the node, once a second. One of several outputs on the same transport has it.
    pub diagnostics: Option<Box<dyn Publisher>>,
    /// Parameters that were set. Likewise one of several outputs has it.
    pub parameter_events: Option<Box<dyn Publisher>>,
    /// Predicted frames as points.
    pub prediction_cloud: Option<CloudTopic>,
    /// Observed frames as points. Likewise one of several outputs has it.
    pub input_cloud: Option<CloudTopic>,
    /// Those within this process who look at the node. Likewise one of several outputs has them.
    pub onlookers: Vec<Box<dyn Onlooker>>,
}

impl Outputs {
    /// Predictions and their status, nothing else.
    pub fn new(prediction: Box<dyn Publisher>, status: Box<dyn Publisher>) -> Self {
        Self { prediction: Some(prediction), ..Self::to_look_at(status) }
    }

    /// The status of predictions, nothing else.
    pub fn to_look_at(status: Box<dyn Publisher>) -> Self {
        let prediction = None;
        let (diagnostics, parameter_events) = (None, None);
        let (prediction_cloud, input_cloud) = (None, None);
        let onlookers = Vec::new();
        Self {
            prediction,
            status,
            diagnostics,
            parameter_events,
            prediction_cloud,
            input_cloud,
            onlookers,
        }
    }
}

/// Who the node is to others, and what time it is for it.
pub struct Presence {
    /// Its full name, such as `/eddy_node`.
    pub name: String,
    /// Its time.
    pub time: RosTime,
}

/// Receives, predicts and publishes until `stop` is raised, then for at most two seconds what had
/// arrived by then. Answers what is asked through `control`, within a tenth of a second.
///
/// # Errors
/// [`TransportError`] when the input fails, or `/clock` cannot be read from the start. An output that fails is
/// logged, and the node goes on.
pub fn drive(
    node: &mut SurrogateNode,
    presence: &mut Presence,
    input: &mut dyn Subscriber,
    outputs: &mut [Outputs],
    queue: &FrameQueue,
    control: &Control,
    stop: &AtomicBool,
) -> Result<(), TransportError> {
    let clock = Clock::start();
    presence.time.follow(node.settings().use_sim_time)?;
    let lost = AtomicU64::new(0);
    thread::scope(|scope| {
        let receiver = scope.spawn(|| receive(input, queue, &clock, stop, &lost));
        // Whatever ends the loop, a panic included, the receiver must not wait for room for ever.
        let _closing = Closing(queue, control);
        let monitor = Monitor::start(clock.now());
        let digest = node.surrogate().digest().to_owned();
        let (published, unpublished) = (node.counters().published, node.counters().unpublished);
        let (status, bytes) = Default::default();
        let time = presence.time.now(clock.now());
        let sink = Sink { outputs, clock, monitor, digest, status, bytes, published, unpublished };
        let batch = Vec::with_capacity(node.together());
        let troubles = Troubles::default();
        let mut work = Work { node, presence, time, queue, lost: &lost, batch, sink, troubles };
        let mut reported = clock.now();
        while !receiver.is_finished() {
            work.step();
            let changed = work.answer(control);
            if !changed.is_empty() {
                work.tell(changed);
            }
            if clock.now() - reported >= DIAGNOSTICS_INTERVAL {
                reported = clock.now();
                work.report();
            }
        }
        let end = clock.now() + LAST_ARRIVALS;
        while clock.now() < end && work.step() {}
        work.report();
        match receiver.join() {
            Ok(outcome) => outcome,
            Err(panic) => std::panic::resume_unwind(panic),
        }
    })
}

/// Closes both queues when it goes: who waits for an answer is told at once that there will be none.
struct Closing<'a>(&'a FrameQueue, &'a Control);

impl Drop for Closing<'_> {
    fn drop(&mut self) {
        self.0.close();
        self.1.close();
    }
}

/// Fills the queue until `stop` is raised, then with what had arrived by then. Keeps `lost` at what
/// the transport gave up.
fn receive(
    input: &mut dyn Subscriber,
    queue: &FrameQueue,
    clock: &Clock,
    stop: &AtomicBool,
    lost: &AtomicU64,
) -> Result<(), TransportError> {
    let mut end = None;
    while !queue.is_closed() && end.is_none_or(|end| clock.now() < end) {
        if end.is_none() && stop.load(Ordering::Relaxed) {
            end = Some(clock.now() + LAST_ARRIVALS);
        }
        let patience = if end.is_some() { Duration::ZERO } else { PATIENCE };
        match input.receive(patience)? {
            Some(payload) => {
                queue.push(clock.now(), payload);
            }
            None if end.is_some() => break,
            None => {}
        }
        lost.store(input.refused(), Ordering::Relaxed);
    }
    Ok(())
}

/// Everything the predicting side works with.
struct Work<'a> {
    node: &'a mut SurrogateNode,
    presence: &'a mut Presence,
    /// The node's time when it was last looked at.
    time: Duration,
    queue: &'a FrameQueue,
    lost: &'a AtomicU64,
    /// Messages that are worked on at once; empty between steps.
    batch: Vec<Arrival>,
    sink: Sink<'a>,
    troubles: Troubles,
}

/// What is said to whoever runs the node, and not again and again.
#[derive(Default)]
struct Troubles {
    /// Whether it was said that nothing comes.
    silence: bool,
    /// When frames were last said to have been dropped, and how many had been then.
    dropped: Option<(Duration, u64)>,
}

impl Troubles {
    fn look(&mut self, now: Duration, received: u64, dropped: u64) {
        if received == 0 && now > SILENCE && !self.silence {
            self.silence = true;
            tracing::warn!(
                "no frame has come for {} s: is it the topic, and the transport, that is published?",
                SILENCE.as_secs()
            );
        }
        let (told, before) = self.dropped.unwrap_or_default();
        let is_due = self.dropped.is_none() || now - told > SLOWNESS_INTERVAL;
        if dropped > before && is_due {
            tracing::warn!(
                "{} frames came faster than they are predicted from, and were dropped",
                dropped - before
            );
            self.dropped = Some((now, dropped));
        }
    }
}

/// Where predictions go.
struct Sink<'a> {
    outputs: &'a mut [Outputs],
    clock: Clock,
    monitor: Monitor,
    /// Of the model.
    digest: String,
    /// Used again for every prediction.
    status: PredictionStatus,
    bytes: Vec<u8>,
    published: u64,
    unpublished: u64,
}

impl Work<'_> {
    /// Predicts from what waits, one message of a stream, or from one tick. Returns whether there was a message.
    fn step(&mut self) -> bool {
        let patience = self.until_tick().min(PATIENCE);
        self.queue.pop_batch(patience, self.node.together(), &mut self.batch);
        let had_message = !self.batch.is_empty();
        let simulated = self.presence.time.is_simulated().then(|| self.now());
        let Self { node, batch, sink, .. } = self;
        node.on_frames(batch, simulated, &mut |arrived, outcome| match outcome {
            Ok(prediction) => sink.publish(&prediction, arrived),
            // A stream that runs free is meant to ignore its source.
            Err(Refusal::FreeRunning { .. }) => {}
            Err(refusal) => {
                tracing::debug!("frame refused: {refusal}");
                sink.monitor.refused(refusal.to_string());
            }
        });
        sink.show(batch);
        // Gives back what was lent.
        batch.clear();
        let now = self.now();
        let Self { node, sink, .. } = self;
        let started = sink.clock.now();
        node.on_tick(now, &mut |_, outcome| {
            if let Ok(prediction) = outcome {
                sink.publish(&prediction, started);
            }
        });
        had_message
    }

    /// How long nothing but a message is to be done.
    fn until_tick(&mut self) -> Duration {
        let now = self.now();
        match self.node.next_tick() {
            None => Duration::MAX,
            Some(due) if due > now && self.presence.time.is_simulated() => SIMULATED_PATIENCE,
            Some(due) => due.saturating_sub(now),
        }
    }

    /// The node's time. When it jumps back, or is told for the first time, what was due moves along.
    fn now(&mut self) -> Duration {
        let now = self.presence.time.now(self.sink.clock.now());
        if now < self.time || self.time.is_zero() {
            self.node.shift_time(self.time, now);
        }
        self.time = now;
        now
    }

    /// Answers what is asked. Returns the parameters that were set; they may ask for another time.
    fn answer(&mut self, control: &Control) -> Vec<Parameter> {
        let mut before = self.now();
        let Self { node, presence, time, sink, .. } = self;
        control.serve(node, |node, settings| {
            let change = presence.time.follow(settings.use_sim_time);
            if change.map_err(|error| InvalidSettings::Clock { reason: error.to_string() })? {
                *time = presence.time.now(sink.clock.now());
                node.shift_time(before, *time);
                before = *time;
            }
            Ok(())
        })
    }

    /// Says which parameters were set.
    fn tell(&mut self, changed_parameters: Vec<Parameter>) {
        let (stamp, node) = (self.presence.time.stamp().into(), self.presence.name.clone());
        let event = ParameterEvent { stamp, node, changed_parameters, ..ParameterEvent::default() };
        let bytes = cdr::encode(&event);
        for events in self.sink.outputs.iter_mut().filter_map(|o| o.parameter_events.as_mut()) {
            log_failure(events.publish_cdr(&bytes));
        }
    }

    fn report(&mut self) {
        let Self { node, queue, sink, presence, .. } = self;
        let streams = node.streams();
        let counters = node.counters_mut();
        counters.published = sink.published;
        counters.unpublished = sink.unpublished;
        counters.dropped_from_queue = queue.dropped();
        counters.dropped_by_stream = queue.dropped_by_stream();
        counters.lost_in_transport = self.lost.load(Ordering::Relaxed);
        self.troubles.look(sink.clock.now(), counters.received, counters.dropped_from_queue);
        sink.report(presence, counters, streams);
    }
}

impl Sink<'_> {
    /// Observed frames for those who look, and as points where somebody wants them.
    fn show(&mut self, batch: &[Arrival]) {
        for onlooker in self.outputs.iter_mut().flat_map(|output| &mut output.onlookers) {
            for frame in batch.iter().filter_map(|(_, payload)| payload.view()) {
                onlooker.observed(&frame);
            }
        }
        for cloud in self.outputs.iter_mut().filter_map(|output| output.input_cloud.as_mut()) {
            for frame in batch.iter().filter_map(|(_, payload)| payload.view()) {
                cloud.show(&frame);
            }
        }
    }

    fn publish(&mut self, prediction: &Prediction<'_>, arrived: Duration) {
        let latency = self.clock.now() - arrived;
        prediction.status(latency, &self.digest, &mut self.status);
        cdr::encode_into(&self.status, &mut self.bytes);
        for output in self.outputs.iter_mut() {
            match output.prediction.as_mut().map(|to| to.publish_frame(prediction.frame)) {
                Some(Ok(())) => self.published += 1,
                Some(Err(error)) => {
                    tracing::warn!("{error}");
                    self.unpublished += 1;
                }
                None => {}
            }
            log_failure(output.status.publish_cdr(&self.bytes));
        }
        self.monitor.published(1, self.clock.now() - arrived);
        // Who waits for a prediction does not wait for its picture.
        for cloud in self.outputs.iter_mut().filter_map(|output| output.prediction_cloud.as_mut()) {
            cloud.show(&prediction.frame.into());
        }
        for onlooker in self.outputs.iter_mut().flat_map(|output| &mut output.onlookers) {
            onlooker.predicted(prediction);
        }
    }

    fn report(&mut self, presence: &Presence, counters: &Counters, streams: usize) {
        let now = self.clock.now();
        let rates = self.monitor.rates(now);
        for onlooker in self.outputs.iter_mut().flat_map(|output| &mut output.onlookers) {
            onlooker.reported(&rates, counters, streams);
        }
        // Diagnostics are named without the slash.
        let name = presence.name.trim_start_matches('/');
        let report = self.monitor.report(now, presence.time.stamp(), name, &self.digest, counters);
        let bytes = cdr::encode(&report);
        for diagnostics in self.outputs.iter_mut().filter_map(|o| o.diagnostics.as_mut()) {
            log_failure(diagnostics.publish_cdr(&bytes));
        }
    }
}

fn log_failure(outcome: Result<(), TransportError>) {
    if let Err(error) = outcome {
        tracing::warn!("{error}");
    }
}
