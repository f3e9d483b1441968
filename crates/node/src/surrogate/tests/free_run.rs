//! Free runs: predictions at dt without input.

use std::time::Duration;

use super::*;

#[test]
fn a_free_run_continues_at_dt_without_input() {
    let mut node = node(NodeSettings { free_run: Some(4), ..NodeSettings::default() });
    let observed = feed_all(&mut node, (0..4).map(|s| frame(1, s)));
    assert_eq!(observed.len(), 1, "tracking ends where the free run begins");

    let (mut stepper, mut memory, mut expected) = directly((0..4).map(|s| frame(1, s)));
    for number in 1..=3u32 {
        let due = node.next_tick().unwrap();
        assert_eq!(due, number * Duration::from_millis(16));
        node.on_tick(due - Duration::from_millis(1), &mut |_, result| {
            panic!("too early: {result:?}")
        });
        let mut published = 0;
        node.on_tick(due, &mut |_, result| {
            let prediction = result.unwrap();
            assert_eq!(*prediction.frame, expected);
            assert_eq!(prediction.state, StreamState::FreeRunning);
            assert_eq!((prediction.source_sequence, prediction.horizon), (3, number));
            published += 1;
        });
        assert_eq!(published, 1);
        expected = stepper.step(&mut memory, &expected);
    }
    let rejection = observe(&mut node, vec![Payload::Frame(frame(1, 4))]).unwrap_err();
    assert!(matches!(rejection, Rejection::FreeRunning { found: 4 }), "{rejection}");
}

#[test]
fn a_looped_source_ends_a_free_run() {
    let mut node = node(NodeSettings { free_run: Some(20), ..NodeSettings::default() });
    feed_all(&mut node, (0..20).map(|s| frame(1, s)));
    assert!(node.next_tick().is_some());
    assert_eq!(feed_all(&mut node, (0..3).map(|s| frame(1, s))).len(), 1);
    assert_eq!(node.next_tick(), None);
}

#[test]
fn a_free_run_keeps_its_pace_when_the_time_becomes_another_one() {
    let mut node = node(NodeSettings { free_run: Some(3), ..NodeSettings::default() });
    feed_all(&mut node, (0..3).map(|n| frame(1, n)));
    assert_eq!(node.next_tick(), Some(Duration::from_millis(16)));
    // 10 ms before the frame is due it is 100 s instead, and later 1 s.
    node.shift_time(Duration::from_millis(6), Duration::from_secs(100));
    assert_eq!(node.next_tick(), Some(Duration::from_millis(100_010)));
    node.shift_time(Duration::from_millis(100_004), Duration::from_secs(1));
    assert_eq!(node.next_tick(), Some(Duration::from_millis(1_006)));
}

/// The frames of a free run that are published until none is due at `now`.
fn ticks(node: &mut SurrogateNode, now: Duration) -> Vec<u64> {
    let mut published = Vec::new();
    while node.next_tick().is_some_and(|due| due <= now) {
        node.on_tick(now, &mut |_, outcome| published.push(outcome.unwrap().frame.sequence));
        assert!(published.len() < 1_000, "a flood of frames");
    }
    published
}

#[test]
fn a_free_run_makes_up_for_a_hiccup_and_skips_a_jump_of_the_clock() {
    let mut node = node(NodeSettings { free_run: Some(3), ..NodeSettings::default() });
    feed_all(&mut node, (0..3).map(|s| frame(1, s)));
    let interval = Duration::from_millis(16);
    assert_eq!(ticks(&mut node, interval), [3]);
    assert_eq!(ticks(&mut node, interval * 11), (4..=13).collect::<Vec<_>>(), "ten are made up");
    assert_eq!(node.counters().skipped_in_free_run, 0);
    // A minute ahead: 3,750 frames.
    let jump = interval * 11 + Duration::from_secs(60);
    assert_eq!(ticks(&mut node, jump), [14]);
    assert_eq!(node.counters().skipped_in_free_run, 3_749);
    // At the old pace, in the old phase, without a gap in the sequence.
    assert_eq!(node.next_tick(), Some(jump + interval));
    assert_eq!(ticks(&mut node, jump + interval * 2), [15, 16]);
    // Eleven days, and as far as time goes.
    let days = jump + Duration::from_secs(11 * 86_400);
    assert_eq!(ticks(&mut node, days).len(), 1);
    assert_eq!(ticks(&mut node, Duration::MAX - interval * 2).len(), 1);
}
