//! The DDS participant.

use std::{
    net::{IpAddr, Ipv4Addr},
    thread,
    time::Duration,
};

use ros2_client::dds::rustdds::{DomainParticipant, DomainParticipantBuilder};

use super::middleware;
use crate::{DiscoveryRange, Link, TransportError, TransportOptions};

/// Time until the participants of the domain know a new one (s). RustDDS announces it 100 ms after its start and answers
/// announcements of others after 10 ms.
const INTRODUCTION: Duration = Duration::from_millis(300);

/// Opens the participant of this process in its domain, and waits until others know it.
///
/// Endpoints created before are announced out of order: RustDDS 0.15.1 sends them to any participant that it knows,
/// whether or not that one knows it, and repeats the first ones after the later ones. It sends no timestamp with them.
/// Fast DDS orders what it receives by writer and timestamp (`history_order_cmp`); with such announcements of two
/// participants it finds the repeated ones in the wrong place, drops them and acknowledges them, so that these endpoints
/// never exist for it.
pub(super) fn open(
    link: &Link,
    options: &TransportOptions,
) -> Result<DomainParticipant, TransportError> {
    let builder = DomainParticipantBuilder::new(options.domain_id);
    let builder = match options.dds.range {
        DiscoveryRange::Localhost => builder.with_only_networks([IpAddr::V4(Ipv4Addr::LOCALHOST)]),
        DiscoveryRange::Subnet => builder,
        DiscoveryRange::Off => {
            return Err(TransportError::Environment {
                variable: "ROS_AUTOMATIC_DISCOVERY_RANGE",
                found: "OFF".to_owned(),
                expected: format!("LOCALHOST, SUBNET or SYSTEM_DEFAULT for {link}"),
            });
        }
    };
    let participant =
        builder.build().map_err(|error| middleware(link, "open the DDS participant", &error))?;
    thread::sleep(INTRODUCTION);
    Ok(participant)
}
