//! The transports, end to end: one suite for all, then what is particular to each.
//!
//! Every test has topics, ports and a DDS domain of its own, so that tests run side by side, and beside other
//! users of this machine.

mod child;
mod dds;
mod shm;
mod suite;
mod zenoh;

use std::{
    ops::RangeInclusive,
    sync::atomic::{AtomicU16, Ordering},
    time::{Duration, Instant},
};

use eddy_frames::{Domain, Frame, Material, Stamp};
use eddy_messages::{Message, ParticleFrame};
use eddy_transport::{
    Link, Payload, Publisher, Reliability, Subscriber, TransportOptions, Transports,
};

use crate::support::{domain, unique};

/// How long anything may take here before the test fails.
const DEADLINE: Duration = Duration::from_secs(30);

/// A topic of this test only.
fn link(transport: &str) -> Link {
    format!("{transport}:/{}", unique("test")).parse().unwrap()
}

/// Loopback ports that no other test uses.
fn ports() -> RangeInclusive<u16> {
    static NEXT: AtomicU16 = AtomicU16::new(0);
    const BLOCK: u16 = 4;
    // Below the ports that the system hands out by itself.
    let first = 10_000 + (std::process::id() % 100) as u16 * 200;
    let start = first + NEXT.fetch_add(1, Ordering::Relaxed) * BLOCK;
    start..=start + BLOCK - 1
}

/// Options that leave everybody else's router and ports alone.
fn options() -> TransportOptions {
    let mut options = TransportOptions::new("eddy_test");
    options.zenoh.router = "tcp/127.0.0.1:9".to_owned();
    options.zenoh.ports = ports();
    options
}

/// The two ends of a transport: but for memory, as two processes would have them.
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

fn frames_publisher(transports: &Transports, link: &Link, mode: Reliability) -> Box<dyn Publisher> {
    transports.publisher(link, ParticleFrame::TYPE, mode).unwrap()
}

fn frames_subscriber(transports: &Transports, link: &Link) -> Box<dyn Subscriber> {
    transports.subscriber(link, ParticleFrame::TYPE).unwrap()
}

/// The next frame; fails when none comes.
fn next_frame(subscriber: &mut dyn Subscriber) -> Frame {
    let start = Instant::now();
    while start.elapsed() < DEADLINE {
        if let Some(payload) = subscriber.receive(Duration::from_millis(200)).unwrap() {
            return payload.into_frame().unwrap();
        }
    }
    panic!("no frame within {DEADLINE:?}");
}

/// Fails unless the next frame is this one, bit by bit.
fn expect_frame(subscriber: &mut dyn Subscriber, expected: &Frame) {
    let found = next_frame(subscriber);
    assert_eq!((found.sequence, found.len()), (expected.sequence, expected.len()));
    assert!(found == *expected, "frame {} differs", expected.sequence);
}

/// A frame that tells its sequence number in every particle, with bits that rounding would lose.
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
