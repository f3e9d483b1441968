//! A node whose network runs on a device: here one that computes with the engine itself.

use std::{
    any::Any,
    sync::{
        Arc, Mutex,
        atomic::{AtomicUsize, Ordering},
    },
    thread,
    time::Duration,
};

use super::{DT, WARM_UP, feed, frame, observe};
use crate::surrogate::{
    DriveError, FrameQueue, NodeContext, NodeHandle, NodeSettings, Outputs, Publish, RosTime,
    SurrogateNode, drive,
};
use eddy_frames::{Domain, Frame, Material, Stamp};
use eddy_inference::{
    checkpoint::{Architecture, Checkpoint, Core, Description, Sizes, initial_weights},
    engine::{
        Accelerator, DeviceState, DeviceStep, HiddenState, ModelError, StepRequest, Stepper,
        StreamStart, Surrogate,
    },
};
use eddy_messages::{Message, ParticleFrame, PredictionStatus};
use eddy_transport::{Link, Payload, Reliability, TransportOptions, Transports};

/// A frame model of two particles.
fn checkpoint() -> Checkpoint {
    let sizes = Sizes { encoder: 8, hidden: 8, layers: 1, particles: Some(2) };
    let description = Description {
        warm_up: WARM_UP as u32,
        materials: vec![Material::Liquid, Material::Jelly],
        ..Description::untrained(Architecture::Frame, Core::MinGru, sizes)
    };
    let mut tensors = initial_weights(&description, 1);
    for (index, weight) in tensors.get_mut("decoder.weight").unwrap().values.iter_mut().enumerate()
    {
        *weight = 0.1 * (index as f32).sin();
    }
    Checkpoint::new(description, tensors)
}

/// The engine in the place of a device.
struct Engine {
    surrogate: Surrogate,
    stepper: Mutex<Stepper>,
    /// The most streams of a step.
    largest: AtomicUsize,
    /// Steps before it fails.
    left: AtomicUsize,
}

struct State(HiddenState);

impl Engine {
    fn new(left: usize) -> Arc<Self> {
        let surrogate = Surrogate::load(&checkpoint(), None).unwrap();
        let stepper = Mutex::new(surrogate.stepper());
        Arc::new(Self { surrogate, stepper, largest: AtomicUsize::new(0), left: left.into() })
    }

    fn node(self: &Arc<Self>, settings: NodeSettings) -> SurrogateNode {
        let surrogate = Surrogate::on_device(&checkpoint(), self.clone()).unwrap();
        SurrogateNode::new(surrogate, settings).unwrap()
    }
}

impl Accelerator for Engine {
    fn streams(&self) -> usize {
        8
    }

    fn start(&self, stream: &StreamStart<'_>) -> Result<Box<dyn DeviceState>, ModelError> {
        let kinds = stream.material.iter();
        let material: Vec<_> = kinds.map(|&kind| Material::ALL[kind as usize]).collect();
        let first = Frame {
            stream: 0,
            sequence: 0,
            stamp: Stamp(0),
            dt: DT,
            domain: Domain::UNIT,
            position: vec![[0.5; 2]; material.len()],
            velocity: vec![[0.0; 2]; material.len()],
            material,
        };
        Ok(Box::new(State(self.surrogate.start(&first)?)))
    }

    fn step(&self, steps: &mut [DeviceStep<'_>]) -> Result<(), ModelError> {
        if self.left.fetch_sub(1, Ordering::Relaxed) == 0 {
            self.left.store(0, Ordering::Relaxed);
            return Err(ModelError::Device("the device fell off the bus".to_owned()));
        }
        self.largest.fetch_max(steps.len(), Ordering::Relaxed);
        let mut requests: Vec<_> = steps
            .iter_mut()
            .map(|DeviceStep { state, frame, next }| {
                let state: &mut dyn Any = &mut **state;
                let hidden = &mut state.downcast_mut::<State>().unwrap().0;
                StepRequest { hidden, frame: *frame, next }
            })
            .collect();
        self.stepper.lock().unwrap().step_all(&mut requests);
        Ok(())
    }
}

impl DeviceState for State {
    fn duplicate(&self) -> Box<dyn DeviceState> {
        Box::new(Self(self.0.clone()))
    }

    fn copy_from(&mut self, other: &dyn DeviceState) {
        let other: &dyn Any = other;
        self.0.clone_from(&other.downcast_ref::<Self>().unwrap().0);
    }

    fn forget(&mut self) {
        self.0.forget();
    }

    fn numbers(&self) -> Vec<f32> {
        vec![]
    }
}

fn on_processor(settings: NodeSettings) -> SurrogateNode {
    SurrogateNode::new(Surrogate::load(&checkpoint(), None).unwrap(), settings).unwrap()
}

/// Frames of three streams side by side, one of which misses frames on the way.
fn rounds() -> impl Iterator<Item = Vec<Payload>> {
    (0..12).map(|sequence| {
        let streams = (0..3).filter(move |&stream| stream != 1 || !(5..7).contains(&sequence));
        streams.map(|stream| Payload::Frame(frame(stream, sequence))).collect()
    })
}

#[test]
fn a_device_predicts_several_streams_at_once_with_the_bits_of_one_after_the_other() {
    for (horizon, publish) in [(1, Publish::All), (4, Publish::All), (5, Publish::Last)] {
        let settings = NodeSettings { horizon, publish, max_gap: 3, ..NodeSettings::default() };
        let engine = Engine::new(usize::MAX);
        let (mut device, mut processor) =
            (engine.node(settings.clone()), on_processor(settings.clone()));
        for messages in rounds() {
            let expected = observe(&mut processor, messages.clone()).unwrap();
            assert_eq!(observe(&mut device, messages).unwrap(), expected);
        }
        assert_eq!(device.counters(), processor.counters());
        assert_eq!(device.counters().filled, 2);
        assert_eq!(engine.largest.load(Ordering::Relaxed), 3);
        device.check().unwrap();
    }
}

#[test]
fn free_runs_on_a_device_go_on_together() {
    let settings = NodeSettings { free_run: Some(WARM_UP), ..NodeSettings::default() };
    let engine = Engine::new(usize::MAX);
    let (mut device, mut processor) = (engine.node(settings.clone()), on_processor(settings));
    for node in [&mut device, &mut processor] {
        for sequence in 0..WARM_UP {
            let messages = (0..3).map(|stream| Payload::Frame(frame(stream, sequence))).collect();
            observe(node, messages).unwrap();
        }
    }
    engine.largest.store(0, Ordering::Relaxed);
    for tick in 1..5 {
        let now = Duration::from_millis(17) * tick;
        let [found, expected] = [&mut device, &mut processor].map(|node| {
            let mut frames = Vec::new();
            node.on_tick(now, &mut |_, outcome| frames.push(outcome.unwrap().frame.clone()));
            frames
        });
        assert_eq!(found.len(), 3);
        assert_eq!(found, expected);
    }
    assert_eq!(engine.largest.load(Ordering::Relaxed), 3);
}

#[test]
fn a_node_ends_with_the_error_of_its_device() {
    let engine = Engine::new(5);
    let mut node = engine.node(NodeSettings::default());
    for sequence in 0..5 {
        let expected = usize::from(sequence + 1 >= WARM_UP);
        assert_eq!(feed(&mut node, frame(1, sequence)).len(), expected);
        node.check().unwrap();
    }
    assert_eq!(feed(&mut node, frame(1, 5)), []);
    assert_eq!(node.check().unwrap_err().to_string(), "the device fell off the bus");

    let mut node = Engine::new(2).node(NodeSettings::default());
    let transports = Transports::new(TransportOptions::new("device"));
    let [input, output, status] = ["/in", "/out", "/status"].map(Link::memory);
    let publisher = |link, kind| transports.publisher(link, kind, Reliability::Block).unwrap();
    let mut read = transports.subscriber(&input, ParticleFrame::TYPE).unwrap();
    let mut source = publisher(&input, ParticleFrame::TYPE);
    let mut outputs = [Outputs::new(
        publisher(&output, ParticleFrame::TYPE),
        publisher(&status, PredictionStatus::TYPE),
    )];
    let mut context =
        NodeContext { name: "/node".into(), input, time: RosTime::system(), group: None };
    let queue = FrameQueue::new(40, Reliability::Drop);
    (0..4).for_each(|sequence| source.publish_frame(&frame(1, sequence)).unwrap());
    let outcome = thread::scope(|scope| {
        let driving = scope.spawn(|| {
            let handle = NodeHandle::default();
            let stop = std::sync::atomic::AtomicBool::new(false);
            drive(&mut node, &mut context, &mut *read, &mut outputs, &queue, &handle, &stop)
        });
        driving.join().unwrap()
    });
    assert!(matches!(outcome, Err(DriveError::Model(ModelError::Device(_)))), "{outcome:?}");
}
