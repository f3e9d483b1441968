//! Responses that are larger than a datagram of the network.
//!
//! RustDDS 0.15.1 cannot fragment them. It writes the inline QoS of a `DATA_FRAG` as an `Option`, with a byte for its presence
//! in front (`messages/submessages/data_frag.rs`, `write_to`), so that no reader can parse the message, RustDDS's own not
//! either; and a response has an inline QoS, the sample identity of its request. Whether RustDDS fragments depends on the
//! interfaces of the client: 65,488 bytes are one datagram if the client has none but the loopback interface, 1,452 bytes on
//! Ethernet. Therefore the response is sent once more, with the same sequence number, as one `DATA` submessage in one
//! datagram, which IP fragments.

use std::{
    io,
    net::{IpAddr, Ipv4Addr, SocketAddr, UdpSocket},
    time::Duration,
};

use ros2_client::dds::rustdds::{SampleIdentity, no_key::DataWriter};

use super::{
    DdsNode,
    cdr::{Body, PassThrough},
    farewell,
    rtps::{self, Endpoints},
};
use crate::DiscoveryRange;

/// Smaller responses are never fragmented (bytes): IPv6 and most tunnels carry 1,280.
const UNFRAGMENTED: usize = 1024;
/// Sample identity of the request, by the OMG (DDS-RPC 1.0, 7.8.2) and by Fast DDS.
const PID_RELATED_SAMPLE_IDENTITY: [u16; 2] = [0x0083, 0x800f];
/// The response is sent until it is acknowledged, at most so often; a datagram may be lost.
const ATTEMPTS: usize = 3;
/// Time for an acknowledgment: RustDDS asks for it every 100 ms.
const ACKNOWLEDGMENT: Duration = Duration::from_millis(150);

/// A response that RustDDS has written.
pub(super) struct Response<'a> {
    pub(super) message: &'a [u8],
    pub(super) request: SampleIdentity,
    pub(super) written: SampleIdentity,
}

impl Response<'_> {
    pub(super) fn is_large(message: &[u8]) -> bool {
        message.len() > UNFRAGMENTED
    }

    /// Sends the response to all readers of its topic: one that lacks it would ask for it for ever.
    pub(super) fn send(
        &self,
        node: &DdsNode,
        topic: &str,
        writer: &DataWriter<Body, PassThrough>,
    ) -> io::Result<()> {
        let datagram = self.datagram().ok_or_else(|| {
            let size = self.message.len();
            io::Error::other(format!("a response of {size} bytes does not fit into a datagram"))
        })?;
        let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?;
        let addresses = readers(node, topic);
        for _ in 0..ATTEMPTS {
            for address in &addresses {
                if let Err(error) = socket.send_to(&datagram, address) {
                    tracing::debug!("DDS: response to {address}: {error}");
                }
            }
            if writer.wait_for_acknowledgments(ACKNOWLEDGMENT).unwrap_or(true) {
                break;
            }
        }
        Ok(())
    }

    fn datagram(&self) -> Option<Vec<u8>> {
        let [written, asked] = [self.written, self.request]
            .map(|of| (of.writer_guid.to_bytes(), i64::from(of.sequence_number)));
        let mut endpoints = Endpoints { prefix: [0; 12], reader: [0; 4], writer: [0; 4] };
        endpoints.prefix.copy_from_slice(&written.0[..12]);
        endpoints.writer.copy_from_slice(&written.0[12..]);
        let identity = [&asked.0[..], &rtps::sequence_number(asked.1)].concat();
        let inline_qos = PID_RELATED_SAMPLE_IDENTITY.map(|id| rtps::parameter(id, &identity));
        rtps::message(&endpoints, written.1, &inline_qos, self.message)
    }
}

/// Where the readers of a topic receive; IPv4, as RustDDS.
fn readers(node: &DdsNode, topic: &str) -> Vec<SocketAddr> {
    let own: Vec<IpAddr> = farewell::interfaces().map(IpAddr::V4).collect();
    let is_allowed = |address: &SocketAddr| {
        address.is_ipv4()
            && (node.range == DiscoveryRange::Subnet
                || address.ip().is_loopback()
                || own.contains(&address.ip()))
    };
    let readers = node.participant.discovered_readers().into_iter();
    let of_topic = readers.filter(|reader| reader.subscription_topic_data.topic_name() == topic);
    let locators = of_topic.flat_map(|reader| reader.reader_proxy.unicast_locator_list);
    let mut addresses: Vec<_> = locators.map(SocketAddr::from).filter(is_allowed).collect();
    addresses.sort();
    addresses.dedup();
    addresses
}

#[cfg(test)]
mod tests {
    use ros2_client::dds::rustdds::{GUID, SequenceNumber};

    use super::*;

    /// Byte by byte as in RTPS 2.5, 9.4.4 and 9.4.5.3.
    #[test]
    fn the_datagram_has_the_sample_identity_of_the_request() {
        let [writer_guid, client] = [GUID::new_participant_guid(), GUID::new_participant_guid()];
        let message = [0, 1, 0, 0, 7, 8, 9, 10];
        let response = Response {
            message: &message,
            request: SampleIdentity {
                writer_guid: client,
                sequence_number: SequenceNumber::from(5i64),
            },
            written: SampleIdentity { writer_guid, sequence_number: SequenceNumber::from(2i64) },
        };
        let mut expected = b"RTPS\x02\x04\x01\x12".to_vec();
        expected.extend(&writer_guid.to_bytes()[..12]);
        expected.extend(b"\x15\x07\x58\x00\x00\x00\x10\x00\x00\x00\x00\x00");
        expected.extend(&writer_guid.to_bytes()[12..]);
        expected.extend(b"\x00\x00\x00\x00\x02\x00\x00\x00");
        for id in [b"\x83\x00\x18\x00", b"\x0f\x80\x18\x00"] {
            expected.extend(id);
            expected.extend(client.to_bytes());
            expected.extend(b"\x00\x00\x00\x00\x05\x00\x00\x00");
        }
        expected.extend(b"\x01\x00\x00\x00");
        expected.extend(message);
        assert_eq!(response.datagram().unwrap(), expected);
    }
}
