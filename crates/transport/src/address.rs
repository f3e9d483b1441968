//! Addresses of servers; the loopback interface by default.

use std::{
    fmt,
    net::{IpAddr, Ipv4Addr, SocketAddr},
    str::FromStr,
};

/// An address of this machine with a port. A text may omit the port (`PORT`; 8080 for the live page) or the address (the
/// loopback interface); port 0 means any free port.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ListenAddress<const PORT: u16 = 8080>(pub SocketAddr);

/// A text that is not a [`ListenAddress`].
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "found `{found}`, expected a port (9000), an address (0.0.0.0) or both (0.0.0.0:9000, [::1]:9000)"
)]
pub struct InvalidAddress {
    found: String,
}

impl<const PORT: u16> ListenAddress<PORT> {
    /// A port of the loopback interface.
    pub fn loopback(port: u16) -> Self {
        Self(SocketAddr::from((Ipv4Addr::LOCALHOST, port)))
    }
}

impl<const PORT: u16> FromStr for ListenAddress<PORT> {
    type Err = InvalidAddress;

    fn from_str(text: &str) -> Result<Self, InvalidAddress> {
        let text = text.trim();
        let numeric = text.replacen("localhost", "127.0.0.1", 1);
        let port = || numeric.parse().ok().map(Self::loopback);
        let both = || numeric.parse().ok().map(Self);
        let address = || {
            let bare = numeric.trim_start_matches('[').trim_end_matches(']');
            bare.parse::<IpAddr>().ok().map(|address| Self(SocketAddr::new(address, PORT)))
        };
        port()
            .or_else(both)
            .or_else(address)
            .ok_or_else(|| InvalidAddress { found: text.to_owned() })
    }
}

impl<const PORT: u16> fmt::Display for ListenAddress<PORT> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_is_a_port_an_ip_or_both() {
        for (text, expected) in [
            ("9000", "127.0.0.1:9000"),
            ("0.0.0.0", "0.0.0.0:8080"),
            ("0.0.0.0:9000", "0.0.0.0:9000"),
            ("localhost:0", "127.0.0.1:0"),
            ("::1", "[::1]:8080"),
            ("[::1]:9000", "[::1]:9000"),
        ] {
            assert_eq!(text.parse::<ListenAddress>().unwrap().to_string(), expected);
        }
        let other: ListenAddress<8765> = "0.0.0.0".parse().unwrap();
        assert_eq!(other.to_string(), "0.0.0.0:8765");
        for text in ["", "robot", "bags/mm", "70000", "1.2.3.4:x"] {
            assert!(text.parse::<ListenAddress>().is_err(), "{text}");
        }
    }
}
