//! QoS of the endpoints, and the largest message size.

use std::{fs, time::Duration};

use ros2_client::dds::rustdds::{
    DomainParticipantBuilder, QosPolicies, QosPolicyBuilder,
    policy::{Durability, History, ResourceLimits},
};

use crate::{Reliability, transports::is_frames};
use eddy_messages::{Message, PointCloud2};

/// History of a topic, and of a writer (messages).
const HISTORY_LIMIT: i32 = 256;

/// History of a reliable writer that never waits (messages): a killed reader is detected after 50 s, and until then the
/// writer keeps its small messages.
const RELIABLE_HISTORY_LIMIT: i32 = 1 << 14;

/// History depth of a dropping publisher, the default of rmw_zenoh.
const DEPTH: i32 = 10;

/// Default limit of a socket's receive buffer on Linux (bytes, `net.core.rmem_max`).
const DEFAULT_RMEM_MAX: usize = 212_992;

/// Largest number of unacknowledged bytes of a blocking publisher. Datagrams lost in a full socket buffer are repaired at
/// 0.8 MB/s only (`rtps/constant.rs`, `REPAIR_BATCH_MAX_BYTES`).
pub(super) const MAX_UNACKNOWLEDGED: usize = 256 << 10;

/// Largest message that RustDDS transmits reliably (bytes, with its header): it fits into a socket's receive buffer.
///
/// RustDDS 0.15.1 sends a message as one burst of datagrams of up to 64 KB and requests a receive buffer of 8 MiB; the
/// system may grant less. Measured on loopback with 100 consecutive messages: with the default of 212,992 bytes, messages
/// of 200 kB reach 390 MB/s, but nine in ten messages of 500 kB need repair, which leaves 2 MB/s; best effort loses nine in
/// ten. With 4 MiB (`sysctl net.core.rmem_max=4194304`), messages of 4 MB reach 680 MB/s.
pub(super) fn largest_message() -> usize {
    let granted = fs::read_to_string("/proc/sys/net/core/rmem_max").ok();
    granted
        .and_then(|text| text.trim().parse().ok())
        .unwrap_or(DEFAULT_RMEM_MAX)
        .min(DomainParticipantBuilder::DEFAULT_SOCKET_RECEIVE_BUFFER_SIZE)
}

/// QoS of a publisher.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum PublisherQos {
    /// Reliable, keep all: waits for acknowledgments.
    Blocking,
    /// Reliable, keep last: never waits. For small messages of dropping publishers, since reliable subscribers, the default
    /// of ROS, do not match best-effort publishers.
    Reliable,
    /// As `Reliable`, with a shorter history for point clouds, which are large.
    ReliableLarge,
    /// Best effort, keep last: for frames of dropping publishers.
    BestEffort,
}

impl PublisherQos {
    pub(super) fn of(reliability: Reliability, type_name: &str) -> Self {
        match reliability {
            Reliability::Block => Self::Blocking,
            Reliability::Drop if is_frames(type_name) => Self::BestEffort,
            Reliability::Drop if type_name == PointCloud2::TYPE => Self::ReliableLarge,
            Reliability::Drop => Self::Reliable,
        }
    }

    pub(super) fn policies(self, patience: Duration) -> QosPolicies {
        let basis = QosPolicyBuilder::new().durability(Durability::Volatile);
        match self {
            Self::Blocking => basis.reliable(patience.into()).history(History::KeepAll),
            Self::Reliable | Self::ReliableLarge => {
                basis.reliable(Duration::ZERO.into()).history(History::KeepLast { depth: DEPTH })
            }
            Self::BestEffort => basis.best_effort().history(History::KeepLast { depth: DEPTH }),
        }
        .resource_limits(limits(if self == Self::Reliable {
            RELIABLE_HISTORY_LIMIT
        } else {
            HISTORY_LIMIT
        }))
        .build()
    }
}

/// QoS of a reliable subscriber.
pub(super) fn reliable_reader() -> QosPolicies {
    let basis = QosPolicyBuilder::new().durability(Durability::Volatile);
    let basis = basis.reliable(Duration::ZERO.into()).history(History::KeepAll);
    basis.resource_limits(limits(HISTORY_LIMIT)).build()
}

/// QoS of a best-effort subscriber.
pub(super) fn best_effort_reader() -> QosPolicies {
    let basis = QosPolicyBuilder::new().durability(Durability::Volatile);
    basis.best_effort().history(History::KeepAll).resource_limits(limits(HISTORY_LIMIT)).build()
}

/// QoS of a topic: its history; everything else is set by the endpoints.
pub(super) fn topic() -> QosPolicies {
    QosPolicyBuilder::new().history(History::KeepAll).resource_limits(limits(HISTORY_LIMIT)).build()
}

pub(super) fn default() -> QosPolicies {
    QosPolicyBuilder::new().build()
}

const fn limits(messages: i32) -> ResourceLimits {
    ResourceLimits { max_samples: messages, max_instances: 1, max_samples_per_instance: messages }
}

#[cfg(test)]
mod tests {
    use super::*;
    use eddy_messages::{DiagnosticArray, ParticleFrame};

    #[test]
    fn only_frames_of_dropping_publishers_are_best_effort() {
        let qos = |mode, kind| PublisherQos::of(mode, kind);
        assert_eq!(qos(Reliability::Block, ParticleFrame::TYPE), PublisherQos::Blocking);
        assert_eq!(qos(Reliability::Drop, ParticleFrame::TYPE), PublisherQos::BestEffort);
        assert_eq!(qos(Reliability::Drop, DiagnosticArray::TYPE), PublisherQos::Reliable);
        assert_eq!(qos(Reliability::Drop, PointCloud2::TYPE), PublisherQos::ReliableLarge);
        let reliable = |qos: PublisherQos| qos.policies(Duration::from_secs(1)).is_reliable();
        let all = [
            PublisherQos::Blocking,
            PublisherQos::Reliable,
            PublisherQos::ReliableLarge,
            PublisherQos::BestEffort,
        ];
        assert_eq!(all.map(reliable), [true, true, true, false]);
    }
}
