//! The transports, end to end: one suite for all, then tests of each.
//!
//! Every test has topics, ports and a DDS domain of its own, so that tests can run in parallel, and beside other users of
//! the machine.
#![expect(clippy::unwrap_used, reason = "a test that cannot continue fails")]
#![expect(clippy::disallowed_methods, reason = "tests wait for other processes, with deadlines")]

mod child;
#[expect(dead_code, reason = "the tests of the program use the rest")]
mod client;
mod dds;
mod descriptors;
mod membership;
mod shm;
mod suite;
mod zenoh;

use std::{
    ops::RangeInclusive,
    sync::atomic::{AtomicU16, AtomicU32, Ordering},
    time::{Duration, Instant},
};

use eddy_frames::{Domain, Frame, Material, Stamp};
use eddy_messages::{FrameCdr as _, Message, ParticleFrame};
use eddy_transport::{
    Link, Payload, Publisher, Reliability, Subscriber, TransportOptions, Transports,
};

/// Time limit of anything that a test waits for.
const DEADLINE: Duration = Duration::from_secs(30);

/// A topic of this test only.
fn link(transport: &str) -> Link {
    static NUMBER: AtomicU32 = AtomicU32::new(0);
    let number = NUMBER.fetch_add(1, Ordering::Relaxed);
    format!("{transport}:/test_{}_{number}", std::process::id()).parse().unwrap()
}

/// A DDS domain that no other test uses. Participants on loopback find the first twelve of a domain only.
fn domain() -> u16 {
    static NEXT: AtomicU32 = AtomicU32::new(0);
    const DOMAINS: u32 = 100;
    let next = std::process::id().wrapping_mul(13) + NEXT.fetch_add(1, Ordering::Relaxed);
    1 + (next % DOMAINS) as u16
}

/// Loopback ports that no other test uses.
fn ports() -> RangeInclusive<u16> {
    static NEXT: AtomicU16 = AtomicU16::new(0);
    const BLOCK: u16 = 4;
    // Below the ephemeral ports of the system.
    let first = 10_000 + (std::process::id() % 100) as u16 * 200;
    let start = first + NEXT.fetch_add(1, Ordering::Relaxed) * BLOCK;
    start..=start + BLOCK - 1
}

/// Options that avoid the routers and ports of others.
fn options() -> TransportOptions {
    let mut options = TransportOptions::new("eddy_test");
    options.zenoh.router = "tcp/127.0.0.1:9".to_owned();
    options.zenoh.ports = ports();
    options
}

/// Two ends of a transport, with sessions like two processes (except within the process).
fn ends(transport: &str, mut options: TransportOptions) -> [Transports; 2] {
    if transport == "dds" {
        options.domain_id = domain();
    }
    let first = Transports::new(options.clone());
    let second = if transport == "memory" { first.clone() } else { Transports::new(options) };
    [first, second]
}

/// Waits until `condition` holds.
fn eventually(what: &str, mut condition: impl FnMut() -> bool) {
    let start = Instant::now();
    while !condition() {
        assert!(start.elapsed() < DEADLINE, "{what}: not after {DEADLINE:?}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// What `client` needs of its surroundings.
mod support {
    /// Repeats `answer` until it returns something.
    pub fn wait_for<T>(what: &str, mut answer: impl FnMut() -> Option<T>) -> T {
        let mut found = None;
        super::eventually(what, || {
            found = answer();
            found.is_some()
        });
        found.unwrap()
    }
}

fn frames_publisher(transports: &Transports, link: &Link, mode: Reliability) -> Box<dyn Publisher> {
    transports.publisher(link, ParticleFrame::TYPE, mode).unwrap()
}

fn frames_subscriber(transports: &Transports, link: &Link) -> Box<dyn Subscriber> {
    transports.subscriber(link, ParticleFrame::TYPE).unwrap()
}

/// The next frame; fails when none arrives.
fn next_frame(subscriber: &mut dyn Subscriber) -> Frame {
    let start = Instant::now();
    while start.elapsed() < DEADLINE {
        if let Some(payload) = subscriber.receive(Duration::from_millis(200)).unwrap() {
            return payload.into_frame().unwrap();
        }
    }
    panic!("no frame within {DEADLINE:?}");
}

/// Fails unless the next frame equals `expected` bit by bit.
fn expect_frame(subscriber: &mut dyn Subscriber, expected: &Frame) {
    let found = next_frame(subscriber);
    assert_eq!((found.sequence, found.len()), (expected.sequence, expected.len()));
    assert!(found == *expected, "frame {} differs", expected.sequence);
}

/// The same of three dimensions.
fn in_space(sequence: u64, particles: usize) -> Frame<3> {
    let Frame { stream, stamp, dt, position, velocity, material, .. } = frame(sequence, particles);
    let deep = |plane: &[f32; 2]| [plane[0], plane[1], plane[0] - plane[1]];
    Frame {
        stream,
        sequence,
        stamp,
        dt,
        domain: Domain { lower: [-0.5, 0.0, -1.0], upper: [1.0, 2.0, 3.0] },
        position: position.iter().map(deep).collect(),
        velocity: velocity.iter().map(deep).collect(),
        material,
    }
}

/// Waits for a frame of three dimensions.
fn next_in_space(subscriber: &mut dyn Subscriber) -> Frame<3> {
    let payload = subscriber.receive(DEADLINE).unwrap().unwrap();
    let refused = payload.clone().into_frame().unwrap_err().to_string();
    assert_eq!(refused, "lower: found 3 dimensions, expected 2");
    Frame::from_cdr(&payload.into_cdr()).unwrap()
}

/// A frame with its sequence number in every particle, in bits that rounding would lose.
fn frame(sequence: u64, particles: usize) -> Frame {
    let value = |index: usize| (sequence as f32 + 1.0) / (index as f32 + 3.0);
    Frame {
        stream: 9,
        sequence,
        stamp: Stamp(sequence as i64 * 16_000_000),
        dt: 0.016,
        domain: Domain { lower: [-0.5, 0.0], upper: [1.0, 2.0] },
        position: (0..particles).map(|i| [value(i), -value(i + 1)]).collect(),
        velocity: (0..particles).map(|i| [f32::MIN_POSITIVE * i as f32, value(i + 2)]).collect(),
        material: (0..particles).map(|i| Material::ALL[i % Material::COUNT]).collect(),
    }
}

fn is_frame(payload: &Payload) -> bool {
    payload.clone().into_frame().is_ok()
}
