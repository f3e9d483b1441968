//! The farewell of a participant, in the form that Fast DDS requires.
//!
//! RustDDS 0.15.1 announces the end of a participant with the key of its data as payload and no `PID_KEY_HASH` in the inline
//! QoS (`rtps/message.rs`, `data_msg`). Fast DDS 3 takes the key from the key hash, or from a payload of at most 16 bytes
//! (`rtps/messages/MessageReceiver.cpp`, `proc_Submsg_Data`); the payload of RustDDS has 28, so that Fast DDS ignores the
//! message and keeps the node in the ROS graph until its lease of 50 s ends. Therefore the message is sent once more,
//! with the key hash, when the participant is closed. Discovery of participants is best effort, so it is repeated: a receiver that
//! is busy may lose one, but hardly those after its next turn on the processor. The node itself leaves the graph before that, by a
//! reliable message ([`Graph::leave`](super::graph::Graph::leave)).

use std::{
    net::{Ipv4Addr, SocketAddrV4, UdpSocket},
    thread,
    time::Duration,
};

use ros2_client::dds::rustdds::{DomainParticipant, GUID, RTPSEntity};

use super::rtps::{self, Endpoints};
use crate::{DiscoveryRange, TransportOptions};

/// Default ports of discovery (RTPS 2.5, 9.6.2.3): `PB + DG * domain` for multicast, and
/// `PB + DG * domain + D1 + PG * participant` for unicast.
const PB: u16 = 7400;
const DG: u16 = 250;
const PG: u16 = 2;
const D1: u16 = 10;
/// Participants of a domain and machine with ports of their own: the next port belongs to another domain.
const PARTICIPANTS: u16 = (DG - D1) / PG;
/// Multicast group of discovery (RTPS 2.5, 9.6.2.4.1).
const GROUP: Ipv4Addr = Ipv4Addr::new(239, 255, 0, 1);

/// `ENTITYID_SPDP_BUILTIN_PARTICIPANT_READER` and `..._WRITER` (RTPS 2.5, 9.3.2.1).
const READER: [u8; 4] = [0, 1, 0, 0xc7];
const WRITER: [u8; 4] = [0, 1, 0, 0xc2];
/// Beyond the sequence number of any earlier message of the writer, as readers skip older ones. Repetitions have the same, so that a
/// reader takes one of them.
const SEQUENCE: i64 = 1 << 32;
/// Pauses before each message: a turn of a busy process on a processor is 3 ms (Linux, `sched_base_slice`) times the number of
/// such processes.
const PAUSES: [Duration; 4] = [
    Duration::ZERO,
    Duration::from_millis(10),
    Duration::from_millis(40),
    Duration::from_millis(150),
];
/// Parameters of the inline QoS (9.6.4).
const PID_KEY_HASH: u16 = 0x0070;
const PID_STATUS_INFO: u16 = 0x0071;
/// Disposed and unregistered; big-endian in any message (9.6.4.9).
const STATUS: [u8; 4] = [0, 0, 0, 0b11];

/// Sends the farewell of a participant when it is dropped, which is to happen after the participant is closed: an
/// announcement after the farewell would bring it back.
pub(super) struct Farewell {
    message: Vec<u8>,
    domain_id: u16,
    range: DiscoveryRange,
}

impl Farewell {
    pub(super) fn of(participant: &DomainParticipant, options: &TransportOptions) -> Self {
        let message = message(participant.guid());
        Self { message, domain_id: options.domain_id, range: options.dds.range }
    }
}

impl Drop for Farewell {
    fn drop(&mut self) {
        for pause in PAUSES {
            thread::sleep(pause);
            self.send();
        }
    }
}

impl Farewell {
    fn send(&self) {
        let unicast = unicast_ports(self.domain_id);
        let machine = unicast.map(|port| SocketAddrV4::new(Ipv4Addr::LOCALHOST, port));
        send(&self.message, Ipv4Addr::LOCALHOST, machine);
        if self.range == DiscoveryRange::Subnet {
            let group = SocketAddrV4::new(GROUP, PB + DG * self.domain_id);
            // Linux sends multicast through the interface of the address that a socket is bound to.
            for address in interfaces() {
                send(&self.message, address, [group]);
            }
        }
    }
}

/// The discovery ports of all participants of a domain on one machine.
fn unicast_ports(domain_id: u16) -> impl Iterator<Item = u16> {
    let first = PB + DG * domain_id + D1;
    (0..PARTICIPANTS).map_while(move |number| first.checked_add(PG * number))
}

/// The IPv4 addresses of the other interfaces.
pub(super) fn interfaces() -> impl Iterator<Item = Ipv4Addr> {
    let networks = netdev::get_interfaces().into_iter().flat_map(|interface| interface.ipv4);
    networks.map(|network| network.addr()).filter(|address| !address.is_loopback())
}

fn send(message: &[u8], from: Ipv4Addr, to: impl IntoIterator<Item = SocketAddrV4>) {
    let failed = |error| tracing::debug!("DDS: farewell from {from}: {error}");
    let socket = match UdpSocket::bind((from, 0)) {
        Ok(socket) => socket,
        Err(error) => return failed(error),
    };
    for address in to {
        if let Err(error) = socket.send_to(message, address) {
            failed(error);
        }
    }
}

/// An RTPS message without payload.
fn message(participant: GUID) -> Vec<u8> {
    let guid = participant.to_bytes();
    let mut endpoints = Endpoints { prefix: [0; 12], reader: READER, writer: WRITER };
    endpoints.prefix.copy_from_slice(&guid[..12]);
    let inline_qos =
        [rtps::parameter(PID_KEY_HASH, &guid), rtps::parameter(PID_STATUS_INFO, &STATUS)];
    // Far shorter than a message can be.
    rtps::message(&endpoints, SEQUENCE, &inline_qos, &[]).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Byte by byte as in RTPS 2.5, 9.4.4 and 9.4.5.3.
    #[test]
    fn the_message_disposes_of_the_participant_by_its_key_hash() {
        let guid = GUID::new_participant_guid();
        let bytes = guid.to_bytes();
        let mut expected = b"RTPS\x02\x04\x01\x12".to_vec();
        expected.extend(&bytes[..12]);
        expected.extend(b"\x15\x03\x34\x00\x00\x00\x10\x00\x00\x01\x00\xc7\x00\x01\x00\xc2");
        expected.extend(b"\x01\x00\x00\x00\x00\x00\x00\x00\x70\x00\x10\x00");
        expected.extend(bytes);
        expected.extend(b"\x71\x00\x04\x00\x00\x00\x00\x03\x01\x00\x00\x00");
        assert_eq!(message(guid), expected);
    }

    /// A receiver that loses the first message, as a busy one does.
    #[test]
    fn a_participant_that_misses_the_first_message_receives_another() {
        const DOMAIN: u16 = 231;
        let bound = unicast_ports(DOMAIN)
            .find_map(|port| UdpSocket::bind((Ipv4Addr::LOCALHOST, port)).ok())
            .unwrap();
        bound.set_read_timeout(Some(Duration::from_secs(30))).unwrap();
        let message = message(GUID::new_participant_guid());
        let range = DiscoveryRange::Localhost;
        drop(Farewell { message: message.clone(), domain_id: DOMAIN, range });
        let mut bytes = [0; 256];
        for _ in PAUSES {
            let length = bound.recv(&mut bytes).unwrap();
            assert_eq!(bytes[..length], message);
        }
    }

    #[test]
    fn the_ports_of_a_domain_are_those_of_its_participants() {
        let of = |domain_id| unicast_ports(domain_id).collect::<Vec<_>>();
        assert_eq!((of(0)[0], of(0)[1], of(0).last()), (7410, 7412, Some(&7648)));
        assert_eq!(of(1)[0], 7660);
        // Ports end at 65535.
        assert_eq!((of(232)[0], of(232).last()), (65_410, Some(&65_534)));
    }
}
