//! Connects a [`SurrogateNode`] with its topics.

use std::{
    sync::atomic::{AtomicBool, Ordering},
    thread,
    time::Duration,
};

use super::{
    FrameQueue, Prediction, SurrogateNode,
    clock::{self, Clock},
    diagnostics::Monitor,
};
use crate::{
    msg::cdr,
    transport::{Publisher, Subscriber, TransportError},
};

/// How long a wait may last before the stop flag is looked at.
const PATIENCE: Duration = Duration::from_millis(100);
/// Time between two diagnostics.
const DIAGNOSTICS_INTERVAL: Duration = Duration::from_secs(1);

/// The topics that one link of a node publishes on.
pub struct Outputs {
    /// Predicted frames.
    pub prediction: Box<dyn Publisher>,
    /// How each prediction came to be.
    pub status: Box<dyn Publisher>,
    /// The state of the node, once a second.
    pub diagnostics: Box<dyn Publisher>,
}

/// Receives, predicts and publishes until `stop` is raised; then predicts what has arrived by then.
///
/// # Errors
/// [`TransportError`] when the input fails. An output that fails is logged, and the node goes on.
pub fn drive(
    node: &mut SurrogateNode,
    name: &str,
    input: &mut dyn Subscriber,
    outputs: &mut [Outputs],
    queue: &FrameQueue,
    stop: &AtomicBool,
) -> Result<(), TransportError> {
    let clock = Clock::start();
    thread::scope(|scope| {
        let receiver = scope.spawn(|| {
            let outcome = receive(input, queue, &clock, stop);
            queue.close();
            outcome
        });
        let mut loop_ = Loop { node, name, outputs, clock, monitor: Monitor::start(clock.now()) };
        let mut reported = clock.now();
        while !receiver.is_finished() {
            loop_.step(queue);
            if clock.now() - reported >= DIAGNOSTICS_INTERVAL {
                reported = clock.now();
                loop_.report(queue);
            }
        }
        while loop_.step(queue) {}
        loop_.report(queue);
        match receiver.join() {
            Ok(outcome) => outcome,
            Err(panic) => std::panic::resume_unwind(panic),
        }
    })
}

/// Fills the queue until `stop` is raised.
fn receive(
    input: &mut dyn Subscriber,
    queue: &FrameQueue,
    clock: &Clock,
    stop: &AtomicBool,
) -> Result<(), TransportError> {
    while !stop.load(Ordering::Relaxed) {
        if let Some(payload) = input.receive(PATIENCE)?
            && !queue.push(clock.now(), payload)
        {
            break;
        }
    }
    Ok(())
}

struct Loop<'a> {
    node: &'a mut SurrogateNode,
    name: &'a str,
    outputs: &'a mut [Outputs],
    clock: Clock,
    monitor: Monitor,
}

impl Loop<'_> {
    /// Predicts from one message or one tick. Returns whether there was a message.
    fn step(&mut self, queue: &FrameQueue) -> bool {
        let now = self.clock.now();
        let until_tick = self.node.next_tick().map(|due| due.saturating_sub(now));
        let message = queue.pop(until_tick.unwrap_or(PATIENCE).min(PATIENCE));
        let had_message = message.is_some();
        if let Some((arrived, payload)) = message {
            match self.node.on_frame(payload.into_frame(), arrived) {
                Ok(predictions) => self.publish(&predictions, arrived),
                Err(refusal) => {
                    tracing::debug!("frame refused: {refusal}");
                    self.monitor.refused(refusal.to_string());
                }
            }
        }
        let now = self.clock.now();
        let due = self.node.on_tick(now);
        self.publish(&due, now);
        had_message
    }

    fn publish(&mut self, predictions: &[Prediction], arrived: Duration) {
        if predictions.is_empty() {
            return;
        }
        let digest = self.node.surrogate().digest();
        for prediction in predictions {
            for output in self.outputs.iter_mut() {
                log_failure(output.prediction.publish_frame(&prediction.frame));
                let status = prediction.status(self.clock.now() - arrived, digest);
                log_failure(output.status.publish_cdr(&cdr::encode(&status)));
            }
        }
        let count = predictions.len() as u64;
        self.node.counters_mut().published += count;
        self.monitor.published(count, self.clock.now() - arrived);
    }

    fn report(&mut self, queue: &FrameQueue) {
        self.node.counters_mut().dropped_from_queue = queue.dropped();
        let digest = self.node.surrogate().digest().to_owned();
        let report = self.monitor.report(
            self.clock.now(),
            clock::wall(),
            self.name,
            &digest,
            self.node.counters(),
        );
        let bytes = cdr::encode(&report);
        for output in self.outputs.iter_mut() {
            log_failure(output.diagnostics.publish_cdr(&bytes));
        }
    }
}

fn log_failure(outcome: Result<(), TransportError>) {
    if let Err(error) = outcome {
        tracing::warn!("{error}");
    }
}
