//! What the reliability of a publisher means as quality of service.

use eddy_messages::{
    QosProfile,
    qos::{HistoryPolicy, ReliabilityPolicy},
};

use crate::{Reliability, transports::is_frames};

/// The QoS that a publisher of this type offers unless something else is asked for: of a blocking one reliable, keep all; of a dropping
/// one best effort for frames, otherwise reliable, keep last, because reliable subscribers, the default of ROS 2, do not match a
/// best-effort publisher.
pub fn default_qos(reliability: Reliability, type_name: &str) -> QosProfile {
    let usual = QosProfile::default();
    match reliability {
        Reliability::Block => QosProfile { history: HistoryPolicy::KeepAll, ..usual },
        Reliability::Drop if is_frames(type_name) => {
            QosProfile { reliability: ReliabilityPolicy::BestEffort, ..usual }
        }
        Reliability::Drop => usual,
    }
}

impl Reliability {
    /// What a publisher does that offers this: only one that keeps all messages reliably waits, as in rmw_zenoh.
    pub fn of_offer(offered: &QosProfile) -> Self {
        match (offered.reliability, offered.history) {
            (ReliabilityPolicy::Reliable, HistoryPolicy::KeepAll) => Self::Block,
            _ => Self::Drop,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use eddy_messages::{Message as _, ParticleFrame, RosString};

    #[test]
    fn what_follows_from_the_reliability_means_the_same_reliability() {
        for reliability in [Reliability::Block, Reliability::Drop] {
            for type_name in [ParticleFrame::TYPE, RosString::TYPE] {
                let offered = default_qos(reliability, type_name);
                assert_eq!(Reliability::of_offer(&offered), reliability, "{type_name}");
            }
        }
    }

    #[test]
    fn only_frames_of_dropping_publishers_are_best_effort() {
        let policy = |reliability, type_name| default_qos(reliability, type_name).reliability;
        let best_effort = policy(Reliability::Drop, ParticleFrame::TYPE);
        assert_eq!(best_effort, ReliabilityPolicy::BestEffort);
        assert_eq!(policy(Reliability::Drop, RosString::TYPE), ReliabilityPolicy::Reliable);
        assert_eq!(policy(Reliability::Block, ParticleFrame::TYPE), ReliabilityPolicy::Reliable);
    }
}
