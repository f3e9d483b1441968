//! Groups of processes.

use std::time::Duration;

use eddy_transport::{Lease, Link, Membership, TransportError, Transports};

use super::{ends, eventually, link, options};

fn membership(transports: &Transports, link: &Link, group: &str) -> Box<dyn Membership> {
    transports.membership(link, group, "label").unwrap()
}

#[test]
fn members_are_seen_from_when_they_join_until_they_leave_and_join_again_under_another_id() {
    let (link, [here, there]) = (link("zenoh"), ends("zenoh", options()));
    let (mut one, mut two) = (membership(&here, &link, "a"), membership(&there, &link, "a"));
    eventually("they are connected", || one.is_connected() && two.is_connected());
    one.join().unwrap();
    let first = one.id().to_owned();
    assert!(first.ends_with("-label"), "{first}");
    for member in [&one, &two] {
        eventually("the first has joined", || member.members() == [first.clone()].into());
    }
    two.join().unwrap();
    let second = two.id().to_owned();
    for member in [&one, &two] {
        let both = [first.clone(), second.clone()].into();
        eventually("both have joined", || member.members() == both);
    }

    one.leave();
    for member in [&one, &two] {
        eventually("the first has left", || member.members() == [second.clone()].into());
    }
    one.join().unwrap();
    let again = one.id().to_owned();
    assert!(again != first && again != second);
    eventually("it has joined again", || two.members() == [again.clone(), second.clone()].into());

    drop(one);
    eventually("it is dropped", || two.members() == [second.clone()].into());
}

#[test]
fn groups_of_other_names_topics_or_domains_are_other_groups() {
    let (topic, other) = (link("zenoh"), link("zenoh"));
    let first = options();
    let mut elsewhere = first.clone();
    elsewhere.domain_id = 1;
    let [here, there] = ends("zenoh", first);
    let elsewhere = Transports::new(elsewhere);
    let mut joined = [
        membership(&there, &topic, "a"),
        membership(&there, &topic, "b"),
        membership(&there, &other, "a"),
        membership(&elsewhere, &topic, "a"),
    ];
    let same = membership(&here, &topic, "a");
    // In this order, the last one is seen last.
    for member in joined.iter_mut().rev() {
        member.join().unwrap();
    }
    let expected = [joined[0].id().to_owned()].into();
    eventually("the member of the same group is seen", || same.members() == expected);
}

#[test]
fn a_process_alone_is_not_connected_and_its_lease_is_that_of_its_options() {
    let mut options = options();
    options.zenoh.lease = Duration::from_millis(800);
    let transports = Transports::new(options.clone());
    let mut alone = membership(&transports, &link("zenoh"), "a");
    assert!(!alone.is_connected());
    let (duration, keep_alive) = (Duration::from_millis(800), Duration::from_millis(200));
    assert_eq!(alone.lease(), Lease { duration, keep_alive });

    // The configuration decides.
    options.zenoh.overrides = "transport/link/tx/lease=3000".to_owned();
    options.zenoh.ports = super::ports();
    let other = membership(&Transports::new(options), &link("zenoh"), "a");
    assert_eq!(other.lease().duration, Duration::from_secs(3));
}

#[test]
fn only_zenoh_has_groups() {
    for transport in ["memory", "shm", "dds"] {
        let [transports, _] = ends(transport, options());
        let error = transports.membership(&link(transport), "a", "label").err();
        assert!(matches!(error, Some(TransportError::NoGroups { .. })), "{transport}: {error:?}");
    }
}
