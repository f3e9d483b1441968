//! The time of a node: the system's, or with `use_sim_time` the time on `/clock`.
//!
//! Simulated time determines
//! - when the next frame of a free run is due: one interval of simulated time after the last, so that free runs keep the
//!   pace of the simulation and pause with it;
//! - the stamps of `/diagnostics` and of parameter events.
//!
//! Stamps of predictions and their status are simulation time in any case. Latencies, rates and the interval of
//! diagnostics are always system time.
//!
//! As in ROS, simulated time is 0 until the first message on `/clock` and constant between two messages. After a jump
//! back (a looped bag), pending timers keep their remaining time.

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

/// Longest wait before the stop flag is checked.
const MAX_WAIT: Duration = Duration::from_millis(100);

/// Subscribes to `/clock`.
pub type OpenClock = Box<dyn FnMut() -> Result<Box<dyn Subscriber>, TransportError> + Send>;

/// The time of a node.
pub struct RosTime {
    open: Option<OpenClock>,
    simulated: Option<Simulated>,
}

impl RosTime {
    /// System time, until [`RosTime::use_simulated`].
    pub fn new(open: OpenClock) -> Self {
        Self { open: Some(open), simulated: None }
    }

    /// System time always.
    pub fn system() -> Self {
        Self { open: None, simulated: None }
    }

    /// Whether it is the time on `/clock`.
    pub fn is_simulated(&self) -> bool {
        self.simulated.is_some()
    }

    /// Switches to the time on `/clock`, or back. Returns whether this is a change.
    ///
    /// # Errors
    /// [`TransportError`] when `/clock` cannot be subscribed to; then system time stays in use.
    pub fn use_simulated(&mut self, simulated: bool) -> Result<bool, TransportError> {
        if simulated == self.is_simulated() {
            return Ok(false);
        }
        let open = self.open.as_mut().filter(|_| simulated);
        self.simulated = open.map(|open| open().map(Simulated::listen)).transpose()?;
        Ok(simulated == self.is_simulated())
    }

    /// Time since zero; `machine` is system time since any fixed moment.
    pub fn now(&self, machine: Duration) -> Duration {
        let since_zero = |Stamp(time)| Duration::from_nanos(u64::try_from(time).unwrap_or(0));
        self.simulated.as_ref().map_or(machine, |simulated| since_zero(simulated.now()))
    }

    /// The time as a stamp.
    pub fn stamp(&self) -> Stamp {
        self.simulated.as_ref().map_or_else(clock::wall, Simulated::now)
    }
}

/// The latest time on `/clock`, received by a thread of its own.
struct Simulated {
    latest: Arc<AtomicI64>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Simulated {
    fn listen(mut clock: Box<dyn Subscriber>) -> Self {
        let (latest, stop) = (Arc::<AtomicI64>::default(), Arc::<AtomicBool>::default());
        let (latest_received, stopped) = (Arc::clone(&latest), Arc::clone(&stop));
        let thread = thread::spawn(move || {
            while !stopped.load(Ordering::Relaxed) {
                match clock.receive(MAX_WAIT) {
                    Ok(None) => {}
                    Ok(Some(payload)) => match cdr::decode::<Clock>(&payload.into_cdr()) {
                        Ok(message) => {
                            latest_received.store(Stamp::from(message.clock).0, Ordering::Relaxed)
                        }
                        Err(error) => tracing::warn!("/clock: {error}"),
                    },
                    Err(error) => {
                        tracing::error!("simulated time stopped: {error}");
                        return;
                    }
                }
            }
        });
        Self { latest, stop, thread: Some(thread) }
    }

    fn now(&self) -> Stamp {
        Stamp(self.latest.load(Ordering::Relaxed))
    }
}

impl Drop for Simulated {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join(); // a panic has been reported
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

    fn publish(clock: &mut dyn Publisher, time: &RosTime, seconds: f64) {
        let stamp = Stamp::from_seconds(seconds);
        clock.publish_cdr(&cdr::encode(&Clock { clock: stamp.into() })).unwrap();
        let waiting = clock::Clock::start();
        while time.stamp() != stamp {
            assert!(waiting.now() < Duration::from_secs(30), "the time never arrives");
            thread::yield_now();
        }
    }

    #[test]
    fn simulated_time_is_zero_before_the_first_message_and_constant_between_messages() {
        let (mut clock, mut time) = publisher_and_time();
        let machine = Duration::from_secs(7);
        assert_eq!(time.now(machine), machine);
        assert!(time.use_simulated(true).unwrap() && !time.use_simulated(true).unwrap());
        assert_eq!((time.now(machine), time.stamp()), (Duration::ZERO, Stamp(0)));
        publish(&mut *clock, &time, 2.5);
        assert_eq!(time.now(machine), Duration::from_millis(2_500));
        assert_eq!(time.now(machine * 2), Duration::from_millis(2_500));
        publish(&mut *clock, &time, 1.0);
        assert_eq!(time.now(machine), Duration::from_secs(1));
        assert!(time.use_simulated(false).unwrap());
        assert_eq!(time.now(machine), machine);
        assert_eq!(clock.subscribers(), 0, "the subscription has ended");
    }

    #[test]
    fn invalid_clock_messages_are_ignored() {
        let (mut clock, mut time) = publisher_and_time();
        time.use_simulated(true).unwrap();
        clock.publish_cdr(&[1, 2, 3]).unwrap();
        publish(&mut *clock, &time, 3.0);
    }
}
