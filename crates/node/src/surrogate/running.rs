//! The predicting side of a running node.

use std::{
    sync::atomic::{AtomicU64, Ordering},
    time::Duration,
};

use super::{
    Arrival, FrameQueue, GroupMember, InvalidSettings, LifecycleTransition, NodeContext,
    NodeHandle, Rejected, Rejection, SurrogateNode, driver::MAX_WAIT, group::Epoch, load::Load,
    sink::OutputSink, warnings::Warnings,
};
use eddy_frames::clock;
use eddy_inference::engine::ModelError;
use eddy_messages::{
    ParameterEvent, cdr,
    lifecycle::{TransitionDescription, TransitionEvent},
};

/// Longest wait during a free run on simulated time, which may advance at any moment.
const MAX_SIMULATED_WAIT: Duration = Duration::from_millis(2);
const DIAGNOSTICS_INTERVAL: Duration = Duration::from_secs(1);

/// The predicting side of a running node.
pub(super) struct Running<'a> {
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
    sink: OutputSink<'a>,
    warnings: Warnings,
    load: Load,
    /// Time that the model has taken since the last report.
    busy: Duration,
    /// Time of the last report.
    reported: Duration,
}

impl<'a> Running<'a> {
    /// Before the first step. `lost` is the number of messages that the transport has dropped.
    pub(super) fn new(
        node: &'a mut SurrogateNode,
        context: &'a mut NodeContext,
        queue: &'a FrameQueue,
        lost: &'a AtomicU64,
        sink: OutputSink<'a>,
    ) -> Self {
        let now = sink.clock.now();
        Self {
            time: context.time.now(now),
            batch: Vec::with_capacity(node.batch_size()),
            node,
            context,
            queue,
            lost,
            epoch: Epoch::default(),
            sink,
            warnings: Warnings::default(),
            load: Load::default(),
            busy: Duration::ZERO,
            reported: now,
        }
    }

    /// Checks that the device that predicts has not failed.
    pub(super) fn check(&self) -> Result<(), ModelError> {
        self.node.check()
    }

    /// Predicts from waiting messages, one of each stream, then advances free runs. Returns whether there was a message.
    pub(super) fn step(&mut self) -> bool {
        let timeout = self.until_tick().min(MAX_WAIT);
        self.queue.pop_batch(timeout, self.node.batch_size(), &mut self.batch);
        let had_message = !self.batch.is_empty();
        self.follow_group();
        let simulated = self.context.time.is_simulated().then(|| self.now());
        let Self { node, batch, sink, busy, .. } = self;
        let started = sink.clock.now();
        node.on_frames(batch, simulated, &mut |arrived, outcome| match outcome {
            Ok(prediction) => sink.publish(&prediction, arrived),
            // Ignoring the input is the purpose of a free run.
            Err(Rejected { reason: Rejection::FreeRunning { .. }, .. }) => {}
            Err(rejected) => {
                tracing::debug!("frame rejected: {rejected}");
                sink.monitor.rejected(rejected.to_string());
            }
        });
        *busy += sink.clock.now() - started;
        if node.is_active() {
            sink.show_observed(batch);
        }
        // Returns loaned samples to the transport.
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

    /// Forgets streams and waiting messages that another member of the group owns.
    fn follow_group(&mut self) {
        let Self { node, batch, sink, epoch, .. } = self;
        let Some(group) = sink.group else { return };
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
        let now = self.context.time.now(self.sink.clock.now());
        if now < self.time || self.time.is_zero() {
            self.node.shift_time(self.time, now);
        }
        self.time = now;
        now
    }

    /// Answers requests, and publishes changed parameters on `/parameter_events`. `use_sim_time` switches the clock.
    pub(super) fn answer(&mut self, handle: &NodeHandle) {
        let mut before = self.now();
        let Self { node, context, time, sink, .. } = self;
        let changed_parameters = handle.serve(node, |node, settings| {
            let change = context.time.use_simulated(settings.use_sim_time);
            if change.map_err(|error| InvalidSettings::Clock { reason: error.to_string() })? {
                *time = context.time.now(sink.clock.now());
                node.shift_time(before, *time);
                before = *time;
            }
            Ok(())
        });
        if changed_parameters.is_empty() {
            return;
        }
        let (stamp, node) = (context.time.stamp().into(), context.name.clone());
        let event = ParameterEvent { stamp, node, changed_parameters, ..ParameterEvent::default() };
        sink.publish_event(&cdr::encode(&event), |outputs| outputs.parameter_events.as_deref_mut());
    }

    /// Publishes the transitions of a managed node.
    pub(super) fn announce_transitions(&mut self) {
        for transition in self.node.take_transitions() {
            let LifecycleTransition { start, goal, .. } = transition;
            tracing::info!("{} -> {}", start.label(), goal.label());
            if self.node.is_active() {
                self.warnings.waiting_since = self.sink.clock.now();
            }
            let TransitionDescription { transition, start_state, goal_state } =
                (&transition).into();
            let timestamp = clock::wall().0.unsigned_abs();
            let event = TransitionEvent { timestamp, transition, start_state, goal_state };
            let event = cdr::encode(&event);
            self.sink.publish_event(&event, |outputs| outputs.transition_events.as_deref_mut());
        }
    }

    /// Waits until subscribers have what was published, reports for the last time and says what was lost.
    pub(super) fn finish(&mut self) {
        if let Some(group) = self.sink.group {
            group.leave();
        }
        self.sink.flush();
        self.report();
        let lost = self.sink.unpublished;
        if lost > 0 {
            tracing::warn!("{lost} messages were not delivered to all subscribers");
        }
    }

    /// Reports once a second.
    pub(super) fn report_if_due(&mut self) {
        if self.sink.clock.now() - self.reported >= DIAGNOSTICS_INTERVAL {
            self.report();
        }
    }

    fn report(&mut self) {
        let Self { node, queue, sink, context, .. } = self;
        let (streams, is_active) = (node.streams(), node.is_active());
        let idle = node.lifecycle().filter(|_| !is_active);
        let (horizon, threads) = (node.settings().horizon, node.threads());
        let limit = node.settings().max_expected_error;
        let counters = node.counters_mut();
        counters.published = sink.published;
        counters.unpublished = sink.unpublished;
        counters.withheld = sink.withheld;
        counters.of_other_members = sink.group.map_or(0, GroupMember::foreign_frames);
        counters.group = sink.group.map(|group| group.counts(streams));
        counters.lost_in_queue = queue.dropped();
        counters.dropped_by_stream = queue.dropped_by_stream();
        counters.lost_in_transport = self.lost.load(Ordering::Relaxed);
        let (now, last) = (sink.clock.now(), self.load);
        let (received, dropped) = (counters.received, counters.lost_in_queue);
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
            Some(state) => sink.monitor.idle(state.label()),
            None => self.warnings.check(now, &context.input, &self.load),
        }
        node.log_rejections(now);
        sink.report(context, node, since, limit);
    }
}
