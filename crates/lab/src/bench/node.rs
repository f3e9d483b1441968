//! Overhead of a node over its model, and number of streams, with a real node on shared memory.

use std::{
    num::NonZeroUsize,
    sync::atomic::{AtomicBool, AtomicU64, Ordering},
    thread,
    time::Duration,
};

use serde::Serialize;

use super::{Spread, Tail, inference::stiffness, particles, transport::Stopping};
use eddy_frames::{Frame, Stamp, clock::Clock};
use eddy_inference::{
    checkpoint::Checkpoint,
    engine::{ModelError, Surrogate},
};
use eddy_messages::{DiagnosticArray, Message, ParticleFrame, PredictionStatus, cdr};
use eddy_node::{
    DriveError, FrameQueue, InvalidSettings, NodeContext, NodeHandle, NodeSettings, Outputs,
    RosTime, SurrogateNode, drive,
};
use eddy_transport::{Link, Payload, Reliability, TransportError, TransportOptions, Transports};

/// Time allowed for the last predictions.
const DRAIN_TIME: Duration = Duration::from_secs(3);
/// Timeout of a wait, after which the end of the measurement is checked.
const POLL_TIMEOUT: Duration = Duration::from_millis(50);
/// Untimed warm-up frames of the model alone.
const WARM_UP: usize = 20;

/// Parameters of the benchmark.
#[derive(Clone, Copy, Debug)]
pub struct Plan {
    /// Number of streams.
    pub streams: u64,
    /// Particles per stream.
    pub particles: usize,
    /// Frame rate per stream (Hz).
    pub hertz: f64,
    /// Duration (s).
    pub seconds: f64,
    /// Whether all streams publish at the same time, instead of evenly spaced.
    pub together: bool,
    /// Threads of the engine; one per core by default.
    pub threads: Option<NonZeroUsize>,
}

/// Why a measurement failed.
#[derive(Debug, thiserror::Error)]
pub enum BenchError {
    /// The network does not support the frame.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// The node ended with an error.
    #[error(transparent)]
    Drive(#[from] DriveError),
    /// A transport failed.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// Invalid node settings.
    #[error(transparent)]
    Settings(#[from] InvalidSettings),
}

/// Results of the benchmark.
#[derive(Clone, Debug, Serialize)]
pub struct Timing {
    /// Threads of the engine.
    pub threads: usize,
    /// Time per frame of the model alone, at the same rate.
    pub model: Spread,
    /// From a frame's arrival at the node to the publication of its prediction: medians over the diagnostics of each
    /// second.
    pub node: Spread,
    /// From the publication of a frame to the reception of its prediction.
    pub way: Spread,
    /// The longest of these times.
    pub way_tail: Tail,
    /// Published frames.
    pub frames: u64,
    /// Expected predictions: one per frame from the last warm-up frame on.
    pub expected: u64,
    /// Received predictions.
    pub predictions: u64,
    /// Frames dropped by the node.
    pub dropped: u64,
    /// Frames received by the node.
    pub received: u64,
}

/// Measures the node with a checkpoint.
///
/// # Errors
/// [`BenchError`].
#[expect(clippy::too_many_lines, reason = "one measurement from start to end")]
pub fn time(checkpoint: &Checkpoint, plan: &Plan) -> Result<Timing, BenchError> {
    let surrogate = Surrogate::load(checkpoint, plan.threads)?;
    let frame = particles::frame_for(surrogate.description(), plan.particles);
    let (model, threads) = alone(&surrogate, &frame, plan)?;
    let warm_up = u64::from(surrogate.description().warm_up);
    let each = (plan.seconds * plan.hertz).ceil() as u64;
    let settings = NodeSettings {
        max_streams: plan.streams.max(1) as usize,
        stiffness: stiffness(surrogate.description()).map(f64::from),
        ..NodeSettings::default()
    };
    let queue = FrameQueue::new(settings.queue, Reliability::Drop);
    let mut node = SurrogateNode::new(surrogate, settings)?;

    let link = |name: &str| -> Link { Link::shm(&format!("/bench_{}/{name}", std::process::id())) };
    let ends = |name| Transports::new(TransportOptions::new(name));
    let (here, there) = (ends("eddy_bench"), ends("eddy_bench_node"));
    let mut input = there.subscriber(&link("particles"), ParticleFrame::TYPE)?;
    let publisher = |name, kind| there.publisher(&link(name), kind, Reliability::Drop);
    let prediction = publisher("prediction", ParticleFrame::TYPE)?;
    let status = publisher("prediction/status", PredictionStatus::TYPE)?;
    let diagnostics = Some(publisher("diagnostics", DiagnosticArray::TYPE)?);
    let mut outputs = [Outputs { diagnostics, ..Outputs::new(prediction, status) }];
    let (name, time) = ("/eddy_bench_node".to_owned(), RosTime::system());
    let mut context = NodeContext { name, input: link("particles"), time, group: None };
    let mut predictions = here.subscriber(&link("prediction"), ParticleFrame::TYPE)?;
    let mut diagnostics = here.subscriber(&link("diagnostics"), DiagnosticArray::TYPE)?;
    let mut source = here.publisher(&link("particles"), ParticleFrame::TYPE, Reliability::Drop)?;

    let clock = Clock::start();
    // Publication time of each frame (ns).
    let sent: Vec<AtomicU64> = (0..plan.streams * each).map(|_| AtomicU64::new(0)).collect();
    let (mut ways, mut reports) = (Vec::with_capacity(sent.len()), Vec::new());
    let expected = plan.streams * (each + 1).saturating_sub(warm_up);
    let (stop, over) = (AtomicBool::new(false), AtomicBool::new(false));
    thread::scope(|scope| -> Result<(), BenchError> {
        let _stopping = (Stopping(&stop), Stopping(&over));
        let (node, queue, stop, over) = (&mut node, &queue, &stop, &over);
        let (input, outputs) = (&mut *input, &mut outputs[..]);
        let handle = NodeHandle::default();
        let context = &mut context;
        let driving =
            scope.spawn(move || drive(node, context, input, outputs, queue, &handle, stop));
        let watching = scope.spawn(|| -> Result<(), TransportError> {
            while !over.load(Ordering::Relaxed) && ways.len() < ways.capacity() {
                let Some(mut payload) = predictions.receive(POLL_TIMEOUT)? else { continue };
                let arrived = clock.now();
                if payload.decode().is_err() {
                    continue;
                }
                let Some(view) = payload.view() else { continue };
                let index = view.stream * each + view.sequence - 1;
                let sent = Duration::from_nanos(sent[index as usize].load(Ordering::Relaxed));
                ways.push(arrived.saturating_sub(sent));
            }
            Ok(())
        });
        let mut frame = frame;
        for number in 0..each {
            for stream in 0..plan.streams {
                let phase = if plan.together { 0.0 } else { stream as f64 / plan.streams as f64 };
                let due = Duration::from_secs_f64((number as f64 + phase) / plan.hertz);
                thread::sleep(due.saturating_sub(clock.now()));
                (frame.stream, frame.sequence) = (stream, number);
                frame.stamp = Stamp(0).advance(frame.dt, number as u32);
                let now = clock.now().as_nanos() as u64;
                sent[(stream * each + number) as usize].store(now, Ordering::Relaxed);
                source.publish_frame(&frame)?;
            }
            while let Some(Payload::Cdr(bytes)) = diagnostics.receive(Duration::ZERO)? {
                reports.extend(latency(&bytes));
            }
        }
        thread::sleep(DRAIN_TIME);
        stop.store(true, Ordering::Relaxed);
        let driven = driving.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic));
        over.store(true, Ordering::Relaxed);
        let watched = watching.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic));
        driven?;
        Ok(watched?)
    })?;
    let median = |of: fn(&Spread) -> f64| {
        let mut values: Vec<_> = reports.iter().map(of).collect();
        values.sort_by(f64::total_cmp);
        values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
    };
    Ok(Timing {
        threads,
        model,
        node: Spread { p50: median(|spread| spread.p50), p99: median(|spread| spread.p99) },
        frames: plan.streams * each,
        expected,
        predictions: ways.len() as u64,
        way_tail: Tail::of(ways.clone()),
        way: Spread::of(ways),
        dropped: queue.dropped(),
        received: node.counters().received,
    })
}

/// Time per frame of the model alone at the same rate, with equally cold caches and sleeping threads, and its number of
/// threads.
fn alone(surrogate: &Surrogate, frame: &Frame, plan: &Plan) -> Result<(Spread, usize), ModelError> {
    let mut stepper = surrogate.stepper();
    let mut memory = surrogate.start_with_stiffness(frame, stiffness(surrogate.description()))?;
    let mut next = frame.clone();
    let pause = Duration::from_secs_f64(1.0 / (plan.hertz * plan.streams.max(1) as f64));
    let frames = WARM_UP + (plan.seconds / 2.0 / pause.as_secs_f64()) as usize + 1;
    let clock = Clock::start();
    let mut times = Vec::new();
    for number in 0..frames {
        thread::sleep((pause * number as u32).saturating_sub(clock.now()));
        let begin = clock.now();
        stepper.step_into(&mut memory, frame, &mut next);
        if number >= WARM_UP {
            times.push(clock.now() - begin);
        }
    }
    Ok((Spread::of(times), stepper.streams()))
}

/// The latency in a diagnostics message of the node, unless it was idle.
fn latency(report: &[u8]) -> Option<Spread> {
    let report: DiagnosticArray = cdr::decode(report).ok()?;
    let values = &report.status.first()?.values;
    let number = |key: &str| -> Option<f64> {
        values.iter().find(|value| value.key == key)?.value.parse().ok()
    };
    let spread = Spread { p50: number("latency p50 (ms)")?, p99: number("latency p99 (ms)")? };
    (spread.p50 > 0.0).then_some(spread)
}
