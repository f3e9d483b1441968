//! The rules of the surrogate node, one test a rule.

mod device;
mod error_estimates;
mod free_run;
mod requests;

use std::{
    num::NonZeroUsize,
    sync::atomic::{AtomicBool, Ordering},
    thread,
    time::Duration,
};

use super::{
    Counters, FrameQueue, NodeContext, NodeHandle, NodeSettings, Outputs, Publish, Rejection,
    RosTime, SurrogateNode, drive,
};
use eddy_frames::{Domain, Frame, Material, Stamp, clock};
use eddy_inference::{
    checkpoint::{Architecture, Checkpoint, Core, Description, Rules, Sizes, initial_weights},
    engine::{HiddenState, Stepper, Surrogate},
};
use eddy_messages::{FrameCdr, Message, ParticleFrame, PredictionStatus, StreamState};
use eddy_transport::{Link, Payload, Reliability, TransportOptions, Transports};

const DT: f32 = 0.016;
const WARM_UP: u64 = 3;

/// A particle model with random weights, also in the decoder: its predictions depend on all observed frames.
fn surrogate() -> Surrogate {
    surrogate_on(None)
}

fn surrogate_on(threads: Option<NonZeroUsize>) -> Surrogate {
    Surrogate::load(&checkpoint(), threads).unwrap()
}

fn checkpoint() -> Checkpoint {
    let sizes = Sizes { encoder: 8, hidden: 8, layers: 1, particles: None };
    let description = Description {
        warm_up: WARM_UP as u32,
        materials: vec![Material::Liquid, Material::Jelly],
        ..Description::untrained(Architecture::Particle, Core::MinGru, sizes)
    };
    let mut tensors = initial_weights(&description, 1);
    let decoder = tensors.get_mut("decoder.weight").unwrap();
    for (index, weight) in decoder.values.iter_mut().enumerate() {
        *weight = 0.1 * (index as f32).sin();
    }
    Checkpoint::new(description, tensors)
}

fn node(settings: NodeSettings) -> SurrogateNode {
    SurrogateNode::new(surrogate(), settings).unwrap()
}

/// Two particles on circles, different in every stream.
fn frame(stream: u64, sequence: u64) -> Frame {
    let t = sequence as f32 * DT;
    let phase = stream as f32;
    let place = |a: f32| [0.5 + 0.2 * (a + t + phase).cos(), 0.5 + 0.2 * (a + t + phase).sin()];
    let pace = |a: f32| [-0.2 * (a + t + phase).sin(), 0.2 * (a + t + phase).cos()];
    Frame {
        stream,
        sequence,
        stamp: Stamp(0).advance(DT, sequence as u32),
        dt: DT,
        domain: Domain::UNIT,
        position: vec![place(0.0), place(2.0)],
        velocity: vec![pace(0.0), pace(2.0)],
        material: vec![Material::Liquid, Material::Jelly],
    }
}

/// Feeds messages that arrive together. Returns the predicted frames, or a rejection.
fn observe(node: &mut SurrogateNode, messages: Vec<Payload>) -> Result<Vec<Frame>, Rejection> {
    let mut arrivals: Vec<_> = messages.into_iter().map(|m| (Duration::ZERO, m)).collect();
    let mut outcome = Ok(Vec::new());
    node.on_frames(&mut arrivals, None, &mut |_, result| match (result, &mut outcome) {
        (Ok(prediction), Ok(frames)) => frames.push(prediction.frame.clone()),
        (Err(rejected), _) => outcome = Err(rejected.reason),
        (Ok(_), Err(_)) => {}
    });
    outcome
}

/// Feeds one frame and returns the predicted frames.
fn feed(node: &mut SurrogateNode, frame: Frame) -> Vec<Frame> {
    observe(node, vec![Payload::Frame(frame)]).unwrap()
}

fn feed_all(node: &mut SurrogateNode, frames: impl IntoIterator<Item = Frame>) -> Vec<Frame> {
    frames.into_iter().flat_map(|frame| feed(node, frame)).collect()
}

/// The prediction of the surrogate itself after these frames.
fn directly(frames: impl IntoIterator<Item = Frame>) -> (Stepper, HiddenState, Frame) {
    let surrogate = surrogate();
    let mut frames = frames.into_iter();
    let first = frames.next().unwrap();
    let mut memory = surrogate.start(&first).unwrap();
    let mut stepper = surrogate.stepper();
    let mut predicted = stepper.step(&mut memory, &first);
    for frame in frames {
        predicted = stepper.step(&mut memory, &frame);
    }
    (stepper, memory, predicted)
}

#[test]
fn predictions_begin_with_the_last_frame_of_the_warm_up() {
    let mut node = node(NodeSettings::default());
    let predictions = feed_all(&mut node, (0..6).map(|s| frame(1, s)));
    let sequences: Vec<_> = predictions.iter().map(|p| p.sequence).collect();
    assert_eq!(sequences, [3, 4, 5, 6]);
    assert_eq!(predictions[0].stamp, frame(1, 3).stamp);
    assert_eq!(predictions[3], directly((0..6).map(|s| frame(1, s))).2);
}

#[test]
fn the_horizon_is_reached_by_a_copy_of_the_state() {
    let far = NodeSettings { horizon: 5, publish: Publish::All, ..NodeSettings::default() };
    let (mut near, mut far) = (node(NodeSettings::default()), node(far));
    for sequence in 0..10 {
        let near = feed(&mut near, frame(1, sequence));
        let far = feed(&mut far, frame(1, sequence));
        assert_eq!(near.first(), far.first());
        if sequence + 1 >= WARM_UP {
            let ahead: Vec<_> = far.iter().map(|p| p.sequence - sequence).collect();
            assert_eq!(ahead, [1, 2, 3, 4, 5]);
        }
    }
    let last = NodeSettings { horizon: 5, ..NodeSettings::default() };
    let predictions = feed_all(&mut node(last), (0..3).map(|s| frame(1, s)));
    let (mut stepper, mut memory, mut expected) = directly((0..3).map(|s| frame(1, s)));
    for _ in 1..5 {
        expected = stepper.step(&mut memory, &expected);
    }
    assert_eq!(predictions, [expected]);
}

#[test]
fn streams_do_not_touch_each_other() {
    let mut alone = node(NodeSettings::default());
    let expected = feed_all(&mut alone, (0..8).map(|s| frame(1, s)));
    let mut both = node(NodeSettings::default());
    let woven = (0..8).flat_map(|s| [frame(1, s), frame(2, s)]);
    let mut found = feed_all(&mut both, woven);
    found.retain(|prediction| prediction.stream == 1);
    assert_eq!(found, expected);
}

/// Frames of several streams, some with gaps, restarts, late starts and rejected frames.
fn crowd() -> Vec<Frame> {
    let mut frames = Vec::new();
    for sequence in 0..12 {
        for stream in 0..9 {
            let missing =
                (stream == 3 && sequence == 6) || (stream == 4 && (5..10).contains(&sequence));
            let begun = stream != 7 || sequence >= 5;
            if begun && !missing {
                frames.push(frame(stream, sequence));
            }
        }
        if sequence % 4 == 3 {
            frames.push(frame(1, sequence));
            frames.push(frame(2, sequence - 2));
        }
    }
    frames.extend((0..3).flat_map(|sequence| (0..3).map(move |stream| frame(stream, sequence))));
    frames
}

#[test]
fn frames_that_arrive_together_give_the_same_predictions_as_one_by_one() {
    let threads = [1, 2, 5];
    for (horizon, publish, max_streams) in [
        (1, Publish::Last, 64),
        (4, Publish::Last, 64),
        (3, Publish::All, 64),
        (2, Publish::All, 6),
    ] {
        let settings = NodeSettings { horizon, publish, max_streams, ..NodeSettings::default() };
        let mut alone = node(settings.clone());
        let mut expected = Vec::new();
        for frame in crowd() {
            expected.extend(observe(&mut alone, vec![Payload::Frame(frame)]).unwrap_or_default());
        }
        for (together, threads) in [2, 7, 64].into_iter().zip(threads) {
            let surrogate = surrogate_on(NonZeroUsize::new(threads));
            let mut node = SurrogateNode::new(surrogate, settings.clone()).unwrap();
            let mut found = Vec::new();
            for frames in crowd().chunks(together) {
                let mut arrivals: Vec<_> =
                    frames.iter().map(|f| (Duration::ZERO, Payload::Frame(f.clone()))).collect();
                node.on_frames(&mut arrivals, None, &mut |_, result| {
                    found.extend(result.ok().map(|prediction| prediction.frame.clone()));
                });
            }
            assert_eq!(found, expected, "{together} together on {threads} threads");
            assert_eq!(node.counters(), alone.counters());
        }
    }
}

#[test]
#[expect(clippy::too_many_lines, reason = "one story: streams, a flood, what each has received")]
fn a_flooding_stream_does_not_affect_the_others() {
    const ROUNDS: u64 = 30;
    let transports = Transports::new(TransportOptions::new("flood"));
    let [input, output, status] = ["/in", "/out", "/status"].map(Link::memory);
    let publisher = |link, kind| transports.publisher(link, kind, Reliability::Block).unwrap();
    let read = transports.subscriber(&input, ParticleFrame::TYPE).unwrap();
    let mut predicted = transports.subscriber(&output, ParticleFrame::TYPE).unwrap();
    let [mut fast, mut slow] = [(); 2].map(|()| publisher(&input, ParticleFrame::TYPE));
    let mut outputs = [Outputs::new(
        publisher(&output, ParticleFrame::TYPE),
        publisher(&status, PredictionStatus::TYPE),
    )];
    let mut context = NodeContext {
        name: "/node".into(),
        input: input.clone(),
        time: RosTime::system(),
        group: None,
    };
    let mut node = node(NodeSettings::default());
    let queue = FrameQueue::new(40, Reliability::Drop);
    let (stop, handle) = (AtomicBool::new(false), NodeHandle::default());
    thread::scope(|scope| {
        let (queue, stop) = (&queue, &stop);
        let (node, outputs, handle) = (&mut node, &mut outputs[..], &handle);
        let context = &mut context;
        let driving = scope.spawn(move || {
            // Dropped at the end, so that the flooding publisher does not wait for a reader.
            let mut read = read;
            drive(node, context, &mut *read, outputs, queue, handle, stop)
        });
        scope.spawn(move || {
            for sequence in 0.. {
                if stop.load(Ordering::Relaxed) {
                    break;
                }
                fast.publish_frame(&frame(0, sequence)).unwrap();
            }
        });
        let deadline = clock::Clock::start();
        let mut rounds = 0;
        // Until messages are dropped.
        while rounds < ROUNDS || queue.dropped() == 0 {
            (1..8).for_each(|stream| slow.publish_frame(&frame(stream, rounds)).unwrap());
            rounds += 1;
            let mut missing = if rounds < WARM_UP { 0 } else { 7 };
            while missing > 0 {
                assert!(deadline.now() < Duration::from_secs(60), "{missing} are missing");
                let Some(payload) = predicted.receive(Duration::from_millis(50)).unwrap() else {
                    continue;
                };
                let frame = payload.into_frame().unwrap();
                if frame.stream > 0 {
                    assert_eq!(frame.sequence, rounds);
                    missing -= 1;
                }
            }
        }
        stop.store(true, Ordering::Relaxed);
        // The node may be waiting for a reader of its predictions.
        while !driving.is_finished() {
            predicted.receive(Duration::from_millis(20)).unwrap();
        }
    });
    let lost = queue.dropped_by_stream();
    assert_eq!(lost.keys().collect::<Vec<_>>(), [&0], "{lost:?}");
    assert_eq!(lost[&0], queue.dropped());
}

#[test]
fn a_short_gap_is_filled_with_the_models_own_prediction() {
    let mut node = node(NodeSettings::default());
    feed_all(&mut node, (0..5).map(|s| frame(1, s)));
    let found = feed(&mut node, frame(1, 8));

    let (mut stepper, mut memory, mut predicted) = directly((0..5).map(|s| frame(1, s)));
    for _ in 0..3 {
        predicted = stepper.step(&mut memory, &predicted);
    }
    assert_eq!(found, [stepper.step(&mut memory, &frame(1, 8))]);
    assert_eq!(node.counters().filled, 3);
    assert_eq!(node.counters().resets, 0);
}

#[test]
fn a_long_gap_resets_the_stream() {
    let mut node = node(NodeSettings::default());
    feed_all(&mut node, (0..5).map(|s| frame(1, s)));
    let found = feed_all(&mut node, (9..12).map(|s| frame(1, s)));
    assert_eq!(found, [directly((9..12).map(|s| frame(1, s))).2]);
    assert_eq!((node.counters().lost_in_gaps, node.counters().resets), (4, 1));
}

#[test]
fn duplicates_and_late_frames_are_dropped_and_change_nothing() {
    let mut plain = node(NodeSettings::default());
    let expected = feed_all(&mut plain, (0..6).map(|s| frame(1, s)));
    let mut node = node(NodeSettings::default());
    let mut found = feed_all(&mut node, (0..5).map(|s| frame(1, s)));
    for late in [4, 2] {
        let rejection = observe(&mut node, vec![Payload::Frame(frame(1, late))]).unwrap_err();
        assert!(
            matches!(rejection, Rejection::Late { found, expected: 5 } if found == late),
            "{rejection}"
        );
    }
    found.extend(feed(&mut node, frame(1, 5)));
    assert_eq!(found, expected);
    assert_eq!(node.counters().late, 2);
}

#[test]
fn frames_of_three_dimensions_are_refused_and_change_nothing() {
    let mut plain = node(NodeSettings::default());
    let expected = feed_all(&mut plain, (0..6).map(|s| frame(1, s)));
    let mut node = node(NodeSettings::default());
    let mut found = feed_all(&mut node, (0..3).map(|s| frame(1, s)));
    let Frame { stream, sequence, stamp, dt, material, .. } = frame(1, 3);
    let (position, velocity) = (vec![[0.5; 3]; material.len()], vec![[0.0; 3]; material.len()]);
    let domain = Domain { lower: [0.0; 3], upper: [1.0; 3] };
    let deep = Frame { stream, sequence, stamp, dt, domain, position, velocity, material };
    let refused = observe(&mut node, vec![Payload::Cdr(deep.to_cdr())]).unwrap_err();
    assert_eq!(refused.to_string(), "lower: found 3 dimensions, expected 2");
    assert_eq!(node.counters().malformed, 1);
    found.extend(feed_all(&mut node, (3..6).map(|s| frame(1, s))));
    assert_eq!(found, expected);
}

#[test]
fn a_looped_bag_resets_the_stream() {
    let mut node = node(NodeSettings::default());
    feed_all(&mut node, (0..30).map(|s| frame(1, s)));
    let found = feed_all(&mut node, (0..3).map(|s| frame(1, s)));
    assert_eq!(found, [directly((0..3).map(|s| frame(1, s))).2]);
    assert_eq!(node.counters().resets, 1);
}

#[test]
fn different_particles_reset_the_stream() {
    let mut node = node(NodeSettings::default());
    feed_all(&mut node, (0..5).map(|s| frame(1, s)));
    let one_particle = |sequence| {
        let mut frame = frame(1, sequence);
        frame.position.truncate(1);
        frame.velocity.truncate(1);
        frame.material.truncate(1);
        frame
    };
    let found = feed_all(&mut node, (5..8).map(one_particle));
    assert_eq!(found, [directly((5..8).map(one_particle)).2]);
    assert_eq!(node.counters().resets, 1);

    feed_all(&mut node, [frame(1, 8), one_particle(9)]);
    let said = node.warnings().iter().filter(|(_, said)| said.contains("number of particles"));
    assert_eq!(said.count(), 1, "once a stream: {:?}", node.warnings());
}

#[test]
fn invalid_frames_are_counted_by_fault_and_change_nothing() {
    type Fault = fn(&mut Frame);
    type Counter = fn(&Counters) -> u64;
    let faults: [(Fault, Counter); 5] = [
        (|f| f.position[0][0] = f32::NAN, |c| c.not_finite),
        (|f| f.velocity.truncate(1), |c| c.malformed),
        (|f| f.dt = 0.0161, |c| c.wrong_interval),
        (|f| f.material[0] = Material::Snow, |c| c.wrong_particles),
        (|f| f.domain.upper = [1e6; 2], |c| c.wrong_particles),
    ];
    let mut plain = node(NodeSettings::default());
    let expected = feed_all(&mut plain, (0..5).map(|s| frame(1, s)));
    for (fault, counter) in faults {
        let mut node = node(NodeSettings::default());
        let mut found = feed_all(&mut node, (0..4).map(|s| frame(1, s)));
        let mut bad = frame(1, 4);
        fault(&mut bad);
        observe(&mut node, vec![Payload::Cdr(bad.to_cdr())]).unwrap_err();
        assert_eq!(counter(node.counters()), 1);
        found.extend(feed(&mut node, frame(1, 4)));
        assert_eq!(found, expected);
    }
    let mut node = node(NodeSettings::default());
    observe(&mut node, vec![Payload::Cdr(vec![1, 2, 3])]).unwrap_err();
    assert_eq!(node.counters().undecodable, 1);
}

#[test]
fn the_least_recently_used_stream_is_forgotten() {
    let mut node = node(NodeSettings { max_streams: 2, ..NodeSettings::default() });
    // All at one instant, as in `eddy predict`: the order of use decides, not the time.
    for (sequence, stream) in [(0, 1), (1, 2), (1, 1), (3, 3)] {
        feed(&mut node, frame(stream, sequence));
    }
    assert_eq!((node.streams(), node.counters().forgotten_streams), (2, 1));
    // Stream 1 was used after stream 2: it is still there, and its third frame ends its warm-up.
    assert_eq!(feed(&mut node, frame(1, 2)).len(), 1);
}

#[test]
fn a_stream_that_another_member_owns_is_forgotten_and_warms_up_when_it_comes_back() {
    let mut node = node(NodeSettings::default());
    for sequence in 0..WARM_UP {
        for stream in [1, 2] {
            feed(&mut node, frame(stream, sequence));
        }
    }
    node.hand_over(|stream| stream == 1);
    assert_eq!((node.streams(), node.counters().handed_over), (1, 1));
    assert_eq!(feed(&mut node, frame(1, WARM_UP)).len(), 1);
    assert_eq!(feed(&mut node, frame(2, WARM_UP)).len(), 0);
}

#[test]
fn a_prediction_that_is_not_finite_is_never_published() {
    let mut checkpoint = checkpoint();
    // A particle alone flies whatever the network predicts.
    checkpoint.description.rules = Rules::default();
    // Sums of infinities of both signs.
    let weights = checkpoint.tensors.values_mut().flat_map(|tensor| &mut tensor.values);
    weights.for_each(|weight| *weight *= 1e30);
    let surrogate = Surrogate::load(&checkpoint, None).unwrap();
    let mut node = SurrogateNode::new(surrogate, NodeSettings::default()).unwrap();
    assert_eq!(feed_all(&mut node, (0..8).map(|s| frame(1, s))), []);
    assert!(node.counters().diverged > 0);
}

#[test]
fn settings_out_of_range_are_named() {
    let settings = NodeSettings { horizon: 0, ..NodeSettings::default() };
    let error = SurrogateNode::new(surrogate(), settings).err().unwrap();
    assert_eq!(error.to_string(), "horizon: found 0, expected 1 to 10000");
}

#[test]
fn a_model_conditioned_on_the_stiffness_requires_the_setting_and_others_refuse_it() {
    let mut description = checkpoint().description;
    description.stiffness = true;
    // A particle alone flies whatever the network predicts.
    description.rules = Rules::default();
    let mut conditioned = Checkpoint::new(description.clone(), initial_weights(&description, 1));
    let decoder = conditioned.tensors.get_mut("decoder.weight").unwrap();
    decoder.values.clone_from(&checkpoint().tensors["decoder.weight"].values);
    let conditioned = Surrogate::load(&conditioned, None).unwrap();
    let node = |surrogate: &Surrogate, stiffness| {
        let settings = NodeSettings { stiffness, ..NodeSettings::default() };
        SurrogateNode::new(surrogate.clone(), settings).map_err(|error| error.to_string())
    };
    let refused = |surrogate, stiffness| node(surrogate, stiffness).err().unwrap();
    assert!(
        refused(&conditioned, None)
            .starts_with("stiffness: found nothing, expected Young's modulus")
    );
    assert!(
        refused(&conditioned, Some(0.0))
            .starts_with("stiffness: found 0, expected Young's modulus")
    );
    assert!(
        refused(&conditioned, Some(-1.0))
            .starts_with("stiffness: found -1, expected 0 to 1000000000")
    );
    let expected = "stiffness: found 1000, expected nothing: the checkpoint does not use it";
    assert_eq!(refused(&surrogate(), Some(1e3)), expected);

    let predicted = |stiffness: f32| {
        let mut node = node(&conditioned, Some(stiffness.into())).unwrap();
        let found = feed_all(&mut node, (0..WARM_UP).map(|n| frame(1, n)));
        let mut memory = conditioned.start_with_stiffness(&frame(1, 0), Some(stiffness)).unwrap();
        let mut stepper = conditioned.stepper();
        let expected = (0..WARM_UP).map(|n| stepper.step(&mut memory, &frame(1, n))).last();
        assert_eq!(found, expected.into_iter().collect::<Vec<_>>());
        found
    };
    assert_ne!(predicted(1e3), predicted(1e5));
}

#[test]
fn frames_in_other_units_are_counted_and_not_predicted() {
    let mut node = node(NodeSettings::default());
    feed_all(&mut node, (0..4).map(|s| frame(1, s)));
    let scaled = |positions: f32, shift: f32, velocities: f32| {
        let mut frame = frame(1, 4);
        frame.position.iter_mut().flatten().for_each(|x| *x = *x * positions + shift);
        frame.velocity.iter_mut().flatten().for_each(|v| *v *= velocities);
        Payload::Frame(frame)
    };
    for (payload, expected) in [
        (scaled(1.0, 0.8, 1.0), "expected inside the domain 0 to 1 x 0 to 1"),
        (scaled(1000.0, 0.0, 1.0), "expected inside the domain"),
        (scaled(1e30, 0.0, 1.0), "expected inside the domain"),
        (scaled(1.0, 0.0, 20.0), "expected at most 2.00, twice the largest in training: units?"),
        (scaled(1.0, 0.0, 1000.0), "twice through the domain in"),
    ] {
        let message = observe(&mut node, vec![payload]).unwrap_err().to_string();
        assert!(message.contains(expected) && message.ends_with("units?"), "{message}");
    }
    let Counters { outside_domain, too_fast, malformed, resets, .. } = *node.counters();
    assert_eq!((outside_domain, too_fast, malformed, resets), (3, 2, 0, 0));
    assert_eq!(feed_all(&mut node, [frame(1, 4)]).len(), 1, "the stream goes on");
}

#[test]
fn an_interval_that_is_not_positive_is_counted_as_a_wrong_one() {
    let mut node = node(NodeSettings::default());
    for dt in [0.0, -0.016] {
        let message = ParticleFrame { dt, ..ParticleFrame::from(&frame(1, 0)) };
        let payload = Payload::Cdr(eddy_messages::cdr::encode(&message));
        assert!(observe(&mut node, vec![payload]).is_err());
    }
    assert_eq!((node.counters().wrong_interval, node.counters().malformed), (2, 0));
}

#[test]
fn a_stop_gives_up_predictions_far_ahead() {
    let stop = std::sync::Arc::<AtomicBool>::default();
    let far = NodeSettings { horizon: 10_000, publish: Publish::All, ..NodeSettings::default() };
    let mut node = node(far);
    node.stop_with(stop.clone());
    feed_all(&mut node, (0..WARM_UP - 1).map(|s| frame(1, s)));
    stop.store(true, Ordering::Relaxed);
    assert_eq!(feed(&mut node, frame(1, WARM_UP - 1)), []);
    assert_eq!((node.counters().diverged, node.counters().resets), (0, 0));
    stop.store(false, Ordering::Relaxed);
    assert_eq!(feed(&mut node, frame(1, WARM_UP)).len(), 10_000, "the stream goes on");
}

/// Frames received and predicted of 2,000 that arrive every 16 ms at a node that needs 26 ms for a frame, observed or
/// filled in: 100,000 particles on two cores.
fn overloaded(max_gap: u64) -> [u64; 2] {
    const SOURCE: u64 = 16;
    const MODEL: u64 = 26;
    let mut node = node(NodeSettings { max_gap, ..NodeSettings::default() });
    let queue = FrameQueue::new(node.settings().queue, Reliability::Drop);
    let (mut arrived, mut now, mut predicted) = (0, 0, 0);
    while arrived < 2_000 {
        while arrived * SOURCE <= now {
            queue.push(Duration::ZERO, Payload::Frame(frame(0, arrived)));
            arrived += 1;
        }
        let Some((_, payload)) = queue.pop(Duration::ZERO) else {
            now = arrived * SOURCE;
            continue;
        };
        let before = node.counters().filled;
        predicted += observe(&mut node, vec![payload]).unwrap().len() as u64;
        now += MODEL * (1 + node.counters().filled - before);
    }
    [node.counters().received, predicted]
}

#[test]
fn filling_gaps_costs_an_overloaded_node_no_observed_frame() {
    let [filling, resetting] = [3, 0].map(overloaded);
    assert!(filling[0] >= resetting[0] && filling[1] >= resetting[1], "{filling:?} {resetting:?}");
    // All but a few of the frames that the model has time for are predicted from: 16 / 26 of those that arrive.
    assert!(filling[1] > 1_100, "{filling:?}");
}
