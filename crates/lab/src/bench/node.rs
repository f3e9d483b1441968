//! What a node adds to its model's own time, and how many streams it carries: the real node on shared
//! memory.

use std::{
    num::NonZeroUsize,
    sync::atomic::{AtomicBool, AtomicU64, Ordering},
    thread,
    time::Duration,
};

use serde::Serialize;

use super::{Spread, particles, transport::Stopping};
use eddy_frames::{Frame, Stamp, clock::Clock};
use eddy_inference::{
    checkpoint::Checkpoint,
    engine::{ModelError, Surrogate},
};
use eddy_messages::{DiagnosticArray, Message, ParticleFrame, PredictionStatus, cdr};
use eddy_node::{
    Control, FrameQueue, InvalidSettings, NodeSettings, Outputs, Presence, RosTime, SurrogateNode,
    drive,
};
use eddy_transport::{Link, Payload, Reliability, TransportError, TransportOptions, Transports};

/// How long the last predictions may take.
const PATIENCE: Duration = Duration::from_secs(3);
/// How long a wait may last before the end is looked for.
const LOOK: Duration = Duration::from_millis(50);
/// Frames of the model alone that are not counted.
const WARM_UP: usize = 20;

/// What is measured.
#[derive(Clone, Copy, Debug)]
pub struct Plan {
    /// Streams at once.
    pub streams: u64,
    /// Particles of each.
    pub particles: usize,
    /// Frames a second of each.
    pub hertz: f64,
    /// How long (s).
    pub seconds: f64,
    /// Whether all streams have their frame at the same instant, instead of one after the other.
    pub together: bool,
    /// Threads of the engine; as many as there are cores if not given.
    pub threads: Option<NonZeroUsize>,
}

/// Why a measurement failed.
#[derive(Debug, thiserror::Error)]
pub enum BenchError {
    /// The network cannot take the frame.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// Frames could not be carried.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// The node cannot work so.
    #[error(transparent)]
    Settings(#[from] InvalidSettings),
}

/// What the node did.
#[derive(Clone, Debug, Serialize)]
pub struct Timing {
    /// Threads of the engine.
    pub threads: usize,
    /// The model's own time for a frame, alone, at the same pace.
    pub model: Spread,
    /// From a frame's arrival at the node until its prediction is published: medians over the seconds.
    pub node: Spread,
    /// From before a frame is published until its prediction is received.
    pub way: Spread,
    /// Frames that were published.
    pub frames: u64,
    /// Predictions there should be: one for each frame from the warm-up's last one.
    pub expected: u64,
    /// Predictions that were received.
    pub predictions: u64,
    /// Frames that the node gave up because it was slow.
    pub dropped: u64,
    /// Frames that came to the node.
    pub received: u64,
}

/// Measures the node with a checkpoint.
///
/// # Errors
/// [`BenchError`].
pub fn time(checkpoint: &Checkpoint, plan: &Plan) -> Result<Timing, BenchError> {
    let surrogate = Surrogate::load(checkpoint, plan.threads)?;
    let frame = particles::frame_for(surrogate.description(), plan.particles);
    let (model, threads) = alone(&surrogate, &frame, plan)?;
    let warm_up = u64::from(surrogate.description().warm_up);
    let each = (plan.seconds * plan.hertz).ceil() as u64;
    let settings =
        NodeSettings { max_streams: plan.streams.max(1) as usize, ..NodeSettings::default() };
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
    let time = RosTime::of_the_machine();
    let mut presence = Presence { name: "/eddy_bench_node".to_owned(), time };
    let mut predictions = here.subscriber(&link("prediction"), ParticleFrame::TYPE)?;
    let mut diagnostics = here.subscriber(&link("diagnostics"), DiagnosticArray::TYPE)?;
    let mut source = here.publisher(&link("particles"), ParticleFrame::TYPE, Reliability::Drop)?;

    let clock = Clock::start();
    // When each frame was published (ns).
    let sent: Vec<AtomicU64> = (0..plan.streams * each).map(|_| AtomicU64::new(0)).collect();
    let (mut ways, mut reports) = (Vec::with_capacity(sent.len()), Vec::new());
    let expected = plan.streams * (each + 1).saturating_sub(warm_up);
    let (stop, over) = (AtomicBool::new(false), AtomicBool::new(false));
    thread::scope(|scope| -> Result<(), BenchError> {
        let _stopping = (Stopping(&stop), Stopping(&over));
        let (node, queue, stop, over) = (&mut node, &queue, &stop, &over);
        let (input, outputs) = (&mut *input, &mut outputs[..]);
        let control = Control::default();
        let presence = &mut presence;
        let driving =
            scope.spawn(move || drive(node, presence, input, outputs, queue, &control, stop));
        let watching = scope.spawn(|| -> Result<(), TransportError> {
            while !over.load(Ordering::Relaxed) && ways.len() < ways.capacity() {
                let Some(mut payload) = predictions.receive(LOOK)? else { continue };
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
        thread::sleep(PATIENCE);
        stop.store(true, Ordering::Relaxed);
        let join = |outcome: thread::Result<Result<(), TransportError>>| {
            outcome.unwrap_or_else(|panic| std::panic::resume_unwind(panic))
        };
        join(driving.join())?;
        over.store(true, Ordering::Relaxed);
        Ok(join(watching.join())?)
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
        way: Spread::of(ways),
        dropped: queue.dropped(),
        received: node.counters().received,
    })
}

/// The model's own time at the same pace (caches are as cold, and threads as asleep), and its number of threads.
fn alone(surrogate: &Surrogate, frame: &Frame, plan: &Plan) -> Result<(Spread, usize), ModelError> {
    let mut stepper = surrogate.stepper();
    let mut memory = surrogate.start(frame)?;
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
    Ok((Spread::of(times), stepper.threads()))
}

/// The latency in a report of the node, unless it had nothing to do.
fn latency(report: &[u8]) -> Option<Spread> {
    let report: DiagnosticArray = cdr::decode(report).ok()?;
    let values = &report.status.first()?.values;
    let number = |key: &str| -> Option<f64> {
        values.iter().find(|value| value.key == key)?.value.parse().ok()
    };
    let spread = Spread { p50: number("latency p50 (ms)")?, p99: number("latency p99 (ms)")? };
    (spread.p50 > 0.0).then_some(spread)
}
