//! A thread that keeps a node in its group.

use std::{
    collections::{BTreeSet, HashSet},
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    thread::{self, JoinHandle},
    time::Duration,
};

use super::standing::{Change, Epoch, GroupCounts, Reason, Standing, View};
use eddy_frames::{clock::Clock, counted};
use eddy_transport::Membership;

/// Interval at which the thread looks at the others.
const TICK: Duration = Duration::from_millis(25);
/// Streams of other members that are counted separately.
const COUNTED_STREAMS: usize = 1 << 20;

/// A node's place in its group, until it is dropped.
pub struct GroupMember {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

struct Shared {
    name: String,
    clock: Clock,
    standing: Mutex<Standing>,
    /// Streams of other members since the last report.
    foreign: Mutex<HashSet<u64>>,
    foreign_frames: AtomicU64,
    is_active: AtomicBool,
    ended: AtomicBool,
}

impl GroupMember {
    /// Watches the group of this name, and joins it once the node is active and `membership` is connected.
    pub fn start(name: &str, membership: Box<dyn Membership>) -> Self {
        let clock = Clock::start();
        let standing = Standing::new(membership.id(), membership.lease(), clock.now());
        let shared = Arc::new(Shared {
            name: name.to_owned(),
            clock,
            standing: Mutex::new(standing),
            foreign: Mutex::default(),
            foreign_frames: AtomicU64::new(0),
            is_active: AtomicBool::new(false),
            ended: AtomicBool::new(false),
        });
        let kept = Arc::clone(&shared);
        let thread = thread::spawn(move || keep(&kept, membership));
        Self { shared, thread: Some(thread) }
    }

    /// A node that does not predict, or not yet, is no member.
    pub fn set_active(&self, is_active: bool) {
        self.shared.is_active.store(is_active, Ordering::Relaxed);
    }

    /// Whether the node observes a frame; counts it otherwise. Frames without a stream are nobody's: all reject them.
    pub fn accepts(&self, stream: Option<u64>) -> bool {
        let Some(stream) = stream else { return true };
        if self.observes(stream) {
            return true;
        }
        self.shared.foreign_frames.fetch_add(1, Ordering::Relaxed);
        let mut foreign = lock(&self.shared.foreign);
        if foreign.len() < COUNTED_STREAMS {
            foreign.insert(stream);
        }
        false
    }

    /// Whether the node owns a stream, or will own it when it joins.
    pub(crate) fn observes(&self, stream: u64) -> bool {
        lock(&self.shared.standing).observes(stream)
    }

    /// Whether the node may publish now what it predicts from a frame of a stream that arrived so long ago.
    pub fn may_publish(&self, stream: u64, age: Duration) -> bool {
        let standing = lock(&self.shared.standing);
        let now = self.shared.clock.now();
        standing.may_publish(stream, now.saturating_sub(age), now)
    }

    pub(crate) fn epoch(&self) -> Epoch {
        lock(&self.shared.standing).epoch()
    }

    /// Frames of other members since the start.
    pub fn foreign_frames(&self) -> u64 {
        self.shared.foreign_frames.load(Ordering::Relaxed)
    }

    /// Members and streams since the last call; the node keeps `owned_streams`.
    pub fn counts(&self, owned_streams: usize) -> GroupCounts {
        let foreign = std::mem::take(&mut *lock(&self.shared.foreign));
        GroupCounts {
            members: lock(&self.shared.standing).members() as u64,
            owned_streams: owned_streams as u64,
            foreign_streams: foreign.len() as u64,
        }
    }

    /// Leaves the group for good, after which nothing may be published.
    pub fn leave(&self) {
        self.shared.ended.store(true, Ordering::Relaxed);
        lock(&self.shared.standing).leave(self.shared.clock.now());
        if let Some(thread) = &self.thread {
            thread.thread().unpark();
        }
    }
}

impl Drop for GroupMember {
    fn drop(&mut self) {
        self.leave();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join(); // a panic has been reported
        }
    }
}

/// Looks at the group until the node ends.
fn keep(shared: &Shared, mut membership: Box<dyn Membership>) {
    let Shared { name, clock, .. } = shared;
    let mut differing = 0;
    while !shared.ended.load(Ordering::Relaxed) {
        let view = View {
            members: membership.members(),
            is_connected: membership.is_connected(),
            is_active: shared.is_active.load(Ordering::Relaxed),
        };
        let mut standing = lock(&shared.standing);
        let change = standing.on_tick(clock.now(), &view);
        if let Some(Change::Leave(_)) = change {
            membership.leave();
            standing.rename(membership.id());
        }
        drop(standing);
        match change {
            None => {}
            Some(Change::Join) => {
                // Without the lock: frames arrive meanwhile.
                let joined = membership.join();
                let mut standing = lock(&shared.standing);
                match joined {
                    Ok(()) => {
                        standing.joined(clock.now());
                        let members = counted(standing.members() as u64, "member");
                        tracing::info!("group {name}: joined, {members}");
                    }
                    // The others do not see this node and predict its streams.
                    Err(error) => {
                        standing.leave(clock.now());
                        tracing::error!("group {name}: {error}");
                    }
                }
            }
            Some(Change::Members(members)) => {
                tracing::info!("group {name}: {}", counted(members as u64, "member"));
            }
            Some(Change::Leave(Reason::Paused(still))) => tracing::warn!(
                "group {name}: this node stood still for {:.1} s, so others may have taken its streams: it resets them and joins again",
                still.as_secs_f64()
            ),
            Some(Change::Leave(Reason::Disconnected)) => tracing::warn!(
                "group {name}: this node lost all connections, so others may have taken its streams: it resets them and joins again"
            ),
            Some(Change::Leave(Reason::Inactive)) => tracing::info!("group {name}: left"),
        }
        let before =
            std::mem::replace(&mut differing, differing_from(membership.id(), &view.members));
        if differing > before {
            tracing::warn!(
                "group {name}: {} started with another checkpoint, other settings or other outputs than this node: the predictions of a stream change when it moves",
                counted(differing as u64, "member")
            );
        }
        thread::park_timeout(TICK);
    }
    membership.leave();
}

/// The number of members whose label is not that of `own`.
fn differing_from(own: &str, members: &BTreeSet<String>) -> usize {
    members.iter().filter(|id| label(id) != label(own)).count()
}

fn label(id: &str) -> &str {
    id.rsplit('-').next().unwrap_or(id)
}

/// Locks a mutex. A panic in another thread leaves its contents consistent: every change is one operation.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
