//! The loop of `eddy tools`: receives frames and poses, publishes where tools are.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::Duration,
};

use eddy_frames::clock::Clock;
use eddy_messages::{Message, ParticleFrame, PoseStamped, TFMessage, cdr};
use eddy_transport::{Link, Payload, Producer, Queue, Subscriber, TransportError, Transports};

use super::{FollowCounts, FramePlace, ToolFollower, ToolTopics};
use crate::ros::RosNode;

/// Longest wait before the stop flag is checked.
const MAX_WAIT: Duration = Duration::from_millis(100);
/// Messages between the subscribers and the loop.
const QUEUE_MESSAGES: usize = 1024;

/// What arrives.
enum Event {
    Frame(FramePlace),
    Pose(Arc<str>, PoseStamped),
    Transforms(TFMessage, bool),
    /// A message that cannot be read, and why.
    Unreadable(String),
}

impl Event {
    fn reach(self, follower: &mut ToolFollower, now: Duration) {
        match self {
            Self::Frame(place) => follower.on_frame(place, now),
            Self::Pose(topic, pose) => follower.on_pose(&topic, &pose, now),
            Self::Transforms(tree, is_static) => follower.on_transforms(&tree, is_static, now),
            Self::Unreadable(reason) => follower.on_unreadable(&reason, now),
        }
    }
}

/// Makes an event of a message.
type Reader = Box<dyn Fn(Payload) -> Event + Send>;

/// What a follower of tools subscribes to.
pub struct ToolInputs {
    all: Vec<(Box<dyn Subscriber>, Reader)>,
}

impl ToolInputs {
    /// Subscribes to a topic of frames, and on its transport to the poses that a follower needs.
    ///
    /// # Errors
    /// [`TransportError`].
    pub fn open(
        transports: &Transports,
        frames: &Link,
        follower: &ToolFollower,
        ros: &RosNode,
    ) -> Result<Self, TransportError> {
        let mut inputs = Self::poses(transports, frames, follower, ros)?;
        let subscriber = transports.subscriber(frames, ParticleFrame::TYPE)?;
        inputs.all.push((subscriber, frame(frames)));
        Ok(inputs)
    }

    /// Subscribes to the poses that a follower needs, on the transport of a link.
    ///
    /// # Errors
    /// [`TransportError`].
    pub fn poses(
        transports: &Transports,
        beside: &Link,
        follower: &ToolFollower,
        ros: &RosNode,
    ) -> Result<Self, TransportError> {
        let mut all = Vec::new();
        for topic in follower.pose_topics() {
            let link = beside.with_topic(&topic);
            let topic: Arc<str> = topic.into();
            let read = of_cdr(&link, move |pose| Event::Pose(Arc::clone(&topic), pose));
            all.push((transports.subscriber(&link, PoseStamped::TYPE)?, read));
        }
        let trees = [("/tf", false), ("/tf_static", true)];
        for (topic, is_static) in trees.into_iter().filter(|_| follower.needs_transforms()) {
            let link = ros.link(&beside.with_topic(topic));
            let read = of_cdr(&link, move |tree| Event::Transforms(tree, is_static));
            all.push((transports.subscriber(&link, TFMessage::TYPE)?, read));
        }
        Ok(Self { all })
    }

    /// Gives a follower what has arrived, without waiting for more.
    ///
    /// # Errors
    /// [`TransportError`].
    pub fn drain(
        &mut self,
        follower: &mut ToolFollower,
        now: Duration,
    ) -> Result<(), TransportError> {
        for (subscriber, read) in &mut self.all {
            // A flood ends, too.
            for _ in 0..QUEUE_MESSAGES {
                let Some(payload) = subscriber.receive(Duration::ZERO)? else { break };
                read(payload).reach(follower, now);
            }
        }
        Ok(())
    }
}

/// Reads frames.
fn frame(link: &Link) -> Reader {
    let link = link.clone();
    Box::new(move |mut payload| match payload.decode() {
        Ok(()) => match payload.view() {
            Some(frame) => {
                let (stream, sequence, stamp) = (frame.stream, frame.sequence, frame.stamp);
                Event::Frame(FramePlace { stream, sequence, stamp })
            }
            None => Event::Unreadable(format!("{link}: found no frame, expected one")),
        },
        Err(error) => Event::Unreadable(format!("{link}: {error}")),
    })
}

/// Reads messages of a type.
fn of_cdr<M: Message>(link: &Link, event: impl Fn(M) -> Event + Send + 'static) -> Reader {
    let link = link.clone();
    Box::new(move |payload| match cdr::decode(&payload.into_cdr()) {
        Ok(message) => event(message),
        Err(error) => Event::Unreadable(format!("{link}: {error}")),
    })
}

/// Publishes where tools are until `stop` is raised, and for the frames that wait then what is known of them.
///
/// # Errors
/// [`TransportError`] when an input or an output fails.
pub fn follow(
    follower: &mut ToolFollower,
    inputs: &mut ToolInputs,
    topics: &mut ToolTopics,
    stop: &AtomicBool,
) -> Result<FollowCounts, TransportError> {
    let (clock, queue) = (Clock::start(), Arc::new(Queue::new(QUEUE_MESSAGES)));
    thread::scope(|scope| {
        let receivers: Vec<_> = inputs
            .all
            .iter_mut()
            .map(|(subscriber, read)| {
                let producer = queue.producer();
                scope.spawn(move || receive(subscriber.as_mut(), read, &producer))
            })
            .collect();
        let outcome = run(follower, topics, &queue, clock, stop);
        queue.close();
        for receiver in receivers {
            match receiver.join() {
                Ok(outcome) => outcome?,
                Err(panic) => std::panic::resume_unwind(panic),
            }
        }
        outcome
    })?;
    Ok(follower.counts())
}

/// Moves messages into the queue until it is closed; the first failure closes it.
fn receive(
    subscriber: &mut dyn Subscriber,
    read: &Reader,
    queue: &Producer<Event>,
) -> Result<(), TransportError> {
    while !queue.is_closed() {
        match subscriber.receive(MAX_WAIT) {
            Ok(Some(payload)) => {
                // A publisher that blocks waits with it; a closed queue ends the loop.
                let _ = queue.push_or_wait(read(payload), Duration::MAX);
            }
            Ok(None) => {}
            Err(error) => {
                queue.close();
                return Err(error);
            }
        }
    }
    Ok(())
}

fn run(
    follower: &mut ToolFollower,
    topics: &mut ToolTopics,
    queue: &Queue<Event>,
    clock: Clock,
    stop: &AtomicBool,
) -> Result<(), TransportError> {
    while !stop.load(Ordering::Relaxed) && !queue.is_closed() {
        let due = follower.next_due().map(|due| due.saturating_sub(clock.now()));
        let event = queue.pop(due.unwrap_or(MAX_WAIT).min(MAX_WAIT));
        let now = clock.now();
        if let Some(event) = event {
            event.reach(follower, now);
        }
        let frames = follower.due(now);
        publish(follower, topics, &frames)?;
    }
    let frames = follower.finish(clock.now());
    publish(follower, topics, &frames)?;
    topics.flush()
}

/// Publishes frames of tools, each after the description of its stream, and says what the user should know.
fn publish(
    follower: &mut ToolFollower,
    topics: &mut ToolTopics,
    frames: &[eddy_frames::tool::ToolFrame],
) -> Result<(), TransportError> {
    for frame in frames {
        if !topics.describes(frame.stream) {
            topics.describe(follower.tools(frame.stream))?;
        }
        topics.publish(frame)?;
    }
    for warning in follower.warnings() {
        tracing::warn!("{warning}");
    }
    Ok(())
}
