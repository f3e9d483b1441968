//! `/rosout`: the log of a node as a topic of ROS, from which `rqt_console` reads.
//!
//! A layer of `tracing` turns events into messages and queues them; a thread publishes them, so that logging never waits for
//! a transport.

use std::{
    cell::Cell,
    fmt::{self, Write as _},
    io,
    sync::Arc,
    thread::{self, JoinHandle},
    time::Duration,
};

use tracing::{Event, Level, Subscriber, field::Field};
use tracing_subscriber::layer::{Context, Layer};

use eddy_frames::clock;
use eddy_messages::{
    Log, QosProfile, cdr,
    qos::{DurabilityPolicy, HistoryPolicy, ReliabilityPolicy},
};
use eddy_transport::{Publisher, Queue};

/// Name of the topic, before remapping.
pub const ROSOUT: &str = "/rosout";

/// Messages that are kept for late subscribers, and messages that may wait to be published: `rmw_qos_profile_rosout_default`.
const DEPTH: usize = 1_000;

/// Longest wait before the thread checks whether the log has ended.
const MAX_WAIT: Duration = Duration::from_secs(1);

/// What ROS 2 offers for `/rosout`, without its lifespan of ten seconds.
pub const ROSOUT_QOS: QosProfile = QosProfile {
    reliability: ReliabilityPolicy::Reliable,
    durability: DurabilityPolicy::TransientLocal,
    history: HistoryPolicy::KeepLast(DEPTH),
};

thread_local! {
    /// Whether this is the publishing thread: publishing its own events would never end.
    static PUBLISHES: Cell<bool> = const { Cell::new(false) };
}

/// The log of a node until it is published.
#[derive(Clone, Debug)]
pub struct Rosout {
    /// Name of the node's logger, such as `robot1.eddy_node`.
    logger: String,
    records: Arc<Queue<Log>>,
}

impl Rosout {
    /// An empty log.
    pub fn new(logger: String) -> Self {
        Self { logger, records: Arc::new(Queue::new(DEPTH)) }
    }

    /// Publishes the log so far, and from now on, on a thread of its own.
    ///
    /// # Errors
    /// When the thread cannot be started.
    pub fn publish(&self, mut publishers: Vec<Box<dyn Publisher>>) -> io::Result<RosoutPublisher> {
        let records = Arc::clone(&self.records);
        records.add_producer();
        let thread = thread::Builder::new().name("rosout".to_owned()).spawn(move || {
            PUBLISHES.set(true);
            while !records.is_ended() {
                let Some(record) = records.pop(MAX_WAIT) else { continue };
                let bytes = cdr::encode(&record);
                for publisher in &mut publishers {
                    if let Err(error) = publisher.publish_cdr(&bytes) {
                        tracing::debug!("{error}");
                    }
                }
            }
        })?;
        Ok(RosoutPublisher { records: Arc::clone(&self.records), thread: Some(thread) })
    }
}

/// Publishes the rest of the log when it is dropped.
#[must_use = "the log is published until it is dropped"]
pub struct RosoutPublisher {
    records: Arc<Queue<Log>>,
    thread: Option<JoinHandle<()>>,
}

impl Drop for RosoutPublisher {
    fn drop(&mut self) {
        self.records.remove_producer();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join(); // a panic has been reported
        }
    }
}

impl<S: Subscriber> Layer<S> for Rosout {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        if PUBLISHES.get() {
            return;
        }
        let metadata = event.metadata();
        let mut text = Text::default();
        event.record(&mut |field: &Field, value: &dyn fmt::Debug| text.add(field, value));
        self.records.push_or_drop_oldest(Log {
            stamp: clock::wall().into(),
            level: level(*metadata.level()),
            name: self.logger.clone(),
            msg: text.0,
            file: metadata.file().unwrap_or_default().to_owned(),
            function: metadata.target().to_owned(),
            line: metadata.line().unwrap_or_default(),
        });
    }
}

/// The number of a level in `rcl_interfaces/msg/Log`.
fn level(level: Level) -> u8 {
    match level {
        Level::TRACE | Level::DEBUG => 10,
        Level::INFO => 20,
        Level::WARN => 30,
        Level::ERROR => 40,
    }
}

/// The message of an event, followed by its other fields.
#[derive(Default)]
struct Text(String);

impl Text {
    fn add(&mut self, field: &Field, value: &dyn fmt::Debug) {
        // Writing into a string does not fail.
        let _ = match field.name() {
            "message" => {
                let rest = std::mem::take(&mut self.0);
                write!(self.0, "{value:?}{rest}")
            }
            name => write!(self.0, " {name}={value:?}"),
        };
    }
}

#[cfg(test)]
mod tests {
    use tracing_subscriber::layer::SubscriberExt as _;

    use super::*;
    use eddy_messages::Message as _;
    use eddy_transport::{Link, Reliability, TransportOptions, Transports};

    #[test]
    fn events_are_published_with_level_logger_and_place() {
        let transports = Transports::new(TransportOptions::new("rosout"));
        let link = Link::memory(ROSOUT);
        let mut subscriber = transports.subscriber(&link, Log::TYPE).unwrap();
        let rosout = Rosout::new("robot1.eddy_node".to_owned());
        let collector = tracing_subscriber::registry().with(rosout.clone());
        let publisher = transports.publisher(&link, Log::TYPE, Reliability::Drop).unwrap();
        tracing::subscriber::with_default(collector, || {
            tracing::warn!(frames = 3, "dropped");
            let publishing = rosout.publish(vec![publisher]).unwrap();
            tracing::info!("{} s", 1.5);
            drop(publishing);
        });
        let mut receive = || -> Log {
            let message = subscriber.receive(Duration::from_secs(60)).unwrap().unwrap();
            cdr::decode(&message.into_cdr()).unwrap()
        };
        let first = receive();
        assert_eq!((first.level, first.msg.as_str()), (30, "dropped frames=3"));
        assert_eq!(first.name, "robot1.eddy_node");
        assert!(first.file.ends_with("rosout.rs") && first.line > 0, "{first:?}");
        assert_eq!(first.function, module_path!());
        let second = receive();
        assert_eq!((second.level, second.msg.as_str()), (20, "1.5 s"));
    }
}
