//! The zenoh session: rmw_zenoh's settings, and how processes find each other without a router.
//!
//! Defaults are those of `rmw_zenoh_cpp/config/DEFAULT_RMW_ZENOH_SESSION_CONFIG.json5`: a peer that
//! connects to a router on `tcp/localhost:7447` and goes on without one, no multicast, gossip, timestamps.
//! ROS nodes need that router to find each other. eddy processes do not: each listens on the first
//! free port of a small loopback range ([`ZenohOptions::ports`]) and dials, for as long as it lives,
//! every port of the range below its own. So of any two processes exactly one dials the other,
//! whichever starts first, and one that is killed and started again is found again by the others.
//! A process that finds the range full listens elsewhere, dials all of it, and meets others like it by gossip.
//!
//! `ZENOH_SESSION_CONFIG_URI` replaces all of this. `ZENOH_CONFIG_OVERRIDE` replaces single keys; one that says
//! who to listen or connect to, or another mode, also switches the range off.

use std::net::{Ipv4Addr, TcpListener};

use serde_json::json;
use zenoh::{Config, Session, Wait};

use super::middleware;
use crate::{Link, TransportError, TransportOptions, ZenohOptions};

const FILE_VARIABLE: &str = "ZENOH_SESSION_CONFIG_URI";
const OVERRIDE_VARIABLE: &str = "ZENOH_CONFIG_OVERRIDE";
/// Overridden keys that say how processes find each other.
const WAYS: [&str; 3] = ["mode", "listen", "connect"];
/// How a range's ports are dialled: the first try at once, then at these intervals (ms).
const DIAL: &str = "retry_period_init_ms=100;retry_period_max_ms=500";

/// The session of this process.
pub(super) fn open(link: &Link, options: &TransportOptions) -> Result<Session, TransportError> {
    let zenoh = &options.zenoh;
    let overrides = overrides(&zenoh.overrides)?;
    let overridden =
        |way: &str| overrides.iter().any(|(key, _)| key.split('/').next() == Some(way));
    if let Some(path) = &zenoh.config_file {
        let config = Config::from_file(path).map_err(|error| TransportError::Environment {
            variable: FILE_VARIABLE,
            found: path.display().to_string(),
            expected: format!("a zenoh configuration file: {error}"),
        })?;
        return open_with(link, config, &overrides);
    }
    let config = rmw_defaults(options).map_err(|error| middleware(link, "configure", &error))?;
    if WAYS.iter().any(|way| overridden(way)) {
        return open_with(link, config, &overrides);
    }
    let mut failed = None;
    for (listen, connect) in meeting_places(zenoh) {
        let mut config = config.clone();
        insert(&mut config, "listen/endpoints", &json!([listen]))
            .and_then(|()| insert(&mut config, "connect/endpoints", &json!(connect)))
            .map_err(|error| middleware(link, "configure", &error))?;
        match open_with(link, config, &overrides) {
            Ok(session) => return Ok(session),
            // Taken in the meantime.
            Err(error) => failed = Some(error),
        }
    }
    Err(failed.unwrap_or_else(|| middleware(link, "open the zenoh session", &"no port is free")))
}

fn open_with(
    link: &Link,
    mut config: Config,
    overrides: &[(&str, &str)],
) -> Result<Session, TransportError> {
    for (key, value) in overrides {
        config.insert_json5(key, value).map_err(|error| TransportError::Environment {
            variable: OVERRIDE_VARIABLE,
            found: format!("{key}={value}"),
            expected: format!("a zenoh setting and its JSON5 value: {error}"),
        })?;
    }
    zenoh::open(config).wait().map_err(|error| middleware(link, "open the zenoh session", &error))
}

/// The pairs in `key=value;key=value`.
fn overrides(text: &str) -> Result<Vec<(&str, &str)>, TransportError> {
    let pairs = text.split(';').map(str::trim).filter(|pair| !pair.is_empty());
    pairs
        .map(|pair| {
            pair.split_once('=').ok_or_else(|| TransportError::Environment {
                variable: OVERRIDE_VARIABLE,
                found: pair.to_owned(),
                expected: "key=value;key=value".to_owned(),
            })
        })
        .collect()
}

/// The settings of rmw_zenoh that differ from zenoh's own.
fn rmw_defaults(options: &TransportOptions) -> zenoh::Result<Config> {
    let patience = u64::try_from(options.patience.as_micros()).unwrap_or(u64::MAX);
    let settings = [
        ("mode", json!("peer")),
        ("connect/endpoints", json!([options.zenoh.router])),
        ("listen/endpoints", json!(["tcp/localhost:0"])),
        ("scouting/multicast/enabled", json!(false)),
        ("scouting/gossip/enabled", json!(true)),
        (
            "scouting/gossip/autoconnect_strategy",
            json!({ "peer": { "to_router": "always", "to_peer": "greater-zid" } }),
        ),
        // What a session waits at most for its first peers; without a router, always.
        ("scouting/delay", json!(250)),
        ("timestamping/enabled", json!(true)),
        // A lost process is noticed by its closed connection; a busy one must not count as lost.
        ("transport/link/tx/lease", json!(60_000)),
        ("transport/link/tx/keep_alive", json!(2)),
        ("transport/link/tx/queue/congestion_control/block/wait_before_close", json!(patience)),
    ];
    let mut config = Config::default();
    for (key, value) in settings {
        insert(&mut config, key, &value)?;
    }
    Ok(config)
}

fn insert(config: &mut Config, key: &str, value: &serde_json::Value) -> zenoh::Result<()> {
    config.insert_json5(key, &value.to_string())
}

/// Where to listen and whom to dial, the best first: each free port of the range with the ports
/// below it, then any port with all of them.
fn meeting_places(options: &ZenohOptions) -> impl Iterator<Item = (String, Vec<String>)> {
    let dial = |ports: &mut dyn Iterator<Item = u16>| -> Vec<String> {
        let peers = ports.map(|port| format!("tcp/127.0.0.1:{port}#{DIAL}"));
        [options.router.clone()].into_iter().chain(peers).collect()
    };
    let free = options.ports.clone().filter(|&port| is_free(port));
    let within = free.map(move |port| {
        (format!("tcp/127.0.0.1:{port}"), dial(&mut options.ports.clone().filter(|&p| p < port)))
    });
    let beyond = std::iter::once_with(move || {
        ("tcp/127.0.0.1:0".to_owned(), dial(&mut options.ports.clone()))
    });
    within.chain(beyond)
}

fn is_free(port: u16) -> bool {
    TcpListener::bind((Ipv4Addr::LOCALHOST, port)).is_ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn link() -> Link {
        "zenoh:/particles".parse().unwrap()
    }

    fn open_with_overrides(text: &str) -> String {
        let mut options = TransportOptions::new("test");
        options.zenoh.overrides = text.to_owned();
        open(&link(), &options).unwrap_err().to_string()
    }

    #[test]
    fn overrides_are_pairs_between_semicolons() {
        let pairs = overrides(r#"mode="client"; connect/endpoints=["tcp/a:1?rel=0"];"#).unwrap();
        assert_eq!(pairs, [("mode", r#""client""#), ("connect/endpoints", r#"["tcp/a:1?rel=0"]"#)]);
    }

    #[test]
    fn a_bad_override_names_variable_found_and_expected() {
        let message = open_with_overrides("mode");
        assert_eq!(message, "ZENOH_CONFIG_OVERRIDE: found `mode`, expected key=value;key=value");
        let message = open_with_overrides("mood=\"peer\"");
        assert!(message.starts_with("ZENOH_CONFIG_OVERRIDE: found `mood=\"peer\"`"), "{message}");
    }

    #[test]
    fn a_missing_configuration_file_is_named() {
        let mut options = TransportOptions::new("test");
        options.zenoh.config_file = Some("/nowhere/zenoh.json5".into());
        let message = open(&link(), &options).unwrap_err().to_string();
        assert!(
            message.starts_with("ZENOH_SESSION_CONFIG_URI: found `/nowhere/zenoh.json5`"),
            "{message}"
        );
    }

    #[test]
    fn of_any_two_processes_exactly_one_dials_the_other() {
        let options = ZenohOptions { ports: 27_448..=27_451, ..ZenohOptions::default() };
        let places: Vec<_> = meeting_places(&options).collect();
        let (_, beyond) = places.last().unwrap();
        assert_eq!(beyond.len(), 5, "the router and the whole range");
        for (listen, connect) in &places[..places.len() - 1] {
            let port: u16 = listen.rsplit(':').next().unwrap().parse().unwrap();
            assert_eq!(connect.len(), 1 + usize::from(port - 27_448), "{listen} dials {connect:?}");
            assert_eq!(connect[0], "tcp/localhost:7447");
        }
    }
}
