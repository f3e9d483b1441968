//! Shared memory: killed processes, and services created by other programs.

use std::{
    thread,
    time::{Duration, Instant},
};

use eddy_messages::{FrameCdr as _, Message, ParticleFrame};
use eddy_transport::{Link, Payload, Reliability, TransportKind, TransportOptions, Transports};
use iceoryx2::prelude::*;

use super::{
    DEADLINE, child::Process, eventually, expect_frame, frame, frames_publisher, frames_subscriber,
    in_space, link, next_frame, next_in_space, options,
};

#[test]
fn a_killed_subscriber_frees_the_publisher_that_waits_for_it() {
    let (options, link) = (options(), link("shm"));
    let patience = options.patience;
    let transports = Transports::new(options.clone());
    let mut publisher = frames_publisher(&transports, &link, Reliability::Block);
    let stalled = Process::start("stall", &link, &options);
    stalled.says("ready");
    eventually("the subscriber is seen", || publisher.subscribers() == 1);
    publisher.publish_frame(&frame(0, 10)).unwrap();
    stalled.says("frame 0");
    let publishing = thread::spawn(move || {
        let start = Instant::now();
        for sequence in 1..200 {
            publisher.publish_frame(&frame(sequence, 10)).unwrap();
        }
        (publisher, start.elapsed())
    });
    // Longer than it takes to fill the buffer.
    thread::sleep(Duration::from_millis(300));
    assert!(
        !publishing.is_finished(),
        "the publisher did not wait for a subscriber that reads nothing"
    );
    stalled.kill();
    let (mut publisher, waited) = publishing.join().unwrap();
    assert!(waited < patience, "waited {waited:?} for a dead subscriber");
    eventually("the dead subscriber is forgotten", || publisher.subscribers() == 0);

    let again = Process::start("subscribe", &link, &options);
    again.says("ready");
    eventually("the new subscriber is seen", || publisher.subscribers() == 1);
    publisher.publish_frame(&frame(200, 10)).unwrap();
    again.says("frame 200");
}

#[test]
fn a_killed_publisher_leaves_its_subscriber_running_and_works_again_when_restarted() {
    let (options, link) = (options(), link("shm"));
    let transports = Transports::new(options.clone());
    let mut subscriber = frames_subscriber(&transports, &link);
    // More often than the largest number of publishers of a topic.
    for _ in 0..10 {
        let publisher = Process::start("publish", &link, &options);
        eventually("the publisher's first frame", || next_frame(&mut *subscriber).sequence == 0);
        for sequence in 1..5 {
            assert_eq!(next_frame(&mut *subscriber).sequence, sequence);
        }
        publisher.kill();
    }
    let mut publisher = frames_publisher(&transports, &link, Reliability::Block);
    publisher.publish_frame(&frame(u64::MAX - 1, 10)).unwrap();
    eventually("our own frame", || next_frame(&mut *subscriber).sequence == u64::MAX - 1);
}

#[test]
fn no_frame_of_three_dimensions_is_lost_between_three_processes() {
    let (options, link) = (options(), link("shm"));
    let transports = Transports::new(options.clone());
    let mut subscriber = frames_subscriber(&transports, &link);
    let other = Process::start("subscribe", &link, &options);
    other.says("ready");
    let _publisher = Process::start("publish-in-space", &link, &options);
    for sequence in 0..300 {
        let found = next_in_space(&mut *subscriber);
        assert_eq!(found, in_space(sequence, 5_000), "frame {sequence}");
        assert_eq!(other.says("frame "), format!("frame {sequence}"));
    }
}

#[test]
fn frames_outlive_the_publisher_that_sent_them() {
    let (options, link) = (options(), link("shm"));
    let there = Transports::new(options.clone());
    let mut subscriber = frames_subscriber(&there, &link);
    let here = Transports::new(options);
    let mut publisher = frames_publisher(&here, &link, Reliability::Block);
    publisher.publish_frame(&frame(0, 2_500)).unwrap();
    expect_frame(&mut *subscriber, &frame(0, 2_500));
    for sequence in 1..10 {
        publisher.publish_frame(&frame(sequence, 2_500)).unwrap();
    }
    drop((publisher, here));
    for sequence in 1..10 {
        expect_frame(&mut *subscriber, &frame(sequence, 2_500));
    }
}

#[test]
fn memory_grows_with_the_frame_and_is_reported() {
    for reliability in [Reliability::Block, Reliability::Drop] {
        let (options, link) = (options(), link("shm"));
        let [here, there] = [Transports::new(options.clone()), Transports::new(options)];
        let mut subscriber = frames_subscriber(&there, &link);
        let mut publisher = frames_publisher(&here, &link, reliability);
        let memory = || there.shared_memory(&link, ParticleFrame::TYPE).unwrap().unwrap();
        let mut reported = Vec::new();
        for (sequence, particles) in (0..).zip([2_500, 100_000, 2_500, 100_000]) {
            let sent = frame(sequence, particles);
            publisher.publish_frame(&sent).unwrap();
            expect_frame(&mut *subscriber, &sent);
            assert_eq!((memory().publishers, memory().subscribers), (1, 1));
            reported.push(memory().bytes / 1_000_000);
        }
        // As many messages of 2,560 particles as subscribers can hold; 51 of the next power of two.
        assert_eq!(reported, [16, 133, 133, 133]);
        let sent = in_space(4, 2_500);
        publisher.publish_cdr(&sent.to_cdr()).unwrap();
        assert_eq!(next_in_space(&mut *subscriber), sent);
        assert_eq!((memory().publishers, memory().subscribers), (1, 1));
        assert_eq!(memory().bytes / 1_000_000, 156, "as many messages of 2,560 larger particles");
    }
}

#[test]
fn frames_are_lent_until_too_many_are_kept_then_copied() {
    let (options, link) = (options(), link("shm"));
    let [here, there] = [Transports::new(options.clone()), Transports::new(options)];
    let mut subscriber = frames_subscriber(&there, &link);
    let mut publisher = frames_publisher(&here, &link, Reliability::Block);
    let mut receive = |sequence| {
        publisher.publish_frame(&frame(sequence, 50)).unwrap();
        subscriber.receive(DEADLINE).unwrap().unwrap()
    };
    let lent = |payload: &Payload| matches!(payload, Payload::Shared(_));
    let mut kept: Vec<_> = (0..100).map(&mut receive).collect();
    assert_eq!(kept.iter().filter(|payload| lent(payload)).count(), 7);
    assert!(kept[..7].iter().all(lent));
    for (sequence, payload) in kept.iter().enumerate() {
        assert!(*payload == Payload::Frame(frame(sequence as u64, 50)), "frame {sequence}");
    }
    kept.remove(3);
    assert!(lent(&receive(100)), "one was given back");
}

#[test]
fn a_subscriber_that_receives_nothing_never_blocks_a_dropping_publisher() {
    let (options, link) = (options(), link("shm"));
    let transports = Transports::new(options.clone());
    let mut publisher = frames_publisher(&transports, &link, Reliability::Drop);
    let mut reader = frames_subscriber(&Transports::new(options.clone()), &link);
    let stalled = Process::start("stall", &link, &options);
    stalled.says("ready");
    eventually("both subscribers are seen", || publisher.subscribers() == 2);
    let start = Instant::now();
    for sequence in 0..500 {
        // More than there are slots of this size; the stalled subscriber holds some of them.
        let sent = frame(sequence, 50_000);
        publisher.publish_frame(&sent).unwrap();
        assert_eq!(next_frame(&mut *reader).sequence, sequence);
    }
    assert!(start.elapsed() < DEADLINE, "{:?}", start.elapsed());
    stalled.kill();
    eventually("the killed subscriber is forgotten", || publisher.subscribers() == 1);
}

#[test]
fn domains_do_not_mix() {
    let link = link("shm");
    let in_domain = |domain_id| Transports::new(TransportOptions { domain_id, ..options() });
    let [here, there, elsewhere] = [3, 3, 0].map(in_domain);
    let mut same = frames_subscriber(&there, &link);
    let mut other = frames_subscriber(&elsewhere, &link);
    let mut publisher = frames_publisher(&here, &link, Reliability::Block);
    assert_eq!(publisher.subscribers(), 1);
    publisher.publish_frame(&frame(0, 1)).unwrap();
    expect_frame(&mut *same, &frame(0, 1));
    assert_eq!(other.receive(Duration::from_millis(200)).unwrap(), None);
    let lists = |transports: &Transports| {
        let topics = transports.topics(TransportKind::Shm).unwrap();
        topics.iter().any(|topic| topic.link == link)
    };
    assert!(lists(&here) && lists(&elsewhere));
    drop((other, elsewhere));
    eventually("the topic of domain 0 is gone", || !lists(&in_domain(0)));
    assert!(lists(&there) && !lists(&in_domain(30)));
}

#[test]
fn the_last_message_waits_for_a_subscriber_that_polls_late() {
    let (options, link) = (options(), link("shm"));
    let transports = Transports::new(options);
    let mut subscriber = frames_subscriber(&transports, &link);
    thread::scope(|scope| {
        scope.spawn(|| {
            let mut publisher = frames_publisher(&transports, &link, Reliability::Block);
            publisher.publish_frame(&frame(0, 10)).unwrap();
            publisher.flush().unwrap();
        });
        // Many times as long as publishing takes, and a small part of what the publisher lingers.
        thread::sleep(Duration::from_millis(20));
        expect_frame(&mut *subscriber, &frame(0, 10));
    });
}

/// The superuser plays another user; others cannot.
#[test]
fn files_of_another_user_are_an_error_that_says_whose_they_are() {
    if !rustix::process::geteuid().is_root() {
        println!("not tried: this user cannot become another one");
        return;
    }
    let (options, link) = (options(), link("shm"));
    let transports = Transports::new(options.clone());
    let _publisher = frames_publisher(&transports, &link, Reliability::Block);
    let other = Process::start_as(65_534, "refused", &link, &options);
    let said = other.says("of the user with id 0");
    let expected = "expected files of the user with id 65534";
    assert!(said.starts_with(&format!("{link}: found /")) && said.contains(expected), "{said}");
}

/// The documented layout, declared as another program would.
#[derive(Debug, Clone, Copy, ZeroCopySend)]
#[type_name("eddy::Particle")]
#[repr(C)]
struct Particle {
    x: f32,
    y: f32,
    vx: f32,
    vy: f32,
    material: u32,
}

#[derive(Debug, Default, Clone, Copy, ZeroCopySend)]
#[type_name("eddy::FrameHeader")]
#[repr(C)]
struct FrameHeader {
    stream: u64,
    sequence: u64,
    stamp_ns: i64,
    dt: f32,
    lower: [f32; 2],
    upper: [f32; 2],
}

/// In domain 0.
fn service_name(link: &Link) -> ServiceName {
    format!("eddy{}", link.topic).as_str().try_into().unwrap()
}

#[test]
fn a_service_created_by_another_program_is_used_as_it_is() {
    let link = link("shm");
    let node = NodeBuilder::new().create::<ipc::Service>().unwrap();
    // With iceoryx2's defaults: a buffer of two, the oldest overwritten.
    let service = node
        .service_builder(&service_name(&link))
        .publish_subscribe::<[Particle]>()
        .user_header::<FrameHeader>()
        .create()
        .unwrap();
    let foreign_publisher = service.publisher_builder().initial_max_slice_len(2).create().unwrap();
    let foreign_subscriber = service.subscriber_builder().create().unwrap();

    let transports = Transports::new(options());
    let mut subscriber = frames_subscriber(&transports, &link);
    let mut publisher = frames_publisher(&transports, &link, Reliability::Drop);

    let sent = frame(5, 3);
    publisher.publish_frame(&sent).unwrap();
    expect_frame(&mut *subscriber, &sent);
    let sample = foreign_subscriber.receive().unwrap().unwrap();
    let header = sample.user_header();
    assert_eq!((header.stream, header.sequence, header.stamp_ns), (9, 5, 80_000_000));
    assert_eq!((header.dt, header.lower, header.upper), (0.016, [-0.5, 0.0], [1.0, 2.0]));
    let particle = sample.payload()[2];
    assert_eq!([particle.x, particle.y], sent.position[2]);
    assert_eq!([particle.vx, particle.vy], sent.velocity[2]);
    assert_eq!(particle.material, 2);

    // That program sends no wake-ups.
    let mut sample = foreign_publisher.loan_slice_uninit(2).unwrap();
    *sample.user_header_mut() =
        FrameHeader { dt: 0.016, sequence: 77, upper: [1.0; 2], ..Default::default() };
    let particle = |index| Particle { x: index as f32, y: 0.25, vx: 0.0, vy: -1.0, material: 3 };
    sample.write_from_fn(particle).send().unwrap();
    let received = next_frame(&mut *subscriber);
    assert_eq!((received.sequence, received.len()), (77, 2));
    assert_eq!(received.position, [[0.0, 0.25], [1.0, 0.25]]);

    // An invalid frame arrives as bytes; the next frame arrives too.
    let mut sample = foreign_publisher.loan_slice_uninit(1).unwrap();
    *sample.user_header_mut() = FrameHeader { dt: f32::NAN, upper: [1.0; 2], ..Default::default() };
    sample.write_from_fn(particle).send().unwrap();
    let mut bad = None;
    eventually("the bad frame arrives", || {
        bad = subscriber.receive(Duration::from_millis(10)).unwrap();
        bad.is_some()
    });
    let error = bad.unwrap().into_frame().unwrap_err();
    assert_eq!(error.to_string(), "dt: found NaN s, expected a positive number");
    publisher.publish_frame(&sent).unwrap();
    expect_frame(&mut *subscriber, &sent);
}

#[test]
fn a_service_of_another_layout_is_rejected_with_both_layouts() {
    let link = link("shm");
    let node = NodeBuilder::new().create::<ipc::Service>().unwrap();
    let _service =
        node.service_builder(&service_name(&link)).publish_subscribe::<u64>().create().unwrap();
    let transports = Transports::new(options());
    let error = transports.subscriber(&link, "eddy_msgs/msg/ParticleFrame").err().unwrap();
    let expected = "found message type u64 with header (), expected [eddy::Particle] with header eddy::FrameHeader";
    assert_eq!(error.to_string(), format!("{link}: {expected}"));
}
