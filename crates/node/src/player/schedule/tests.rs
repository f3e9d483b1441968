use std::path::Path;

use super::*;
use eddy_bag::{BagWriter, QosOverrides, WriterOptions};
use eddy_messages::{
    Message, QosProfile, RosString, cdr,
    qos::{DurabilityPolicy, HistoryPolicy},
    type_support,
};

const MILLISECOND: i64 = 1_000_000;

/// A bag with messages on `/a` at these times (ms), each with its time as text.
fn bag(directory: &Path, times: &[i64]) -> BagReader {
    let path = directory.join("bag");
    let mut writer = BagWriter::create(&path, WriterOptions::default()).unwrap();
    let topic = writer.topic("/a", RosString::TYPE).unwrap();
    for time in times {
        let stamp = Stamp(time * MILLISECOND);
        let data = cdr::encode(&RosString { data: time.to_string() });
        writer.write(topic, stamp, stamp, &data).unwrap();
    }
    writer.finish().unwrap();
    BagReader::open(&path).unwrap()
}

/// Plays for `limit` ms of a clock that jumps to the time when the next message is due. Returns playing time and
/// recorded time of each message (ms).
fn play(bag: &BagReader, options: PlayerOptions, limit: u64) -> Vec<(u64, i64)> {
    let mut player = Player::new(bag, options).unwrap();
    let (mut now, mut played) = (Duration::ZERO, Vec::new());
    while now <= Duration::from_millis(limit) {
        match player.poll(now).unwrap() {
            Due::Now(message) => {
                played.push((now.as_millis() as u64, message.log_time.0 / MILLISECOND));
            }
            Due::In(wait) => now += wait,
            Due::Never => break,
        }
    }
    played
}

#[test]
fn messages_are_due_as_they_were_recorded() {
    let directory = tempfile::tempdir().unwrap();
    let bag = bag(directory.path(), &[1000, 1016, 1100]);
    let played = play(&bag, PlayerOptions::default(), 10_000);
    assert_eq!(played, [(0, 1000), (16, 1016), (100, 1100)]);
}

#[test]
fn rate_offset_and_duration_count_in_recorded_time() {
    let directory = tempfile::tempdir().unwrap();
    let bag = bag(directory.path(), &[1000, 1020, 1040, 1060, 1080]);
    let options = PlayerOptions {
        rate: 2.0,
        start_offset: 0.010,
        duration: Some(0.050),
        ..PlayerOptions::default()
    };
    assert_eq!(play(&bag, options, 10_000), [(5, 1020), (15, 1040), (25, 1060)]);
}

#[test]
fn a_loop_continues_at_the_same_pace() {
    let directory = tempfile::tempdir().unwrap();
    let bag = bag(directory.path(), &[500, 520, 540]);
    let options = PlayerOptions { looped: true, ..PlayerOptions::default() };
    let played = play(&bag, options, 100);
    assert_eq!(played, [(0, 500), (20, 520), (40, 540), (60, 500), (80, 520), (100, 540)]);
}

#[test]
fn a_late_caller_gets_every_message_that_has_become_due() {
    let directory = tempfile::tempdir().unwrap();
    let bag = bag(directory.path(), &[0, 10, 20, 30]);
    let mut player = Player::new(&bag, PlayerOptions::default()).unwrap();
    let late = Duration::from_millis(25);
    let mut due = || match player.poll(late).unwrap() {
        Due::Now(message) => Some(message.log_time.0 / MILLISECOND),
        _ => None,
    };
    assert_eq!([due(), due(), due(), due()], [Some(0), Some(10), Some(20), None]);
    assert_eq!(player.poll(late).unwrap(), Due::In(Duration::from_millis(5)));
}

#[test]
fn a_paused_player_publishes_one_message_per_step_and_resumes_from_there() {
    let directory = tempfile::tempdir().unwrap();
    let bag = bag(directory.path(), &[0, 100, 200, 300]);
    let options = PlayerOptions { paused: true, ..PlayerOptions::default() };
    let mut player = Player::new(&bag, options).unwrap();
    let at = Duration::from_millis;
    assert_eq!(player.poll(at(50)).unwrap(), Due::In(PAUSED_POLL));
    assert_eq!(times(&player.execute(PlayerCommand::Next, at(50)).unwrap()), [0]);
    assert_eq!(times(&player.execute(PlayerCommand::Next, at(60)).unwrap()), [100]);
    assert_eq!(player.poll(at(5_000)).unwrap(), Due::In(PAUSED_POLL));
    assert_eq!(times(&player.execute(PlayerCommand::TogglePause, at(5_000)).unwrap()), [0; 0]);
    assert_eq!(player.poll(at(5_000)).unwrap(), Due::In(at(100)));
    assert!(matches!(player.poll(at(5_100)).unwrap(), Due::Now(_)));
    let outcome = player.execute(PlayerCommand::Faster, at(5_100)).unwrap().outcome;
    assert!((outcome.rate - 1.1).abs() < 1e-12);
    let Due::In(wait) = player.poll(at(5_100)).unwrap() else { panic!("too early") };
    assert!((wait.as_secs_f64() - 0.1 / 1.1).abs() < 1e-6, "{wait:?}");
}

/// Recorded times of the messages to publish at once (ms).
fn times(executed: &Executed) -> Vec<i64> {
    executed.messages.iter().map(|message| message.log_time.0 / MILLISECOND).collect()
}

/// Recorded time of the message that is due (ms).
fn due(player: &mut Player, now: u64) -> i64 {
    match player.poll(Duration::from_millis(now)).unwrap() {
        Due::Now(message) => message.log_time.0 / MILLISECOND,
        other => panic!("nothing is due: {other:?}"),
    }
}

/// Seeks a recorded time (ms); returns whether that was possible.
fn seek(player: &mut Player, to: i64, now: u64) -> bool {
    let seek = PlayerCommand::Seek(Stamp(to * MILLISECOND));
    player.execute(seek, Duration::from_millis(now)).unwrap().outcome.done
}

#[test]
fn seeking_forward_and_back_keeps_the_pace_of_the_recording() {
    let directory = tempfile::tempdir().unwrap();
    let bag = bag(directory.path(), &[1000, 1100, 1200, 1300, 1400]);
    let mut player = Player::new(&bag, PlayerOptions::default()).unwrap();
    let at = Duration::from_millis;
    assert_eq!(due(&mut player, 0), 1000);
    assert!(seek(&mut player, 1280, 50));
    assert_eq!(player.poll(at(50)).unwrap(), Due::In(at(20)));
    assert_eq!(due(&mut player, 70), 1300);
    assert!(seek(&mut player, 1100, 80));
    assert_eq!(due(&mut player, 80), 1100);
    assert_eq!(player.poll(at(80)).unwrap(), Due::In(at(100)));
    // A time before the first message leads to it; a time after the last is rejected.
    assert!(seek(&mut player, 0, 90));
    assert_eq!(due(&mut player, 90), 1000);
    assert!(!seek(&mut player, 1401, 90));
    assert_eq!(player.poll(at(90)).unwrap(), Due::In(at(100)));
    assert_eq!(due(&mut player, 190), 1100);
}

#[test]
fn a_paused_player_stays_paused_at_the_time_it_seeks_and_its_clock_shows_it() {
    let directory = tempfile::tempdir().unwrap();
    let bag = bag(directory.path(), &[1000, 2000, 3000]);
    let options = PlayerOptions { paused: true, clock: Some(1.0), ..PlayerOptions::default() };
    let mut player = Player::new(&bag, options).unwrap();
    let at = Duration::from_millis;
    assert!(seek(&mut player, 1500, 10));
    assert_eq!(player.tick(at(20)).unwrap().0, 1500 * MILLISECOND);
    assert_eq!(player.poll(at(20)).unwrap(), Due::In(PAUSED_POLL));
    let executed = player.execute(PlayerCommand::Next, at(30)).unwrap();
    assert_eq!(times(&executed), [2000]);
    assert!(executed.outcome.paused && executed.outcome.done);
    let executed = player.execute(PlayerCommand::Skip(-0.7), at(40)).unwrap();
    assert!(executed.outcome.done);
    assert_eq!(player.tick(at(5_000)).unwrap().0, 1300 * MILLISECOND);
}

#[test]
fn a_loop_continues_after_a_seek_and_restarts_at_the_beginning() {
    let directory = tempfile::tempdir().unwrap();
    let bag = bag(directory.path(), &[500, 520, 540, 560]);
    let options = PlayerOptions { looped: true, ..PlayerOptions::default() };
    let mut player = Player::new(&bag, options).unwrap();
    assert!(seek(&mut player, 540, 7));
    assert_eq!([due(&mut player, 7), due(&mut player, 27)], [540, 560]);
    // The next pass starts one mean interval later, at the first message.
    assert_eq!(player.poll(Duration::from_millis(27)).unwrap(), Due::In(Duration::from_millis(20)));
    assert_eq!([due(&mut player, 47), due(&mut player, 67)], [500, 520]);
    assert!(seek(&mut player, 500, 70));
    assert_eq!(due(&mut player, 70), 500);
}

#[test]
fn an_invalid_rate_is_rejected_and_the_old_one_stays() {
    let directory = tempfile::tempdir().unwrap();
    let bag = bag(directory.path(), &[0, 100]);
    let mut player = Player::new(&bag, PlayerOptions::default()).unwrap();
    for (rate, done) in [(2.0, true), (0.0, false), (-1.0, false), (f64::NAN, false)] {
        let outcome = player.execute(PlayerCommand::Rate(rate), Duration::ZERO).unwrap().outcome;
        assert_eq!((outcome.done, outcome.rate), (done, 2.0), "{rate}");
    }
}

#[test]
fn the_clock_shows_the_recorded_time_at_its_own_rate() {
    let directory = tempfile::tempdir().unwrap();
    let bag = bag(directory.path(), &[1_000, 1_500]);
    let options = PlayerOptions { rate: 2.0, clock: Some(10.0), ..PlayerOptions::default() };
    let mut player = Player::new(&bag, options).unwrap();
    let at = Duration::from_millis;
    let tick = |player: &mut Player, now| player.tick(now).map(|stamp| stamp.0 / MILLISECOND);
    assert_eq!(tick(&mut player, at(0)), Some(1_000));
    assert!(matches!(player.poll(at(0)).unwrap(), Due::Now(_)));
    assert_eq!(tick(&mut player, at(99)), None);
    assert_eq!(player.poll(at(99)).unwrap(), Due::In(at(1)));
    assert_eq!(tick(&mut player, at(100)), Some(1_200));
    assert_eq!(tick(&mut player, at(200)), Some(1_400));
    // However late it is asked, it never shows more than was recorded.
    assert!(matches!(player.poll(at(300)).unwrap(), Due::Now(_)));
    assert_eq!(tick(&mut player, at(300)), Some(1_500));
    assert_eq!(player.poll(at(300)).unwrap(), Due::Never);
}

#[test]
fn invalid_options_are_rejected() {
    let directory = tempfile::tempdir().unwrap();
    let bag = bag(directory.path(), &[0]);
    let cases = [
        (
            PlayerOptions { rate: 0.0, ..Default::default() },
            "rate: found 0, expected a positive number",
        ),
        (PlayerOptions { start_offset: f64::NAN, ..Default::default() }, "start-offset: found NaN"),
        (PlayerOptions { duration: Some(-1.0), ..Default::default() }, "duration: found -1"),
        (
            PlayerOptions { topics: Some(vec!["/b".into()]), ..Default::default() },
            "topics: found /b, expected one of /a",
        ),
        (PlayerOptions { clock: Some(0.0), ..Default::default() }, "clock: found 0, expected"),
        (
            PlayerOptions { start_offset: 9.0, ..Default::default() },
            "no messages on the selected topics",
        ),
    ];
    for (options, expected) in cases {
        let message = Player::new(&bag, options).err().unwrap().to_string();
        assert!(message.contains(expected), "{message}");
    }
}

/// QoS of publishers that keep their last message.
fn latched() -> QosProfile {
    let (durability, history) = (DurabilityPolicy::TransientLocal, HistoryPolicy::KeepLast(1));
    QosProfile { durability, history, ..QosProfile::default() }
}

/// A bag with messages on `/a` at these times (ms), and on `/map`, whose publisher keeps the last message, at others; each with
/// its time as text.
fn bag_with_map(directory: &Path, times: &[i64], maps: &[i64]) -> BagReader {
    let path = directory.join("bag");
    let mut writer = BagWriter::create(&path, WriterOptions::default()).unwrap();
    let words = type_support(RosString::TYPE).unwrap();
    for (name, offered, times) in [("/a", QosProfile::default(), times), ("/map", latched(), maps)]
    {
        let topic = writer.offered_topic(name, words, &[offered]).unwrap();
        for time in times {
            let stamp = Stamp(time * MILLISECOND);
            let data = cdr::encode(&RosString { data: time.to_string() });
            writer.write(topic, stamp, stamp, &data).unwrap();
        }
    }
    writer.finish().unwrap();
    BagReader::open(&path).unwrap()
}

/// Topics and texts of the messages that are due, up to the next wait.
fn all_due(player: &mut Player, now: u64) -> Vec<String> {
    let mut due = Vec::new();
    while let Due::Now(message) = player.poll(Duration::from_millis(now)).unwrap() {
        due.push(text(&message));
    }
    due
}

fn text(message: &BagMessage) -> String {
    let word: RosString = cdr::decode(&message.data).unwrap();
    format!("{} {}", message.topic, word.data)
}

#[test]
fn what_publishers_had_kept_comes_first_at_an_offset_and_after_a_seek() {
    let directory = tempfile::tempdir().unwrap();
    let bag = bag_with_map(directory.path(), &[100, 200, 300, 400, 500], &[100, 150, 350]);
    let options = PlayerOptions { start_offset: 0.2, ..PlayerOptions::default() };
    let mut player = Player::new(&bag, options.clone()).unwrap();
    assert_eq!(all_due(&mut player, 0), ["/map 150", "/a 300"]);
    assert_eq!(all_due(&mut player, 50), ["/map 350"]);
    assert!(seek(&mut player, 450, 60));
    assert_eq!(all_due(&mut player, 60), ["/map 350"]);
    assert!(seek(&mut player, 310, 70));
    assert_eq!(all_due(&mut player, 70), ["/map 150"], "what a subscriber would have had then");
    assert!(seek(&mut player, 310, 80));
    let executed = player.execute(PlayerCommand::Next, Duration::from_millis(80)).unwrap();
    let texts: Vec<_> = executed.messages.iter().map(text).collect();
    assert_eq!(texts, ["/map 150", "/map 350"], "before the message of a step");

    let paused = PlayerOptions { paused: true, ..options.clone() };
    let mut player = Player::new(&bag, paused).unwrap();
    assert_eq!(all_due(&mut player, 0), ["/map 150"], "also before the player resumes");

    // Other topics, and what the user says about the quality of service.
    let topics = Some(vec!["/a".to_owned()]);
    let mut player = Player::new(&bag, PlayerOptions { topics, ..options.clone() }).unwrap();
    assert_eq!(all_due(&mut player, 0), ["/a 300"]);
    let volatile = QosOverrides::from([("/map".to_owned(), QosProfile::default())]);
    let mut player = Player::new(&bag, PlayerOptions { overrides: volatile, ..options }).unwrap();
    assert_eq!(all_due(&mut player, 0), ["/a 300"]);
}

#[test]
fn each_pass_of_a_loop_begins_with_what_publishers_had_kept() {
    let directory = tempfile::tempdir().unwrap();
    let bag = bag_with_map(directory.path(), &[100, 200, 220, 240], &[100]);
    let options = PlayerOptions { start_offset: 0.1, looped: true, ..PlayerOptions::default() };
    let expected = [(0, 200), (0, 200), (20, 220), (40, 240)];
    let again = expected.map(|(due, recorded)| (due + 60, recorded));
    assert_eq!(play(&bag, options, 100), [expected, again].concat());
}

#[test]
fn a_long_pause_is_told_with_the_offset_that_skips_it() {
    let directory = tempfile::tempdir().unwrap();
    let later = 1_700_000_000_500;
    let bag = bag(directory.path(), &[0, later, later + 59_000]);
    let mut player = Player::new(&bag, PlayerOptions::default()).unwrap();
    let now = Duration::ZERO;
    assert_eq!(player.long_pause(now), None, "the first message is due");
    assert_eq!(due(&mut player, 0), 0);
    let pause = player.long_pause(now).unwrap();
    assert_eq!((pause.wait.as_secs(), pause.start_offset), (1_700_000_000, 1.7e9));
    let start_offset = pause.start_offset;
    let mut player =
        Player::new(&bag, PlayerOptions { start_offset, ..PlayerOptions::default() }).unwrap();
    assert_eq!(player.long_pause(now), None);
    assert_eq!(due(&mut player, 500), later);
    assert_eq!(player.long_pause(Duration::from_millis(500)), None, "59 s are no long pause");
    let rate = 1e9;
    let mut player = Player::new(&bag, PlayerOptions { rate, ..PlayerOptions::default() }).unwrap();
    assert_eq!(due(&mut player, 0), 0);
    assert_eq!(player.long_pause(now), None, "in real time");
}
