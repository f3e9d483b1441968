//! The DDS participant.

use std::net::{IpAddr, Ipv4Addr};

use ros2_client::dds::rustdds::{DomainParticipant, DomainParticipantBuilder};

use super::middleware;
use crate::{DiscoveryRange, Link, TransportError, TransportOptions};

/// Opens the participant of this process in its domain.
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
    builder.build().map_err(|error| middleware(link, "open the DDS participant", &error))
}
