//! Streaming allocates nothing: a binary of its own, whose allocator counts.

use std::{
    alloc::{GlobalAlloc, Layout, System},
    num::NonZeroUsize,
    sync::atomic::{AtomicUsize, Ordering},
};

use eddy::{
    checkpoint::{
        Architecture, Checkpoint, Core, Description, FrameOptions, Pooling, Sizes, Weights,
        tensor_shapes,
    },
    engine::Surrogate,
    frame::{Frame, Material, Stamp},
};

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
    let description = Description {
        frame: FrameOptions { pooling, ..FrameOptions::default() },
        ..Description::untrained(architecture, core, sizes)
    };
    let tensors = tensor_shapes(&description).into_iter().map(|(name, shape)| {
        let length = shape.iter().product();
        let values = (0..length).map(|n| 0.05 * (n as f32).sin()).collect();
        (name, Weights { shape, values })
    });
    Checkpoint { tensors: tensors.collect(), description }
}

fn frame(description: &Description) -> Frame {
    let place = |n: usize| [0.1 + n as f32 / (2 * PARTICLES) as f32, 0.5];
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

#[test]
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
            let mut memory = surrogate.start(&frame).unwrap();
            let mut next = surrogate.step(&mut memory, &frame);
            let mut ahead = memory.clone();

            let before = ASKED.load(Ordering::SeqCst);
            for _ in 0..50 {
                // As a node does it: observe, then look ahead from a copy of the state.
                surrogate.fits(&frame).unwrap();
                surrogate.step_into(&mut memory, &frame, &mut next);
                ahead.clone_from(&memory);
                std::mem::swap(&mut frame, &mut next);
                surrogate.step_into(&mut ahead, &frame, &mut next);
            }
            let asked = ASKED.load(Ordering::SeqCst) - before;
            assert_eq!(asked, 0, "{architecture:?} {core:?} {pooling:?}, {threads} threads");
            frame.check().unwrap();
        }
    }
}
