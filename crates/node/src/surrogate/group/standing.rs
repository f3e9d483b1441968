//! What a node knows of its group, and what it may publish.
//!
//! A stream must not be predicted by two nodes, although they learn of each other at different times and each may stand
//! still at any moment:
//!
//! - A node joins after it has watched the others for [`SETTLE`], during which it observes the streams that it will own.
//! - A node that gains streams publishes predictions of frames that arrive [`HAND_OVER`] after the change: by then, their
//!   last owner knows of the change, and the frames that it may have predicted have arrived.
//! - A node that has not looked at the others for [`STALE`] publishes nothing until it has.
//! - Others consider a node that stands still dead after its lease, less the time since its last sign of life. A node
//!   that has stood still for half of that time publishes nothing, leaves, and joins again under a new id.
//! - A node that loses all connections leaves too: it cannot know what the others do.

use std::{collections::BTreeSet, time::Duration};

use super::ownership::Members;
use eddy_transport::Lease;

/// How long a node watches the others before it joins: connections are retried every half second.
pub(super) const SETTLE: Duration = Duration::from_millis(600);
/// How long a node withholds predictions of streams that it gains.
pub(super) const HAND_OVER: Duration = Duration::from_millis(200);
/// Time since its last look at the others after which a node publishes nothing. The rest of [`HAND_OVER`] is for the
/// network, which has this time to tell the last owner of a stream of the change.
const STALE: Duration = Duration::from_millis(100);

/// Members and streams of a group, as one node sees them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct GroupCounts {
    /// Members of the group, this node included once it has joined.
    pub members: u64,
    /// Streams that this node keeps.
    pub owned_streams: u64,
    /// Streams of other members of which a frame arrived since the last report.
    pub foreign_streams: u64,
}

/// What a node does next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Change {
    /// Join the group.
    Join,
    /// Leave it.
    Leave(Reason),
    /// The members have changed, whose number is this.
    Members(usize),
}

/// Why a node leaves its group.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Reason {
    /// It stood still for this long.
    Paused(Duration),
    /// It is not connected to anybody.
    Disconnected,
    /// It does not predict, or ends.
    Inactive,
}

/// What the node sees.
#[derive(Clone, Debug)]
pub(super) struct View {
    /// The announced members.
    pub(super) members: BTreeSet<String>,
    /// Whether the node is connected to anybody.
    pub(super) is_connected: bool,
    /// Whether the node predicts.
    pub(super) is_active: bool,
}

/// The place of a node in its group.
#[derive(Debug)]
pub(super) struct Standing {
    /// Id of this node; another one after each time that it leaves.
    id: String,
    /// Longest time between two calls of [`Standing::on_tick`] after which the node stays a member.
    fence: Duration,
    /// Time of the last one.
    ticked: Duration,
    phase: Phase,
    /// The members, this node included.
    members: Members,
    /// The members before the changes of the last [`HAND_OVER`].
    before: Members,
    /// Time of the last change.
    changed: Duration,
    epoch: Epoch,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    Watching { since: Duration },
    Member,
}

/// Counts changes of the streams that a node owns.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Epoch {
    /// How often the node has left the group: everything that it knew of its streams is stale.
    pub(crate) left: u64,
    /// How often the members have changed.
    pub(crate) changed: u64,
}

impl Standing {
    /// A node that begins to watch at `now`.
    pub(super) fn new(id: &str, lease: Lease, now: Duration) -> Self {
        let mut standing = Self {
            id: String::new(),
            fence: lease.duration.saturating_sub(lease.keep_alive) / 2,
            ticked: now,
            phase: Phase::Watching { since: now },
            members: Members::default(),
            before: Members::default(),
            changed: now,
            epoch: Epoch::default(),
        };
        standing.rename(id);
        standing
    }

    /// Takes the id under which the node will join next.
    pub(super) fn rename(&mut self, id: &str) {
        let others =
            self.members.ids().filter(|&other| other != self.id).map(str::to_owned).collect();
        id.clone_into(&mut self.id);
        self.see(&others);
    }

    /// Takes `view` at `now`. To be called several times within [`STALE`]. [`Change::Join`] asks for an announcement,
    /// which [`Standing::joined`] or [`Standing::leave`] follows.
    pub(super) fn on_tick(&mut self, now: Duration, view: &View) -> Option<Change> {
        let still = now.saturating_sub(std::mem::replace(&mut self.ticked, now));
        let paused = (still > self.fence).then_some(Reason::Paused(still));
        let disconnected = (!view.is_connected).then_some(Reason::Disconnected);
        let inactive = (!view.is_active).then_some(Reason::Inactive);
        let reason = inactive.or(paused).or(disconnected);
        match (self.phase, reason) {
            (Phase::Member, Some(reason)) => {
                self.leave(now);
                Some(Change::Leave(reason))
            }
            (Phase::Watching { .. }, Some(_)) => {
                self.phase = Phase::Watching { since: now };
                self.see(&view.members);
                None
            }
            (Phase::Watching { since }, None) => {
                self.see(&view.members);
                (now.saturating_sub(since) >= SETTLE).then_some(Change::Join)
            }
            (Phase::Member, None) => {
                let before = self.members.clone();
                if !self.see(&view.members) {
                    return None;
                }
                // Within a hand-over, those before its beginning stay.
                if self.is_handed_over(now) {
                    self.before = before;
                }
                self.changed = now;
                Some(Change::Members(self.members.len()))
            }
        }
    }

    /// The node was announced just before `now`.
    pub(super) fn joined(&mut self, now: Duration) {
        self.phase = Phase::Member;
        (self.before, self.changed) = (Members::default(), now);
    }

    /// Leaves the group.
    pub(super) fn leave(&mut self, now: Duration) {
        self.phase = Phase::Watching { since: now };
        self.epoch.left += 1;
    }

    /// Takes the members. Returns whether they changed.
    fn see(&mut self, members: &BTreeSet<String>) -> bool {
        let mut members = members.clone();
        members.insert(self.id.clone());
        let members = Members::new(&members);
        let is_changed = members != self.members;
        if is_changed {
            self.members = members;
            self.epoch.changed += 1;
        }
        is_changed
    }

    fn is_handed_over(&self, now: Duration) -> bool {
        now.saturating_sub(self.changed) >= HAND_OVER
    }

    /// Whether this node observes a stream: it owns it, or will own it when it joins.
    pub(super) fn observes(&self, stream: u64) -> bool {
        self.members.owner(stream) == Some(self.id.as_str())
    }

    /// Whether this node may publish at `now` what it predicts from a frame of a stream that arrived at `arrived`.
    pub(super) fn may_publish(&self, stream: u64, arrived: Duration, now: Duration) -> bool {
        let is_alive = now.saturating_sub(self.ticked) <= STALE.min(self.fence);
        let is_settled =
            self.is_handed_over(arrived) || self.before.owner(stream) == Some(self.id.as_str());
        self.phase == Phase::Member && is_alive && is_settled && self.observes(stream)
    }

    /// Number of members, this node included once it has joined.
    pub(super) fn members(&self) -> usize {
        self.members.len() - usize::from(self.phase != Phase::Member)
    }

    /// Changes whenever [`Standing::observes`] may have changed.
    pub(super) fn epoch(&self) -> Epoch {
        self.epoch
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const LEASE: Lease =
        Lease { duration: Duration::from_millis(800), keep_alive: Duration::from_millis(200) };

    fn ms(milliseconds: u64) -> Duration {
        Duration::from_millis(milliseconds)
    }

    /// Whether a prediction of a frame that has just arrived may be published.
    fn may_publish(node: &Standing, stream: u64, now: u64) -> bool {
        node.may_publish(stream, ms(now), ms(now))
    }

    fn view(members: &[&str]) -> View {
        let members = members.iter().map(|id| (*id).to_owned()).collect();
        View { members, is_connected: true, is_active: true }
    }

    /// Looks at the same others every 50 ms, after which nothing changes.
    fn look(node: &mut Standing, times: std::ops::RangeInclusive<u64>, members: &[&str]) {
        for now in times.step_by(50) {
            assert_eq!(node.on_tick(ms(now), &view(members)), None, "at {now} ms");
        }
    }

    /// Member `a` at 1 s, with the others that were announced before.
    fn member(others: &[&str]) -> Standing {
        let mut node = Standing::new("a", LEASE, ms(0));
        look(&mut node, 0..=550, others);
        assert_eq!(node.on_tick(ms(600), &view(others)), Some(Change::Join));
        node.joined(ms(600));
        look(&mut node, 650..=1_000, &[others, &["a"]].concat());
        node
    }

    /// A stream that `a` owns beside `b`, and one that it owns alone only.
    fn kept_and_lost() -> (u64, u64) {
        let both = Members::new(&["a", "b"].map(str::to_owned).into());
        let of = |id| (0..).find(|&stream| both.owner(stream) == Some(id)).unwrap();
        (of("a"), of("b"))
    }

    #[test]
    fn a_node_watches_observes_joins_and_publishes_after_the_hand_over() {
        let (kept, lost) = kept_and_lost();
        let mut node = Standing::new("a", LEASE, ms(0));
        for now in (0..600).step_by(50) {
            assert_eq!(node.on_tick(ms(now), &view(&["b"])), None);
            assert!(node.observes(kept) && !node.observes(lost));
            assert!(!may_publish(&node, kept, now));
            assert_eq!(node.members(), 1);
        }
        assert_eq!(node.on_tick(ms(600), &view(&["b"])), Some(Change::Join));
        assert_eq!(node.members(), 1, "before it is announced");
        node.joined(ms(610));
        assert_eq!(node.members(), 2);
        look(&mut node, 650..=800, &["a", "b"]);
        assert!(!may_publish(&node, kept, 809) && may_publish(&node, kept, 810));
    }

    #[test]
    fn a_node_that_could_not_be_announced_tries_again() {
        let mut node = Standing::new("a", LEASE, ms(0));
        look(&mut node, 0..=550, &[]);
        assert_eq!(node.on_tick(ms(600), &view(&[])), Some(Change::Join));
        node.leave(ms(600));
        look(&mut node, 650..=1_150, &[]);
        assert_eq!(node.on_tick(ms(1_200), &view(&[])), Some(Change::Join));
    }

    #[test]
    fn streams_of_a_dead_member_are_published_after_the_hand_over_and_the_others_all_the_time() {
        let (kept, gained) = kept_and_lost();
        let mut node = member(&["b"]);
        assert!(may_publish(&node, kept, 1_000) && !may_publish(&node, gained, 1_000));
        let epoch = node.epoch();
        assert_eq!(node.on_tick(ms(1_050), &view(&["a"])), Some(Change::Members(1)));
        assert_ne!(node.epoch(), epoch);
        assert!(node.observes(gained));
        assert!(may_publish(&node, kept, 1_050) && !may_publish(&node, gained, 1_050));
        look(&mut node, 1_100..=1_200, &["a"]);
        assert!(!may_publish(&node, gained, 1_249) && may_publish(&node, gained, 1_250));
    }

    /// Its last owner may have predicted it.
    #[test]
    fn a_frame_from_the_hand_over_is_not_published_after_it() {
        let (kept, gained) = kept_and_lost();
        let mut node = member(&["b"]);
        assert_eq!(node.on_tick(ms(1_050), &view(&["a"])), Some(Change::Members(1)));
        look(&mut node, 1_100..=1_500, &["a"]);
        assert!(!node.may_publish(gained, ms(1_249), ms(1_500)));
        assert!(node.may_publish(kept, ms(1_249), ms(1_500)));
        assert!(node.may_publish(gained, ms(1_250), ms(1_500)));
    }

    #[test]
    fn a_change_within_a_hand_over_extends_it() {
        let (kept, gained) = kept_and_lost();
        let mut node = member(&["b"]);
        assert_eq!(node.on_tick(ms(1_050), &view(&["a"])), Some(Change::Members(1)));
        // Another member joins and leaves.
        assert_eq!(node.on_tick(ms(1_100), &view(&["a", "c"])), Some(Change::Members(2)));
        assert_eq!(node.on_tick(ms(1_150), &view(&["a"])), Some(Change::Members(1)));
        assert!(may_publish(&node, kept, 1_150));
        look(&mut node, 1_200..=1_300, &["a"]);
        assert!(!may_publish(&node, gained, 1_349) && may_publish(&node, gained, 1_350));
    }

    #[test]
    fn a_node_with_an_old_view_of_the_others_publishes_nothing_until_it_looks_again() {
        let mut node = member(&[]);
        assert!(may_publish(&node, 7, 1_100) && !may_publish(&node, 7, 1_101));
        assert_eq!(node.on_tick(ms(1_300), &view(&["a"])), None, "300 ms are no pause");
        assert!(may_publish(&node, 7, 1_300));
    }

    #[test]
    fn a_node_that_stood_still_publishes_nothing_before_it_has_joined_again_under_another_id() {
        let mut node = member(&[]);
        let epoch = node.epoch();
        assert!(!may_publish(&node, 7, 3_999), "also before the next tick");
        // More than 300 ms: half of the lease less the time between two signs of life.
        let left = node.on_tick(ms(4_000), &view(&["a"]));
        assert_eq!(left, Some(Change::Leave(Reason::Paused(ms(3_000)))));
        assert_eq!(node.epoch().left, epoch.left + 1);
        node.rename("a2");
        for now in (4_050..4_600).step_by(50) {
            assert_eq!(node.on_tick(ms(now), &view(&[])), None);
            assert!(!may_publish(&node, 7, now));
        }
        assert_eq!(node.on_tick(ms(4_600), &view(&[])), Some(Change::Join));
        node.joined(ms(4_600));
        look(&mut node, 4_650..=4_750, &["a2"]);
        assert!(!may_publish(&node, 7, 4_799) && may_publish(&node, 7, 4_800));
    }

    #[test]
    fn a_node_without_connections_leaves_and_joins_once_it_has_watched_again() {
        let mut node = member(&[]);
        let cut = View { is_connected: false, ..view(&["a"]) };
        let left = node.on_tick(ms(1_050), &cut);
        assert_eq!(left, Some(Change::Leave(Reason::Disconnected)));
        node.rename("a2");
        (22..60).for_each(|n| assert_eq!(node.on_tick(ms(50 * n), &cut), None));
        let joined = (60..).find(|n| node.on_tick(ms(50 * n), &view(&[])).is_some());
        assert_eq!(joined, Some(71), "600 ms after the last tick without a connection");
    }

    #[test]
    fn an_inactive_node_is_no_member() {
        let mut node = member(&[]);
        let inactive = View { is_active: false, ..view(&["a"]) };
        let left = node.on_tick(ms(1_050), &inactive);
        assert_eq!(left, Some(Change::Leave(Reason::Inactive)));
        assert!(!may_publish(&node, 7, 1_050));
        assert_eq!(node.on_tick(ms(1_100), &inactive), None);
    }

    /// A node in a random history: when it comes and goes, stands still, and how late it learns of the others.
    #[derive(Clone, Debug)]
    struct History {
        joins: u64,
        pause: (u64, u64),
        delay: u64,
    }

    fn history() -> impl Strategy<Value = History> {
        (0_u64..3_000, (0_u64..8_000, 0_u64..3_000), 0_u64..90)
            .prop_map(|(joins, pause, delay)| History { joins, pause, delay })
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        /// Ten simulated seconds in steps of 10 ms. A paused node's token vanishes after its lease less up to 200 ms.
        #[test]
        fn no_stream_is_published_by_two(
            histories in prop::collection::vec(history(), 2..5),
            silent in 0_u64..200,
        ) {
            const STREAMS: u64 = 40;
            let id = |node: usize, left: u64| format!("{node}-{left}");
            let mut nodes: Vec<Option<(Standing, u64)>> = histories.iter().map(|_| None).collect();
            // Id and times at which it appears and vanishes.
            let mut tokens: Vec<(String, u64, u64)> = Vec::new();
            for now in (0..10_000).step_by(10) {
                let mut published = [0; STREAMS as usize];
                for (number, history) in histories.iter().enumerate() {
                    let (from, length) = history.pause;
                    let is_paused = (from..from + length).contains(&now);
                    if now == from - from % 10 && length > 800 - silent {
                        let end = from + 800 - silent;
                        let own = format!("{number}-");
                        tokens.iter_mut().filter(|(id, ..)| id.starts_with(&own)).for_each(|token| {
                            token.2 = token.2.min(end);
                        });
                    }
                    if now < history.joins || is_paused {
                        continue;
                    }
                    let (node, left) = nodes[number].get_or_insert_with(|| {
                        (Standing::new(&id(number, 0), LEASE, ms(now)), 0)
                    });
                    // Now and then, the thread that looks is late.
                    let is_late = (now / 500 + number as u64).is_multiple_of(5);
                    let interval = if is_late { 29 } else { 5 };
                    if (now / 10) % interval == number as u64 {
                        let seen = now.saturating_sub(history.delay);
                        let alive = tokens.iter().filter(|(_, from, to)| (*from..*to).contains(&seen));
                        let members = alive.map(|(id, ..)| id.clone()).collect();
                        let view = View { members, is_connected: true, is_active: true };
                        match node.on_tick(ms(now), &view) {
                            Some(Change::Join) => {
                                tokens.push((id(number, *left), now, u64::MAX));
                                node.joined(ms(now));
                            }
                            Some(Change::Leave(_)) => {
                                let own = id(number, *left);
                                tokens.iter_mut().filter(|(id, ..)| *id == own).for_each(|token| {
                                    token.2 = token.2.min(now);
                                });
                                *left += 1;
                                node.rename(&id(number, *left));
                            }
                            _ => {}
                        }
                    }
                    for stream in 0..STREAMS {
                        published[stream as usize] += u32::from(may_publish(node, stream, now));
                    }
                }
                prop_assert!(published.iter().all(|&by| by <= 1), "at {} ms: {:?}", now, published);
            }
        }
    }
}
