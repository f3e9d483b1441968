//! Rejected frames by stream and reason. Each is logged at once, then at intervals.

use std::{
    collections::{BTreeMap, BTreeSet},
    fmt,
    time::Duration,
};

use super::Rejection;

/// Interval between the messages about rejections that go on.
const INTERVAL: Duration = Duration::from_secs(10);
/// Streams and reasons that are said at once within one interval; the others are counted until its end.
const MAX_AT_ONCE: usize = 8;
/// Streams and reasons that are counted apart; further streams are counted together.
const MAX_COUNTED: usize = 4096;
/// Sentences of [`RejectionLog::totals`].
const MAX_TOTALS: usize = 16;

/// A rejected frame.
#[derive(Debug)]
pub struct Rejected {
    /// Its stream, if the message says so.
    pub stream: Option<u64>,
    /// Why it was rejected.
    pub reason: Rejection,
}

impl fmt::Display for Rejected {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(stream) = self.stream {
            write!(f, "stream {stream}: ")?;
        }
        self.reason.fmt(f)
    }
}

/// The rejected frames of one stream for one reason.
#[derive(Debug)]
struct Rejections {
    /// Number of frames.
    frames: u64,
    /// Those that no message has mentioned yet.
    unsaid: u64,
    /// Arrival of the last one.
    last: Duration,
    /// The last one in words, with what was found and what was expected.
    reason: String,
}

/// All rejected frames of a node.
#[derive(Debug, Default)]
pub struct RejectionLog {
    /// By the name of the counter and stream.
    entries: BTreeMap<(&'static str, Option<u64>), Rejections>,
    /// The key of the last one.
    last: Option<(&'static str, Option<u64>)>,
    /// Beginning of the current interval, and what was said at once in it.
    interval: Option<(Duration, usize)>,
}

impl RejectionLog {
    /// Adds a frame that arrived at `now` and was counted as `counter`. Returns what is to be said at once: a stream has a frame rejected
    /// for the first time for such a reason, or again after a pause.
    pub(super) fn add(
        &mut self,
        now: Duration,
        counter: &'static str,
        rejected: &Rejected,
    ) -> Option<String> {
        let mut key = (counter, rejected.stream);
        if self.entries.len() >= MAX_COUNTED && !self.entries.contains_key(&key) {
            key.1 = None;
        }
        self.last = Some(key);
        let reason = rejected.to_string();
        let (_, said) = self.interval.get_or_insert((now, 0));
        let entry = self.entries.entry(key).or_insert_with(|| Rejections {
            frames: 0,
            unsaid: 0,
            last: now,
            reason: String::new(),
        });
        let begins = entry.frames == 0 || now.saturating_sub(entry.last) > INTERVAL;
        entry.frames += 1;
        entry.unsaid += 1;
        entry.last = now;
        reason.clone_into(&mut entry.reason);
        if !begins || *said >= MAX_AT_ONCE {
            return None;
        }
        *said += 1;
        entry.unsaid = 0;
        Some(format!("frame rejected: {reason}"))
    }

    /// At the end of an interval: what is to be said about the frames that no message has mentioned, one sentence a reason.
    pub(super) fn overdue(&mut self, now: Duration) -> Vec<String> {
        let Some((since, _)) = self.interval else { return Vec::new() };
        if now.saturating_sub(since) < INTERVAL {
            return Vec::new();
        }
        self.interval = Some((now, 0));
        let sentences = self.unsaid(now.saturating_sub(since));
        self.entries.values_mut().for_each(|entry| entry.unsaid = 0);
        sentences
    }

    fn unsaid(&self, within: Duration) -> Vec<String> {
        let kinds: BTreeSet<_> = self.entries.keys().map(|(counter, _)| *counter).collect();
        let sentence = |counter: &'static str| {
            let of_kind = self
                .entries
                .iter()
                .filter(|((kind, _), entry)| *kind == counter && entry.unsaid > 0);
            let (streams, frames) = of_kind
                .clone()
                .fold((0, 0), |(streams, frames), (_, entry)| (streams + 1, frames + entry.unsaid));
            let (_, newest) = of_kind.max_by_key(|(_, entry)| entry.last)?;
            let of = if streams > 1 { format!(" of {streams} streams") } else { String::new() };
            let frames = eddy_frames::counted(frames, "more frame");
            Some(format!(
                "{frames}{of} rejected in {:.0} s ({}); the last one: {}",
                within.as_secs_f64(),
                counter.replace('_', " "),
                newest.reason
            ))
        };
        kinds.into_iter().filter_map(sentence).collect()
    }

    /// How many frames were rejected, one sentence for each stream and reason, unless there was one frame and it was said.
    pub fn totals(&self) -> Vec<String> {
        let told = |entry: &&Rejections| entry.frames > 1 || entry.unsaid > 0;
        let mut sentences: Vec<_> = self
            .entries
            .iter()
            .filter(|(_, entry)| told(entry))
            .map(|((counter, _), Rejections { frames, reason, .. })| {
                let frames = eddy_frames::counted(*frames, "frame");
                format!("{frames} rejected ({}), the last one: {reason}", counter.replace('_', " "))
            })
            .collect();
        let more = sentences.len().saturating_sub(MAX_TOTALS);
        if more > 0 {
            sentences.truncate(MAX_TOTALS);
            sentences.push(format!("frames of {more} more streams or for more reasons rejected"));
        }
        sentences
    }

    /// The last rejected frame in words.
    pub fn last(&self) -> Option<&str> {
        Some(&self.entries.get(&self.last?)?.reason)
    }

    /// Why frames were rejected after `since`: the last reason.
    pub(super) fn last_since(&self, since: Duration) -> Option<&str> {
        let entry = self.entries.get(&self.last?)?;
        (entry.last >= since).then_some(&*entry.reason)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use eddy_inference::engine::ModelError;

    fn wrong_interval(stream: u64) -> Rejected {
        let reason = ModelError::Interval { found: 0.02, expected: 0.016 };
        Rejected { stream: Some(stream), reason: reason.into() }
    }

    const fn seconds(number: u64) -> Duration {
        Duration::from_secs(number)
    }

    #[test]
    fn a_rejection_is_said_at_once_and_every_ten_seconds_while_it_goes_on() {
        let mut log = RejectionLog::default();
        let at_once = log.add(seconds(1), "wrong_interval", &wrong_interval(3)).unwrap();
        let reason = "stream 3: dt: found 0.02 s, expected 0.016 s as in the checkpoint";
        assert!(at_once.starts_with(&format!("frame rejected: {reason}")), "{at_once}");
        for second in 2..=30 {
            assert_eq!(log.add(seconds(second), "wrong_interval", &wrong_interval(3)), None);
            let said = log.overdue(seconds(second));
            match second {
                11 | 21 => {
                    let [said] = &said[..] else { panic!("{second}: {said:?}") };
                    let expected = format!(
                        "10 more frames rejected in 10 s (wrong interval); the last one: {reason}"
                    );
                    assert!(said.starts_with(&expected), "{said}");
                }
                _ => assert!(said.is_empty(), "{second}: {said:?}"),
            }
        }
        assert!(log.last_since(seconds(30)).is_some() && log.last_since(seconds(31)).is_none());
        // The rest is said once, and nothing more after the end.
        assert_eq!(log.overdue(seconds(31)).len(), 1);
        assert!(log.overdue(seconds(60)).is_empty());
        // Again after a pause.
        assert!(log.add(seconds(70), "wrong_interval", &wrong_interval(3)).is_some());
        let totals = log.totals();
        let expected = format!("31 frames rejected (wrong interval), the last one: {reason}");
        assert!(matches!(&totals[..], [one] if one.starts_with(&expected)), "{totals:?}");
    }

    #[test]
    fn each_stream_and_reason_is_said_but_many_together() {
        let mut log = RejectionLog::default();
        let late = Rejected { stream: Some(0), reason: Rejection::Late { found: 1, expected: 2 } };
        assert!(log.add(seconds(0), "late", &late).is_some());
        let said = (0..100).filter(|&stream| {
            log.add(seconds(0), "wrong_interval", &wrong_interval(stream)).is_some()
        });
        assert_eq!(said.count(), MAX_AT_ONCE - 1);
        let said = log.overdue(seconds(10));
        assert!(
            matches!(&said[..], [one] if one.starts_with("93 more frames of 93 streams rejected in 10 s")),
            "{said:?}"
        );
        assert!(log.totals().is_empty(), "each was one frame, and was said");
    }
}
