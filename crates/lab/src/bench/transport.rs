//! Latency from publisher to subscriber, compared with the middleware alone.

use std::{
    sync::{
        atomic::{AtomicBool, Ordering},
        mpsc,
    },
    thread,
    time::Duration,
};

use serde::Serialize;

use super::particles;
use eddy_frames::{Frame, clock::Clock};
use eddy_messages::{FrameCdr, Message, ParticleFrame};
use eddy_transport::{
    BarePublisher, BareSubscriber, Link, Publisher, Reliability, Subscriber, TransportError,
    TransportKind, TransportOptions, Transports,
};

/// Timeout of discovery and of a message.
const TIMEOUT: Duration = Duration::from_secs(10);
/// Timeout of a receive call, after which the end of the measurement is checked.
const POLL_TIMEOUT: Duration = Duration::from_millis(50);
/// Pause between messages, after which a waiting subscriber sleeps.
const PAUSE: Duration = Duration::from_millis(1);
/// Untimed warm-up messages of each kind.
const WARM_UP: usize = 20;
/// Maximum size of a burst (bytes), but at least ten messages.
const MAX_BURST: usize = 1 << 28;
/// Silence after which a burst is over.
const SILENCE: Duration = Duration::from_secs(2);

/// How messages are sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Way {
    /// eddy's publisher and subscriber, serialising a frame.
    Frame,
    /// eddy's publisher and subscriber, with serialised bytes.
    Bytes,
    /// The middleware alone, with the same bytes.
    Bare,
    /// eddy's publisher and subscriber, sending unmodified shared memory.
    Untouched,
    /// The middleware alone, sending unmodified shared memory.
    BareUntouched,
}

/// Latency and throughput of messages.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Timing {
    /// The transport.
    pub transport: &'static str,
    /// How they were sent.
    pub way: Way,
    /// Particles of a frame.
    pub particles: usize,
    /// Median time from before publishing to reception (µs).
    pub p50: f64,
    /// 99th percentile (µs).
    pub p99: f64,
    /// Messages timed.
    pub messages: usize,
    /// Messages then published at full speed.
    pub burst: usize,
    /// Messages of the burst that arrived.
    pub arrived: usize,
    /// Rate of their arrival (bytes/s).
    pub rate: f64,
}

/// Publisher and subscriber of one way.
struct Ends {
    way: Way,
    publish: Publish,
    receive: Receive,
    /// Kept open during the measurement.
    opened: [Transports; 2],
}

/// Times `messages` messages of each way, in turns. Empty if the transport does not support messages of this size.
///
/// # Errors
/// [`TransportError`] when a middleware cannot be opened or fails.
#[expect(clippy::too_many_lines, reason = "one measurement from start to end")]
pub fn time(
    transport: TransportKind,
    particles: usize,
    messages: usize,
) -> Result<Vec<Timing>, TransportError> {
    let clock = Clock::start();
    let frame = particles::frame(particles);
    let mut timings = Vec::new();
    let (mut all, mut open, mut bursts) = (Vec::new(), Vec::new(), Vec::new());
    let size = frame.to_cdr().len();
    let count = (MAX_BURST / size).clamp(10, messages.max(10));
    let ends = ends(transport, &frame)?;
    let stop = &AtomicBool::new(false);
    thread::scope(|scope| -> Result<(), TransportError> {
        let _stopping = Stopping(stop);
        for Ends { way, publish, mut receive, opened } in ends {
            let (sender, arrivals) = mpsc::channel();
            scope.spawn(move || {
                while !stop.load(Ordering::Relaxed) {
                    match receive(POLL_TIMEOUT) {
                        Ok(false) => {}
                        Ok(true) => drop(sender.send(Ok(clock.now()))),
                        Err(error) => return drop(sender.send(Err(error))),
                    }
                }
            });
            all.push((way, publish, arrivals, Vec::with_capacity(messages)));
            open.push(opened);
        }
        for (_, publish, arrivals, _) in &mut all {
            if !meet(publish, arrivals, &clock)? {
                return Ok(());
            }
        }
        for number in 0..WARM_UP + messages {
            for (_, publish, arrivals, times) in &mut all {
                thread::sleep(PAUSE);
                // Discard late arrivals of the last round.
                while arrivals.try_recv().is_ok() {}
                let sent = clock.now();
                publish()?;
                let Ok(arrived) = arrivals.recv_timeout(TIMEOUT) else { continue };
                if number >= WARM_UP {
                    times.push(arrived?.saturating_sub(sent));
                }
            }
        }
        for (_, publish, arrivals, _) in &mut all {
            bursts.push(burst(publish, arrivals, &clock, count)?);
        }
        Ok(())
    })?;
    for ((way, _, _, mut times), (arrived, seconds)) in all.into_iter().zip(bursts) {
        times.sort_unstable();
        let at = |percent: usize| times[(times.len() - 1) * percent / 100].as_secs_f64() * 1e6;
        if !times.is_empty() {
            timings.push(Timing {
                transport: transport.name(),
                way,
                particles,
                p50: at(50),
                p99: at(99),
                messages: times.len(),
                burst: count,
                arrived,
                rate: (arrived * size) as f64 / seconds,
            });
        }
    }
    Ok(timings)
}

/// Stops the receiving threads when dropped.
pub(super) struct Stopping<'a>(pub(super) &'a AtomicBool);

impl Drop for Stopping<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

type Publish = Box<dyn FnMut() -> Result<(), TransportError> + Send>;
type Arrivals = mpsc::Receiver<Result<Duration, TransportError>>;

/// Publishes until a message arrives, then drains the others. False if messages are too large.
fn meet(publish: &mut Publish, arrivals: &Arrivals, clock: &Clock) -> Result<bool, TransportError> {
    let end = clock.now() + TIMEOUT;
    let mut found = false;
    while !found && clock.now() < end {
        match publish() {
            Err(TransportError::TooLarge { .. }) => return Ok(false),
            outcome => outcome?,
        }
        found = arrivals.recv_timeout(POLL_TIMEOUT).is_ok();
    }
    while arrivals.recv_timeout(2 * POLL_TIMEOUT).is_ok() {}
    Ok(found)
}

/// Publishes `count` messages at full speed; returns the number that arrived and the time (s).
fn burst(
    publish: &mut Publish,
    arrivals: &Arrivals,
    clock: &Clock,
    count: usize,
) -> Result<(usize, f64), TransportError> {
    let begin = clock.now();
    for _ in 0..count {
        publish()?;
    }
    let (mut arrived, mut last) = (0, begin);
    while arrived < count
        && let Ok(arrival) = arrivals.recv_timeout(SILENCE)
    {
        last = arrival?;
        arrived += 1;
    }
    Ok((arrived, (last - begin).as_secs_f64()))
}

/// Publishers and subscribers for every way of a transport.
fn ends(kind: TransportKind, frame: &Frame) -> Result<Vec<Ends>, TransportError> {
    let mut ends = Vec::new();
    for way in [Way::Frame, Way::Bytes, Way::Bare, Way::Untouched, Way::BareUntouched] {
        let word = serde_json::to_string(&way).unwrap_or_default();
        let word: String = word.chars().filter(|c| c.is_ascii_alphabetic()).collect();
        let topic = format!("/bench_{}/{word}", std::process::id());
        let link = Link { transport: kind, topic };
        let node = |name| Transports::new(TransportOptions::new(name));
        let (here, there) = (node("eddy_bench"), node("eddy_bench_reader"));
        let shared = kind == TransportKind::Shm;
        let (publish, receive) = match way {
            Way::Bytes if shared => continue,
            Way::Untouched | Way::BareUntouched if !shared => continue,
            Way::Bare | Way::BareUntouched => {
                let Some((publisher, subscriber)) = here.bare(&link, frame, way == Way::Bare)?
                else {
                    continue;
                };
                (bare_publisher(publisher), bare_subscriber(subscriber))
            }
            Way::Frame | Way::Bytes | Way::Untouched => {
                let subscriber = there.subscriber(&link, ParticleFrame::TYPE)?;
                let publish = if way == Way::Untouched {
                    let Some(publisher) = here.untouched(&link, frame.len())? else { continue };
                    bare_publisher(publisher)
                } else {
                    let publisher =
                        here.publisher(&link, ParticleFrame::TYPE, Reliability::Block)?;
                    eddy_publisher(publisher, frame, way == Way::Bytes)
                };
                (publish, eddy_subscriber(subscriber))
            }
        };
        ends.push(Ends { way, publish, receive, opened: [here, there] });
    }
    Ok(ends)
}

fn bare_publisher(mut publisher: Box<dyn BarePublisher>) -> Publish {
    Box::new(move || publisher.publish())
}

fn eddy_publisher(mut publisher: Box<dyn Publisher>, frame: &Frame, encoded: bool) -> Publish {
    let (frame, bytes) = (frame.clone(), frame.to_cdr());
    Box::new(move || match encoded {
        true => publisher.publish_cdr(&bytes),
        false => publisher.publish_frame(&frame),
    })
}

type Receive = Box<dyn FnMut(Duration) -> Result<bool, TransportError> + Send>;

fn bare_subscriber(mut subscriber: Box<dyn BareSubscriber>) -> Receive {
    Box::new(move |timeout| subscriber.receive(timeout))
}

fn eddy_subscriber(mut subscriber: Box<dyn Subscriber>) -> Receive {
    Box::new(move |timeout| Ok(subscriber.receive(timeout)?.is_some()))
}
