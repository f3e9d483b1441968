//! Streaming allocates nothing: a binary of its own, whose allocator counts.
#![expect(unsafe_code, reason = "an allocator that counts")]
#![expect(clippy::unwrap_used, reason = "a test that cannot go on fails")]
#![expect(clippy::disallowed_methods, reason = "tests wait for other processes, with deadlines")]

use std::{
    alloc::{GlobalAlloc, Layout, System},
    num::NonZeroUsize,
    sync::atomic::{AtomicBool, AtomicUsize, Ordering},
    thread,
    time::{Duration, Instant},
};

use eddy_frames::{Frame, Material, Stamp};
use eddy_inference::{
    checkpoint::{
        Architecture, Checkpoint, Core, Description, ElasticRule, FrameOptions, GridOptions,
        Pooling, Sizes, Weights, tensor_shapes,
    },
    engine::Surrogate,
    error_model::ErrorModel,
};
use eddy_messages::{Message, ParticleFrame, PredictionStatus};
use eddy_node::{
    FrameQueue, NodeContext, NodeHandle, NodeSettings, Outputs, RosTime, SurrogateNode, drive,
};
use eddy_transport::{
    Link, Payload, Publisher, Reliability, Subscriber, TransportOptions, Transports,
};
use iceoryx2::prelude::*;

/// Counts what any thread asks of the system's allocator.
struct Counting;

static ASKED: AtomicUsize = AtomicUsize::new(0);

// SAFETY: every call goes to the system's allocator as it is.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ASKED.fetch_add(1, Ordering::SeqCst);
        // SAFETY: the caller's promises are passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        ASKED.fetch_add(1, Ordering::SeqCst);
        // SAFETY: the caller's promises are passed on.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        ASKED.fetch_add(1, Ordering::SeqCst);
        // SAFETY: the caller's promises are passed on.
        unsafe { System.realloc(pointer, layout, size) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        ASKED.fetch_add(1, Ordering::SeqCst);
        // SAFETY: the caller's promises are passed on.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

const PARTICLES: usize = 700;

/// A network wide enough for all threads to take part, with small made-up weights.
fn checkpoint(architecture: Architecture, core: Core, pooling: Pooling) -> Checkpoint {
    let whole = architecture == Architecture::Frame;
    let sizes =
        Sizes { encoder: 64, hidden: 200, layers: 2, particles: whole.then_some(PARTICLES) };
    let mut description = Description {
        frame: FrameOptions { pooling, ..FrameOptions::default() },
        ..Description::untrained(architecture, core, sizes)
    };
    let elastic = |grid: &GridOptions| ElasticRule::new(300.0, grid.spacing, description.dt);
    description.rules.elastic = description.grid.as_ref().map(elastic);
    let tensors = tensor_shapes(&description).into_iter().map(|(name, shape)| {
        let length = shape.iter().product();
        let values = (0..length).map(|n| 0.05 * (n as f32).sin()).collect();
        (name, Weights { shape, values })
    });
    Checkpoint::new(description, tensors.collect())
}

/// With the estimates of the shipped model: errors are estimated, however wrongly.
fn calibrated(checkpoint: Checkpoint) -> Checkpoint {
    let error_model = Checkpoint::shipped().unwrap().error_model.unwrap();
    let error_model = ErrorModel { checkpoint: checkpoint.digest(), ..error_model };
    Checkpoint { error_model: Some(error_model), ..checkpoint }
}

fn frame(description: &Description) -> Frame {
    // Jelly is a block, others lie in a line.
    let place = |n: usize| match Material::ALL[n % 4] {
        Material::Jelly => [n / 4 % 14, n / 56].map(|steps| 0.6 + steps as f32 / 128.0),
        _ => [0.1 + n as f32 / (2 * PARTICLES) as f32, 0.5],
    };
    Frame {
        stream: 1,
        sequence: 0,
        stamp: Stamp(0),
        dt: description.dt,
        domain: description.domain,
        position: (0..PARTICLES).map(place).collect(),
        velocity: vec![[0.1, -0.1]; PARTICLES],
        material: (0..PARTICLES).map(|n| Material::ALL[n % 4]).collect(),
    }
}

/// One test: all threads are counted, those of another test and of its end would be, too.
#[test]
fn streaming_allocates_nothing() {
    after_its_first_frame_a_stream_allocates_nothing_on_any_thread();
    a_node_on_shared_memory_allocates_nothing_from_receive_to_publish();
}

fn after_its_first_frame_a_stream_allocates_nothing_on_any_thread() {
    let mut networks = vec![];
    for core in Core::ALL {
        networks.push((Architecture::Frame, core, Pooling::Mean));
        networks.push((Architecture::Particle, core, Pooling::Mean));
    }
    networks.push((Architecture::Frame, Core::MinGru, Pooling::MeanMax));
    for (architecture, core, pooling) in networks {
        for threads in [1, 3] {
            let checkpoint = checkpoint(architecture, core, pooling);
            let surrogate = Surrogate::load(&checkpoint, NonZeroUsize::new(threads)).unwrap();
            let mut frame = frame(surrogate.description());
            let (mut stepper, mut memory) = (surrogate.stepper(), surrogate.start(&frame).unwrap());
            let mut next = stepper.step(&mut memory, &frame);
            let mut ahead = memory.clone();

            let before = ASKED.load(Ordering::SeqCst);
            for _ in 0..50 {
                // As a node does it: observe, then look ahead from a copy of the state.
                // With made-up weights, particles may become too fast.
                let _ = surrogate.fits(&frame);
                stepper.step_into(&mut memory, &frame, &mut next);
                ahead.clone_from(&memory);
                std::mem::swap(&mut frame, &mut next);
                stepper.step_into(&mut ahead, &frame, &mut next);
            }
            let asked = ASKED.load(Ordering::SeqCst) - before;
            assert_eq!(asked, 0, "{architecture:?} {core:?} {pooling:?}, {threads} threads");
            frame.check().unwrap();
        }
    }
}

/// Frames of which each must cost nothing.
const FRAMES: usize = 300;

/// The next frame; it must be lent, not copied.
fn lent(subscriber: &mut dyn Subscriber) -> Option<Payload> {
    let payload = subscriber.receive(Duration::from_secs(30)).unwrap();
    assert!(payload.iter().all(|payload| matches!(payload, Payload::Shared(_))), "{payload:?}");
    payload
}

fn outputs(transports: &Transports, link: &Link) -> Outputs {
    let publisher = |link: &Link, kind| transports.publisher(link, kind, Reliability::Block);
    let status = link.with_topic(&format!("{}/status", link.topic));
    Outputs::new(
        publisher(link, ParticleFrame::TYPE).unwrap(),
        publisher(&status, PredictionStatus::TYPE).unwrap(),
    )
}

/// What anybody asked for while each frame went to the node and its predictions came back.
fn asked_by_frame(
    source: &mut dyn Publisher,
    sink: &mut dyn Subscriber,
    frames: &[Frame],
    predictions: usize,
) -> Vec<usize> {
    let mut asked = Vec::with_capacity(frames.len());
    for frame in frames {
        let before = ASKED.load(Ordering::SeqCst);
        source.publish_frame(frame).unwrap();
        for _ in 0..predictions {
            assert!(lent(sink).is_some(), "no prediction from frame {}", frame.sequence);
        }
        asked.push(ASKED.load(Ordering::SeqCst) - before);
    }
    asked
}

/// What iceoryx2 itself asks for when it lends memory for one message: its version 0.10 guards every loan
/// by a mutex of its own.
fn asked_by_loan() -> usize {
    let node = NodeBuilder::new().create::<ipc_threadsafe::Service>().unwrap();
    let name = format!("allocation_{}", std::process::id());
    let service = node.service_builder(&name.as_str().try_into().unwrap());
    let service = service.publish_subscribe::<[u8]>().create().unwrap();
    let publisher = service.publisher_builder().initial_max_slice_len(8).create().unwrap();
    let loan = || publisher.loan_slice_uninit(8).unwrap().write_from_slice(&[7; 8]).send().unwrap();
    loan();
    let before = ASKED.load(Ordering::SeqCst);
    loan();
    ASKED.load(Ordering::SeqCst) - before
}

/// Messages that are published for each frame: itself, its prediction, its status.
const LOANS: usize = 3;

fn a_node_on_shared_memory_allocates_nothing_from_receive_to_publish() {
    let loan = asked_by_loan();
    let topic = |name: &str| -> Link {
        format!("shm:/allocation_{}/{name}", std::process::id()).parse().unwrap()
    };
    for horizon in [1, 4] {
        let checkpoint =
            calibrated(checkpoint(Architecture::Particle, Core::MinGru, Pooling::Mean));
        let surrogate = Surrogate::load(&checkpoint, NonZeroUsize::new(2)).unwrap();
        assert!(surrogate.error_model().is_some());
        let warm_up = surrogate.description().warm_up as usize;
        let first = frame(surrogate.description());
        let frames: Vec<_> = (0..warm_up + 20 + FRAMES)
            .map(|number| Frame {
                sequence: number as u64,
                stamp: Stamp(0).advance(first.dt, number as u32),
                ..first.clone()
            })
            .collect();
        let settings = NodeSettings { horizon, ..NodeSettings::default() };
        let queue = FrameQueue::new(settings.queue, Reliability::Block);
        let mut node = SurrogateNode::new(surrogate, settings).unwrap();
        let [here, there] =
            ["here", "there"].map(|name| Transports::new(TransportOptions::new(name)));
        let subscriber = |transports: &Transports, name| {
            transports.subscriber(&topic(name), ParticleFrame::TYPE).unwrap()
        };
        let (mut input, mut sink) = (subscriber(&there, "in"), subscriber(&here, "out"));
        let mut outputs = [outputs(&there, &topic("out"))];
        let (name, time) = ("/node".to_owned(), RosTime::system());
        let mut context = NodeContext { name, input: topic("in"), time, group: None };
        let mut source =
            here.publisher(&topic("in"), ParticleFrame::TYPE, Reliability::Block).unwrap();
        let stop = AtomicBool::new(false);
        thread::scope(|scope| {
            let handle = NodeHandle::default();
            let (node, input, outputs) = (&mut node, &mut *input, &mut outputs[..]);
            let (queue, stop, context) = (&queue, &stop, &mut context);
            scope.spawn(move || drive(node, context, input, outputs, queue, &handle, stop));
            // Whatever fails below, the node ends.
            let _stopping = Stopping(stop);
            let (warming, rest) = frames.split_at(warm_up - 1);
            let (settling, steady) = rest.split_at(21);
            asked_by_frame(&mut *source, &mut *sink, warming, 0);
            asked_by_frame(&mut *source, &mut *sink, settling, 1);
            let start = Instant::now();
            let asked = asked_by_frame(&mut *source, &mut *sink, steady, 1);
            // Twice a second each end looks for killed processes, and once the node reports: that is
            // many pieces at once, seen by two frames at most. One piece a frame shows in the sum.
            let others = 1 + (5.0 * start.elapsed().as_secs_f64()) as usize;
            let (quiet, costly): (Vec<usize>, Vec<usize>) =
                asked.iter().copied().partition(|&asked| asked <= 2 * LOANS * loan);
            assert!(costly.len() <= 2 * others, "horizon {horizon}: {asked:?}");
            let sum: usize = quiet.into_iter().sum();
            assert!(sum <= LOANS * loan * FRAMES + LOANS, "horizon {horizon}: {sum}: {asked:?}");
        });
        assert_eq!(node.counters().published, (frames.len() + 1 - warm_up) as u64);
    }
}

struct Stopping<'a>(&'a AtomicBool);

impl Drop for Stopping<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}
