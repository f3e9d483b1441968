//! The loop of a running node: receives, predicts, publishes.
//!
//! A second thread receives into a [`FrameQueue`], so that the transport is read while the model works.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    thread,
    time::Duration,
};

use super::{
    FrameQueue, GroupMember, NodeHandle, Outputs, RosTime, SurrogateNode, running::Running,
    sink::OutputSink,
};
use eddy_frames::clock::Clock;
use eddy_inference::engine::ModelError;
use eddy_transport::{Link, Subscriber, TransportError};

/// Longest wait before the stop flag is checked.
pub(super) const MAX_WAIT: Duration = Duration::from_millis(100);
/// After the stop flag: how long messages that had already arrived are received, and predicted from.
const DRAIN_TIMEOUT: Duration = Duration::from_secs(1);

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
        let sink = OutputSink::new(outputs, clock, node, group);
        let mut running = Running::new(node, context, queue, &lost, sink);
        let mut end = Duration::MAX;
        while !receiver.is_finished() && clock.now() < end && running.check().is_ok() {
            running.step();
            if end == Duration::MAX && stop.load(Ordering::Relaxed) {
                end = clock.now() + DRAIN_TIMEOUT;
            }
            running.answer(handle);
            running.announce_transitions();
            running.report_if_due();
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
