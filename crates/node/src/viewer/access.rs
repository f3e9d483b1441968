//! Allows only requests from this server's own pages, addressed to this machine.
//!
//! Pages of other sites, open in a browser that can reach this server, must not watch or control the node. Their
//! requests carry their `Origin`, and a foreign name that resolves to this machine (DNS rebinding) appears as `Host`.

use std::net::IpAddr;

use axum::http::{HeaderMap, header};

/// Why a request is rejected.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub(super) enum Forbidden {
    #[error("Host: found {found}, expected an address of this machine, localhost or its name")]
    Host { found: String },
    #[error("Origin: found {found}, expected http://{expected}")]
    Origin { found: String, expected: String },
}

/// Checks the headers of a request; `name` is the host name of this machine.
pub(super) fn check(headers: &HeaderMap, name: Option<&str>) -> Result<(), Forbidden> {
    let text = |field| headers.get(field).map(|value| value.to_str().unwrap_or("?"));
    let host = text(header::HOST).unwrap_or("nothing");
    if headers.get_all(header::HOST).iter().count() > 1 || !is_ours(host, name) {
        return Err(Forbidden::Host { found: host.to_owned() });
    }
    // Only browsers send it, and only browsers need to be restricted.
    let Some(origin) = text(header::ORIGIN) else { return Ok(()) };
    let authority = origin.strip_prefix("http://").or(origin.strip_prefix("https://"));
    if authority.is_some_and(|authority| authority.eq_ignore_ascii_case(host)) {
        return Ok(());
    }
    Err(Forbidden::Origin { found: origin.to_owned(), expected: host.to_owned() })
}

/// Whether `host` is a name that no foreign DNS server controls.
fn is_ours(host: &str, name: Option<&str>) -> bool {
    let bare = match host.rsplit_once(':') {
        Some((bare, port)) if port.bytes().all(|digit| digit.is_ascii_digit()) => bare,
        _ => host,
    };
    let address = bare.strip_prefix('[').and_then(|rest| rest.strip_suffix(']')).unwrap_or(bare);
    let named = |ours: &str| {
        let local = bare.strip_suffix(".local").unwrap_or(bare);
        !ours.is_empty() && (bare.eq_ignore_ascii_case(ours) || local.eq_ignore_ascii_case(ours))
    };
    address.parse::<IpAddr>().is_ok()
        || bare.eq_ignore_ascii_case("localhost")
        || name.is_some_and(named)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn verdict(host: &str, origin: Option<&str>) -> Result<(), Forbidden> {
        let mut headers = HeaderMap::new();
        headers.insert(header::HOST, host.parse().unwrap());
        if let Some(origin) = origin {
            headers.insert(header::ORIGIN, origin.parse().unwrap());
        }
        check(&headers, Some("robot"))
    }

    #[test]
    fn pages_of_this_server_may_connect() {
        for host in [
            "127.0.0.1:8080",
            "localhost:8080",
            "[::1]:8080",
            "10.0.0.2",
            "robot:1",
            "robot.local:1",
        ] {
            assert_eq!(verdict(host, None), Ok(()), "{host}");
            assert_eq!(verdict(host, Some(&format!("http://{host}"))), Ok(()), "{host}");
        }
    }

    #[test]
    fn pages_of_other_sites_may_not_whatever_name_they_use_for_this_machine() {
        for host in
            ["evil.example:8080", "127.0.0.1.evil.example", "localhost.evil", "robot.evil:1", ""]
        {
            assert!(matches!(verdict(host, None), Err(Forbidden::Host { .. })), "{host}");
        }
        for origin in
            ["http://evil.example", "http://127.0.0.1:9999", "null", "http://127.0.0.1:8080.evil"]
        {
            let verdict = verdict("127.0.0.1:8080", Some(origin));
            assert!(matches!(verdict, Err(Forbidden::Origin { .. })), "{origin}");
        }
        assert!(check(&HeaderMap::new(), None).is_err());
    }
}
