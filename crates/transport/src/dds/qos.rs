//! What an endpoint promises, and what a message may weigh.

use std::{fs, time::Duration};

use ros2_client::dds::rustdds::{
    DomainParticipantBuilder, QosPolicies, QosPolicyBuilder,
    policy::{Durability, History, ResourceLimits},
};

use crate::{Reliability, opener::is_frames};
use eddy_messages::{Message, PointCloud2};

/// Messages that RustDDS holds for a topic, read or not, and messages of a writer that may be on their way.
const HELD: i32 = 256;

/// The same of a writer that repairs but waits for nobody: a reader that was killed is known only 50 s later, and until
/// then holds back as many small messages.
const HELD_FOR_REPAIR: i32 = 1 << 14;

/// Depth of a publisher that drops, as rmw_zenoh's default.
const DEPTH: i32 = 10;

/// What Linux grants a socket that asks for more, unless set otherwise (bytes, `net.core.rmem_max`).
const USUAL_BUFFER: usize = 212_992;

/// Bytes that a publisher that waits lets be on their way. What is lost for want of room in a
/// socket is repaired at 0.8 MB/s only (`rtps/constant.rs`, `REPAIR_BATCH_MAX_BYTES`).
pub(super) const MAX_ON_THEIR_WAY: usize = 256 << 10;

/// Largest message that RustDDS carries soundly (bytes, with its header): one for which a reader's socket
/// has room as a whole.
///
/// RustDDS 0.15.1 sends a message as one burst of datagrams of up to 64 KB and asks for a receive buffer of
/// 8 MiB; the system may grant less. Measured on loopback, 100 messages one after the other: with the
/// 212,992 bytes that Linux grants by itself 200 kB go at 390 MB/s, but of messages of 500 kB nine in ten
/// have to be repaired, which leaves 2 MB/s, and without repair nine in ten are lost. With 4 MiB
/// (`sysctl net.core.rmem_max=4194304`) messages of 4 MB go at 680 MB/s.
pub(super) fn largest_message() -> usize {
    let granted = fs::read_to_string("/proc/sys/net/core/rmem_max").ok();
    granted
        .and_then(|text| text.trim().parse().ok())
        .unwrap_or(USUAL_BUFFER)
        .min(DomainParticipantBuilder::DEFAULT_SOCKET_RECEIVE_BUFFER_SIZE)
}

/// How a publisher treats its subscribers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Promise {
    /// Reliable, keep all: waits until messages have arrived.
    Waits,
    /// Reliable, keep last: repairs what it still has, waits for nobody. For small messages that drop:
    /// whoever asks for reliable, as ROS does unless told otherwise, does not match best effort.
    Repairs,
    /// The same for clouds, which are large: fewer are held.
    Shows,
    /// Best effort, keep last: frames that drop.
    Tries,
}

impl Promise {
    pub(super) fn of(reliability: Reliability, type_name: &str) -> Self {
        match reliability {
            Reliability::Block => Self::Waits,
            Reliability::Drop if is_frames(type_name) => Self::Tries,
            Reliability::Drop if type_name == PointCloud2::TYPE => Self::Shows,
            Reliability::Drop => Self::Repairs,
        }
    }

    pub(super) fn qos(self, patience: Duration) -> QosPolicies {
        let basis = QosPolicyBuilder::new().durability(Durability::Volatile);
        match self {
            Self::Waits => basis.reliable(patience.into()).history(History::KeepAll),
            Self::Repairs | Self::Shows => {
                basis.reliable(Duration::ZERO.into()).history(History::KeepLast { depth: DEPTH })
            }
            Self::Tries => basis.best_effort().history(History::KeepLast { depth: DEPTH }),
        }
        .resource_limits(limits(if self == Self::Repairs { HELD_FOR_REPAIR } else { HELD }))
        .build()
    }
}

/// A subscriber of writers that repair.
pub(super) fn reliable_reader() -> QosPolicies {
    let basis = QosPolicyBuilder::new().durability(Durability::Volatile);
    let basis = basis.reliable(Duration::ZERO.into()).history(History::KeepAll);
    basis.resource_limits(limits(HELD)).build()
}

/// A subscriber of writers that do not.
pub(super) fn best_effort_reader() -> QosPolicies {
    let basis = QosPolicyBuilder::new().durability(Durability::Volatile);
    basis.best_effort().history(History::KeepAll).resource_limits(limits(HELD)).build()
}

/// What a topic holds; promises are the endpoints' own.
pub(super) fn cache() -> QosPolicies {
    QosPolicyBuilder::new().history(History::KeepAll).resource_limits(limits(HELD)).build()
}

pub(super) fn unsaid() -> QosPolicies {
    QosPolicyBuilder::new().build()
}

const fn limits(held: i32) -> ResourceLimits {
    ResourceLimits { max_samples: held, max_instances: 1, max_samples_per_instance: held }
}

#[cfg(test)]
mod tests {
    use super::*;
    use eddy_messages::{DiagnosticArray, ParticleFrame};

    #[test]
    fn only_frames_that_drop_are_best_effort() {
        let promise = |mode, kind| Promise::of(mode, kind);
        assert_eq!(promise(Reliability::Block, ParticleFrame::TYPE), Promise::Waits);
        assert_eq!(promise(Reliability::Drop, ParticleFrame::TYPE), Promise::Tries);
        assert_eq!(promise(Reliability::Drop, DiagnosticArray::TYPE), Promise::Repairs);
        assert_eq!(promise(Reliability::Drop, PointCloud2::TYPE), Promise::Shows);
        let reliable = |promise: Promise| promise.qos(Duration::from_secs(1)).is_reliable();
        let promises = [Promise::Waits, Promise::Repairs, Promise::Shows, Promise::Tries];
        assert_eq!(promises.map(reliable), [true, true, true, false]);
    }
}
