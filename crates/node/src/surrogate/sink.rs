//! The publishing side of a running node.

use std::time::Duration;

use super::{
    Arrival, GroupMember, NodeContext, NodeReport, Outputs, Prediction, SurrogateNode,
    diagnostics::Monitor, failures::Failures,
};
use eddy_frames::clock::Clock;
use eddy_messages::{PredictionStatus, cdr};
use eddy_transport::{Publisher, TransportError};

/// The publishing side of a running node.
pub(super) struct OutputSink<'a> {
    outputs: &'a mut [Outputs],
    pub(super) clock: Clock,
    pub(super) monitor: Monitor,
    /// Digest of the model.
    digest: String,
    /// Buffers that are reused for every prediction.
    status: PredictionStatus,
    bytes: Vec<u8>,
    pub(super) published: u64,
    pub(super) unpublished: u64,
    pub(super) group: Option<&'a GroupMember>,
    pub(super) withheld: u64,
    failures: Failures,
}

impl<'a> OutputSink<'a> {
    /// Publishes what `node` predicts, as a member of `group`, if it is in one.
    pub(super) fn new(
        outputs: &'a mut [Outputs],
        clock: Clock,
        node: &SurrogateNode,
        group: Option<&'a GroupMember>,
    ) -> Self {
        let counters = node.counters();
        Self {
            outputs,
            clock,
            monitor: Monitor::start(clock.now()),
            digest: node.surrogate().digest().to_owned(),
            status: PredictionStatus::default(),
            bytes: Vec::new(),
            published: counters.published,
            unpublished: counters.unpublished,
            group,
            withheld: 0,
            failures: Failures::default(),
        }
    }

    /// Passes observed frames to observers and point clouds.
    pub(super) fn show_observed(&mut self, batch: &[Arrival]) {
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

    pub(super) fn publish(&mut self, prediction: &Prediction<'_>, arrived: Duration) {
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

    /// Publishes an encoded event on the topics that `topic` picks.
    pub(super) fn publish_event(
        &mut self,
        event: &[u8],
        topic: impl Fn(&mut Outputs) -> Option<&mut (dyn Publisher + 'static)>,
    ) {
        for events in self.outputs.iter_mut().filter_map(topic) {
            self.failures.log(self.clock.now(), events.publish_cdr(event));
        }
    }

    /// Waits until subscribers have the predictions.
    pub(super) fn flush(&mut self) {
        for output in self.outputs.iter_mut() {
            for publisher in output.prediction.iter_mut().chain([&mut output.status]) {
                match publisher.flush() {
                    Err(error @ TransportError::Undelivered { messages, .. }) => {
                        tracing::warn!("{error}");
                        self.unpublished += messages;
                    }
                    outcome => self.failures.log(self.clock.now(), outcome),
                }
            }
        }
    }

    /// Passes counts and rates to observers, and publishes them as diagnostics.
    pub(super) fn report(
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
        self.publish_event(&cdr::encode(&report), |outputs| outputs.diagnostics.as_deref_mut());
    }
}
