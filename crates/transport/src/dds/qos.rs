//! QoS of the endpoints, and the largest message size.

use std::{fs, num::NonZeroUsize, time::Duration};

use ros2_client::dds::rustdds::{
    DomainParticipantBuilder, QosPolicies, QosPolicyBuilder,
    policy::{Durability, History, ResourceLimits},
};

use crate::{Reliability, default_qos};
use eddy_messages::{Message, PointCloud2, QosProfile, qos::ReliabilityPolicy};

/// History of a topic, and of a writer (messages).
const HISTORY_LIMIT: i32 = 256;

/// History of a reliable writer that never waits (messages): a killed reader is detected after 50 s, and until then the
/// writer keeps its small messages.
const RELIABLE_HISTORY_LIMIT: i32 = 1 << 14;

/// Smallest history of a writer that keeps messages for late-joining readers: RustDDS waits for acknowledgments when as
/// many messages are not acknowledged.
const LATCHED_HISTORY_MINIMUM: usize = 16;

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

/// Longest time that a write of a blocking publisher waits for room; it is repeated as long as the patience lasts.
const BLOCKING: Duration = Duration::from_millis(20);

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
    /// `offered`: what to announce; [`default_qos`] if `None`.
    pub(super) fn of(
        reliability: Reliability,
        type_name: &str,
        offered: Option<&QosProfile>,
    ) -> Self {
        let announced = offered.copied().unwrap_or_else(|| default_qos(reliability, type_name));
        match (announced.reliability, reliability) {
            (ReliabilityPolicy::BestEffort, _) => Self::BestEffort,
            (ReliabilityPolicy::Reliable, Reliability::Block) => Self::Blocking,
            // Of any size.
            (ReliabilityPolicy::Reliable, Reliability::Drop)
                if offered.is_some() || type_name == PointCloud2::TYPE =>
            {
                Self::ReliableLarge
            }
            (ReliabilityPolicy::Reliable, Reliability::Drop) => Self::Reliable,
        }
    }

    /// `kept`: number of messages for late-joining readers; volatile if `None`.
    pub(super) fn policies(self, kept: Option<NonZeroUsize>) -> QosPolicies {
        let basis = QosPolicyBuilder::new();
        let basis = match self {
            Self::Blocking => basis.reliable(BLOCKING.into()),
            Self::Reliable | Self::ReliableLarge => basis.reliable(Duration::ZERO.into()),
            Self::BestEffort => basis.best_effort(),
        };
        if let Some(kept) = kept {
            let clamp = |number| i32::try_from(number).unwrap_or(i32::MAX);
            let (depth, limit) =
                (clamp(kept.get()), clamp(kept.get().max(LATCHED_HISTORY_MINIMUM)));
            return basis
                .durability(Durability::TransientLocal)
                .history(History::KeepLast { depth })
                .resource_limits(limits(limit))
                .build();
        }
        let (history, limit) = match self {
            Self::Blocking => (History::KeepAll, HISTORY_LIMIT),
            Self::Reliable => (History::KeepLast { depth: DEPTH }, RELIABLE_HISTORY_LIMIT),
            Self::ReliableLarge | Self::BestEffort => {
                (History::KeepLast { depth: DEPTH }, HISTORY_LIMIT)
            }
        };
        let basis = basis.durability(Durability::Volatile).history(history);
        basis.resource_limits(limits(limit)).build()
    }
}

/// QoS of a reliable subscriber that also receives the messages which publishers keep.
pub(super) fn latched_reader() -> QosPolicies {
    let basis = QosPolicyBuilder::new().durability(Durability::TransientLocal);
    let basis = basis.reliable(Duration::ZERO.into()).history(History::KeepAll);
    basis.resource_limits(limits(HISTORY_LIMIT)).build()
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
    fn what_a_publisher_announces_follows_from_its_reliability_and_type() {
        let qos = |mode, kind| PublisherQos::of(mode, kind, None);
        assert_eq!(qos(Reliability::Block, ParticleFrame::TYPE), PublisherQos::Blocking);
        assert_eq!(qos(Reliability::Drop, ParticleFrame::TYPE), PublisherQos::BestEffort);
        assert_eq!(qos(Reliability::Drop, DiagnosticArray::TYPE), PublisherQos::Reliable);
        assert_eq!(qos(Reliability::Drop, PointCloud2::TYPE), PublisherQos::ReliableLarge);
        let reliable = |qos: PublisherQos| qos.policies(None).is_reliable();
        let all = [
            PublisherQos::Blocking,
            PublisherQos::Reliable,
            PublisherQos::ReliableLarge,
            PublisherQos::BestEffort,
        ];
        assert_eq!(all.map(reliable), [true, true, true, false]);
    }

    #[test]
    fn an_offer_is_announced_whatever_the_type() {
        let best_effort =
            QosProfile { reliability: ReliabilityPolicy::BestEffort, ..QosProfile::default() };
        for mode in [Reliability::Block, Reliability::Drop] {
            for (offered, is_reliable) in [(best_effort, false), (QosProfile::default(), true)] {
                let qos = PublisherQos::of(mode, ParticleFrame::TYPE, Some(&offered));
                let policies = qos.policies(NonZeroUsize::new(offered.kept()));
                assert_eq!(policies.is_reliable(), is_reliable, "{mode:?} {offered:?}");
                assert!(policies.is_volatile());
            }
        }
        let kept = PublisherQos::Blocking.policies(NonZeroUsize::new(3));
        assert_eq!(kept.durability(), Some(Durability::TransientLocal));
        assert_eq!(kept.history(), Some(History::KeepLast { depth: 3 }));
    }
}
