//! The owner of a stream: the member with the highest score for it (rendezvous hashing, Thaler and Ravishankar 1998,
//! "Using name-based mappings to increase hit rates").
//!
//! All nodes that see the same members agree without a message. When a member leaves, only its streams move; one that
//! joins takes an equal share from each of the others.

use std::collections::BTreeSet;

use xxhash_rust::xxh3::xxh3_64;

/// The members of a group.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Members(Vec<Member>);

#[derive(Clone, Debug, PartialEq, Eq)]
struct Member {
    id: String,
    /// XXH3-64 of the id.
    hash: u64,
}

impl Members {
    pub(super) fn new(ids: &BTreeSet<String>) -> Self {
        let member = |id: &String| Member { id: id.clone(), hash: xxh3_64(id.as_bytes()) };
        Self(ids.iter().map(member).collect())
    }

    pub(super) fn ids(&self) -> impl Iterator<Item = &str> {
        self.0.iter().map(|member| member.id.as_str())
    }

    pub(super) fn len(&self) -> usize {
        self.0.len()
    }

    /// The owner of a stream; `None` without members.
    pub(super) fn owner(&self, stream: u64) -> Option<&str> {
        // Equal scores, which are unlikely, are decided by the id.
        let best = self.0.iter().max_by_key(|member| (member.score(stream), &member.id))?;
        Some(&best.id)
    }
}

impl Member {
    /// XXH3-64 of the stream's number and the hash of the member, both little-endian: the same on every machine.
    fn score(&self, stream: u64) -> u64 {
        let mut bytes = [0; 16];
        bytes[..8].copy_from_slice(&stream.to_le_bytes());
        bytes[8..].copy_from_slice(&self.hash.to_le_bytes());
        xxh3_64(&bytes)
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use proptest::prelude::*;

    use super::*;

    const STREAMS: u64 = 4_000;

    fn members(ids: impl IntoIterator<Item = u32>) -> Members {
        Members::new(&ids.into_iter().map(|id| format!("{id:032x}-0")).collect())
    }

    #[test]
    fn a_group_without_members_owns_nothing() {
        assert_eq!(Members::default().owner(1), None);
    }

    /// Computed with the Python package xxhash: the largest
    /// `xxh3_64_intdigest(pack("<QQ", stream, xxh3_64_intdigest(id)))` of the ids `a`, `b` and `c`.
    #[test]
    fn owners_are_the_same_on_every_machine() {
        let ids = ["a", "b", "c"].map(str::to_owned).into();
        let members = Members::new(&ids);
        let owners: Vec<_> = (0..12).filter_map(|stream| members.owner(stream)).collect();
        assert_eq!(owners.concat(), OWNERS);
    }
    const OWNERS: &str = "accbbbaaccaa";

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(16))]

        /// A binomial distribution of 4,000 streams: six standard deviations.
        #[test]
        fn every_member_owns_its_share(first in any::<u32>(), count in 2_u32..20) {
            let members = members((0..count).map(|n| first.wrapping_add(n)));
            let mut shares = BTreeMap::<&str, u64>::new();
            for stream in 0..STREAMS {
                *shares.entry(members.owner(stream).unwrap()).or_default() += 1;
            }
            prop_assert_eq!(shares.len(), count as usize);
            let p = 1.0 / f64::from(count);
            let (mean, deviation) = (STREAMS as f64 * p, (STREAMS as f64 * p * (1.0 - p)).sqrt());
            for (member, share) in shares {
                prop_assert!((share as f64 - mean).abs() < 6.0 * deviation, "{}: {}", member, share);
            }
        }

        #[test]
        fn only_the_streams_of_a_member_that_leaves_move(first in any::<u32>(), count in 2_u32..20) {
            let ids = || (0..count).map(|n| first.wrapping_add(n));
            let (before, after) = (members(ids()), members(ids().skip(1)));
            let left = format!("{first:032x}-0");
            for stream in 0..STREAMS {
                let (old, new) = (before.owner(stream).unwrap(), after.owner(stream).unwrap());
                prop_assert_eq!(old == left, old != new, "stream {}: {} to {}", stream, old, new);
            }
        }
    }
}
