//! What time it is for a node: the machine's, or with `use_sim_time` that of `/clock`.
//!
//! Simulated time changes what a node does *when*, and what it stamps with *now*:
//! - free runs: the next frame is due an interval after the last one of simulated time, so that they go at the
//!   pace of the simulation and pause with it;
//! - the stamps of `/diagnostics` and of parameter events.
//!
//! It does not change what a stamp says about the simulation already (predictions and their status), nor
//! what is about this machine: latencies, rates, and that diagnostics come once a second even if
//! the simulation is paused.
//!
//! As in ROS, it is 0 until the first message on `/clock`, and stands still between two messages. When
//! it jumps back (a looped bag) what was due in so much time is due in so much time from then.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicI64, Ordering},
    },
    thread::{self, JoinHandle},
    time::Duration,
};

use eddy_frames::{Stamp, clock};
use eddy_messages::{Clock, cdr};
use eddy_transport::{Subscriber, TransportError};

/// How long a wait for a message may last before the end is looked for.
const PATIENCE: Duration = Duration::from_millis(100);

/// Subscribes to `/clock`.
pub type OpenClock = Box<dyn FnMut() -> Result<Box<dyn Subscriber>, TransportError> + Send>;

/// The time of a node.
pub struct RosTime {
    open: Option<OpenClock>,
    simulated: Option<Simulated>,
}

impl RosTime {
    /// The time of the machine, until [`RosTime::follow`] says otherwise.
    pub fn new(open: OpenClock) -> Self {
        Self { open: Some(open), simulated: None }
    }

    /// The time of the machine, whatever is asked for.
    pub fn of_the_machine() -> Self {
        Self { open: None, simulated: None }
    }

    /// Whether it is that of `/clock`.
    pub fn is_simulated(&self) -> bool {
        self.simulated.is_some()
    }

    /// Follows `/clock`, or no more. Returns whether that is a change.
    ///
    /// # Errors
    /// [`TransportError`] when `/clock` cannot be subscribed to; then the time stays that of the machine.
    pub fn follow(&mut self, simulated: bool) -> Result<bool, TransportError> {
        if simulated == self.is_simulated() {
            return Ok(false);
        }
        let open = self.open.as_mut().filter(|_| simulated);
        self.simulated = open.map(|open| open().map(Simulated::listen)).transpose()?;
        Ok(simulated == self.is_simulated())
    }

    /// The time since its zero; `machine` is that of the machine, since any moment.
    pub fn now(&self, machine: Duration) -> Duration {
        let since_zero = |Stamp(time)| Duration::from_nanos(u64::try_from(time).unwrap_or(0));
        self.simulated.as_ref().map_or(machine, |simulated| since_zero(simulated.now()))
    }

    /// The time as a stamp.
    pub fn stamp(&self) -> Stamp {
        self.simulated.as_ref().map_or_else(clock::wall, Simulated::now)
    }
}

/// The newest time on `/clock`, read by a thread of its own.
struct Simulated {
    newest: Arc<AtomicI64>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Simulated {
    fn listen(mut clock: Box<dyn Subscriber>) -> Self {
        let (newest, stop) = (Arc::<AtomicI64>::default(), Arc::<AtomicBool>::default());
        let (told, stopped) = (Arc::clone(&newest), Arc::clone(&stop));
        let thread = thread::spawn(move || {
            while !stopped.load(Ordering::Relaxed) {
                match clock.receive(PATIENCE) {
                    Ok(None) => {}
                    Ok(Some(payload)) => match cdr::decode::<Clock>(&payload.into_cdr()) {
                        Ok(message) => told.store(Stamp::from(message.clock).0, Ordering::Relaxed),
                        Err(error) => tracing::warn!("/clock: {error}"),
                    },
                    Err(error) => {
                        tracing::error!("simulated time stands still: {error}");
                        return;
                    }
                }
            }
        });
        Self { newest, stop, thread: Some(thread) }
    }

    fn now(&self) -> Stamp {
        Stamp(self.newest.load(Ordering::Relaxed))
    }
}

impl Drop for Simulated {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // It panics nowhere, and if it did, the time would have stood still.
            let _ = thread.join();
        }
    }
}

#[cfg(test)]
mod tests {

    use super::*;
    use eddy_messages::Message;
    use eddy_transport::{Link, Publisher, Reliability, TransportOptions, Transports};

    fn publisher_and_time() -> (Box<dyn Publisher>, RosTime) {
        let (transports, link) =
            (Transports::new(TransportOptions::new("test")), Link::memory("/clock"));
        let publisher = transports.publisher(&link, Clock::TYPE, Reliability::Block).unwrap();
        let open = move || transports.subscriber(&link, Clock::TYPE);
        (publisher, RosTime::new(Box::new(open)))
    }

    fn tell(clock: &mut dyn Publisher, time: &RosTime, seconds: f64) {
        let stamp = Stamp::from_seconds(seconds);
        clock.publish_cdr(&cdr::encode(&Clock { clock: stamp.into() })).unwrap();
        let waiting = clock::Clock::start();
        while time.stamp() != stamp {
            assert!(waiting.now() < Duration::from_secs(30), "the time is never told");
            thread::yield_now();
        }
    }

    #[test]
    fn simulated_time_is_zero_until_it_is_told_and_stands_still_in_between() {
        let (mut clock, mut time) = publisher_and_time();
        let machine = Duration::from_secs(7);
        assert_eq!(time.now(machine), machine);
        assert!(time.follow(true).unwrap() && !time.follow(true).unwrap());
        assert_eq!((time.now(machine), time.stamp()), (Duration::ZERO, Stamp(0)));
        tell(&mut *clock, &time, 2.5);
        assert_eq!(time.now(machine), Duration::from_millis(2_500));
        assert_eq!(time.now(machine * 2), Duration::from_millis(2_500));
        tell(&mut *clock, &time, 1.0);
        assert_eq!(time.now(machine), Duration::from_secs(1));
        assert!(time.follow(false).unwrap());
        assert_eq!(time.now(machine), machine);
        assert_eq!(clock.subscribers(), 0, "nobody listens any more");
    }

    #[test]
    fn bytes_that_are_no_time_change_nothing() {
        let (mut clock, mut time) = publisher_and_time();
        time.follow(true).unwrap();
        clock.publish_cdr(&[1, 2, 3]).unwrap();
        tell(&mut *clock, &time, 3.0);
    }
}
