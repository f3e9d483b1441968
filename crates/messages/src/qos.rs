//! Quality of service of publishers, as far as ROS 2 tells others about it (docs.ros.org, "Quality of Service settings").

use super::{Message as _, ToolDescription};

/// Policies that a publisher offers or a subscriber requests.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct QosProfile {
    /// Whether lost messages are repaired.
    pub reliability: ReliabilityPolicy,
    /// Whether late-joining subscribers receive earlier messages.
    pub durability: DurabilityPolicy,
    /// How many messages are kept.
    pub history: HistoryPolicy,
}

/// Whether lost messages are repaired.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum ReliabilityPolicy {
    /// They are.
    #[default]
    Reliable,
    /// They are not.
    BestEffort,
}

/// Whether late-joining subscribers receive earlier messages.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum DurabilityPolicy {
    /// They do not.
    #[default]
    Volatile,
    /// They receive those that the publisher keeps.
    TransientLocal,
}

/// How many messages are kept.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum HistoryPolicy {
    /// The last ones: their number (depth).
    KeepLast(usize),
    /// All, as far as resources allow.
    KeepAll,
    /// Not known: DDS does not announce it.
    Unknown,
}

impl Default for HistoryPolicy {
    /// The default of ROS 2.
    fn default() -> Self {
        Self::KeepLast(10)
    }
}

/// What publishers of tool descriptions offer: late-joining subscribers receive those of the last 64 streams.
pub const TOOL_DESCRIPTION_QOS: QosProfile = QosProfile {
    reliability: ReliabilityPolicy::Reliable,
    durability: DurabilityPolicy::TransientLocal,
    history: HistoryPolicy::KeepLast(64),
};

/// Messages kept for late-joining subscribers by publishers that keep all.
const KEEP_ALL_LIMIT: usize = 1_024;

impl QosProfile {
    /// What publishers of a type offer unless something else is asked for.
    pub fn usual(type_name: &str) -> Self {
        match type_name {
            ToolDescription::TYPE => TOOL_DESCRIPTION_QOS,
            _ => Self::default(),
        }
    }

    /// Number of messages kept for late-joining subscribers; 0 if volatile, 1 if unknown.
    pub fn kept(&self) -> usize {
        match (self.durability, self.history) {
            (DurabilityPolicy::Volatile, _) => 0,
            (_, HistoryPolicy::KeepLast(depth)) => depth.max(1),
            (_, HistoryPolicy::KeepAll) => KEEP_ALL_LIMIT,
            (_, HistoryPolicy::Unknown) => 1,
        }
    }

    /// The profile of one publisher in place of several with these profiles; `None` without profiles.
    ///
    /// It is reliable if one of them is, so that every subscriber of theirs receives it; transient local if all are,
    /// and keeps as many messages as they together.
    pub fn in_place_of(offered: &[Self]) -> Option<Self> {
        let first = offered.first()?;
        let reliability = offered.iter().map(|profile| profile.reliability).min()?;
        let durability = offered.iter().map(|profile| profile.durability).min()?;
        let history = match durability {
            _ if offered.len() == 1 && first.history != HistoryPolicy::Unknown => first.history,
            DurabilityPolicy::TransientLocal => {
                let kept = offered.iter().map(Self::kept).fold(0, usize::saturating_add);
                HistoryPolicy::KeepLast(kept.min(KEEP_ALL_LIMIT))
            }
            DurabilityPolicy::Volatile => {
                let histories = offered.iter().map(|profile| profile.history);
                histories
                    .filter(|history| *history != HistoryPolicy::Unknown)
                    .max()
                    .unwrap_or_default()
            }
        };
        Some(Self { reliability, durability, history })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use DurabilityPolicy::{TransientLocal, Volatile};
    use HistoryPolicy::{KeepAll, KeepLast, Unknown};
    use ReliabilityPolicy::{BestEffort, Reliable};

    fn profile(
        reliability: ReliabilityPolicy,
        durability: DurabilityPolicy,
        history: HistoryPolicy,
    ) -> QosProfile {
        QosProfile { reliability, durability, history }
    }

    #[test]
    fn one_publisher_replaces_several() {
        let cases = [
            (vec![(BestEffort, Volatile, KeepLast(5))], (BestEffort, Volatile, KeepLast(5))),
            (vec![(Reliable, Volatile, Unknown)], (Reliable, Volatile, KeepLast(10))),
            (vec![(Reliable, TransientLocal, Unknown)], (Reliable, TransientLocal, KeepLast(1))),
            (
                vec![
                    (Reliable, TransientLocal, KeepLast(2)),
                    (Reliable, TransientLocal, KeepLast(0)),
                ],
                (Reliable, TransientLocal, KeepLast(3)),
            ),
            (
                vec![(BestEffort, Volatile, KeepLast(5)), (Reliable, TransientLocal, KeepLast(1))],
                (Reliable, Volatile, KeepLast(5)),
            ),
            (
                vec![(Reliable, Volatile, KeepLast(5)), (Reliable, Volatile, KeepAll)],
                (Reliable, Volatile, KeepAll),
            ),
        ];
        for (offered, (reliability, durability, history)) in cases {
            let offered: Vec<_> = offered.into_iter().map(|(r, d, h)| profile(r, d, h)).collect();
            let expected = profile(reliability, durability, history);
            assert_eq!(QosProfile::in_place_of(&offered), Some(expected), "{offered:?}");
        }
        assert_eq!(QosProfile::in_place_of(&[]), None);
    }

    #[test]
    fn only_transient_local_publishers_keep_messages_for_others() {
        let kept = |durability, history| profile(Reliable, durability, history).kept();
        assert_eq!([kept(Volatile, KeepAll), kept(TransientLocal, KeepLast(0))], [0, 1]);
        assert_eq!([kept(TransientLocal, KeepLast(7)), kept(TransientLocal, Unknown)], [7, 1]);
    }
}
