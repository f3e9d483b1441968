//! The Zenoh session: settings of rmw_zenoh, and discovery without a router.
//!
//! The defaults are those of `rmw_zenoh_cpp/config/DEFAULT_RMW_ZENOH_SESSION_CONFIG.json5`: a peer that connects to an
//! optional router on `tcp/localhost:7447`, without multicast, with gossip and timestamps. ROS nodes need the router to
//! find each other. eddy processes do not: each listens on the first free port of a small loopback range
//! ([`ZenohOptions::ports`]) and keeps connecting to all lower ports of the range. So exactly one of any two processes
//! connects to the other, whichever starts first, and a restarted process is found again. If the range is full, a process
//! listens on another port, connects to the whole range and finds others like it by gossip.
//!
//! `ZENOH_SESSION_CONFIG_URI` replaces all of this. `ZENOH_CONFIG_OVERRIDE` replaces single keys; with the keys `mode`,
//! `listen` or `connect` the port range is not used.

use std::{
    net::{Ipv4Addr, TcpListener},
    time::Duration,
};

use serde_json::json;
use zenoh::{Config, Session, Wait};

use super::{failure::words, middleware};
use crate::{Lease, Link, TransportError, TransportOptions, ZenohOptions};

const FILE_VARIABLE: &str = "ZENOH_SESSION_CONFIG_URI";
const OVERRIDE_VARIABLE: &str = "ZENOH_CONFIG_OVERRIDE";
/// Keys whose override disables the port range.
const DISCOVERY_KEYS: [&str; 3] = ["mode", "listen", "connect"];
/// The settings of the lease.
const LEASE: &str = "transport/link/tx/lease";
const KEEP_ALIVE: &str = "transport/link/tx/keep_alive";
/// Signs of life within a lease of rmw_zenoh (60 s), and within a shorter one: a single late one must not end it.
const KEEP_ALIVES: [u64; 2] = [2, 4];
/// Retry intervals for the ports of the range (ms).
const RETRY: &str = "retry_period_init_ms=100;retry_period_max_ms=500";

/// The session of this process, and its lease.
pub(super) fn open(
    link: &Link,
    options: &TransportOptions,
) -> Result<(Session, Lease), TransportError> {
    let zenoh = &options.zenoh;
    let overrides = overrides(&zenoh.overrides)?;
    let overridden =
        |key: &str| overrides.iter().any(|(found, _)| found.split('/').next() == Some(key));
    if let Some(path) = &zenoh.config_file {
        let config = Config::from_file(path).map_err(|error| TransportError::Environment {
            variable: FILE_VARIABLE,
            found: path.display().to_string(),
            expected: format!("a zenoh configuration file ({})", words(&error)),
        })?;
        return open_with(link, config, &overrides);
    }
    let config = rmw_defaults(options).map_err(|error| middleware(link, "configure", &error))?;
    if DISCOVERY_KEYS.iter().any(|key| overridden(key)) {
        return open_with(link, config, &overrides);
    }
    let mut failed = None;
    for (listen, connect) in endpoints(zenoh) {
        let mut config = config.clone();
        insert(&mut config, "listen/endpoints", &json!([listen]))
            .and_then(|()| insert(&mut config, "connect/endpoints", &json!(connect)))
            .map_err(|error| middleware(link, "configure", &error))?;
        match open_with(link, config, &overrides) {
            Ok(opened) => return Ok(opened),
            // The port was taken in the meantime.
            Err(error) => failed = Some(error),
        }
    }
    Err(failed.unwrap_or_else(|| middleware(link, "open the zenoh session", &"no port is free")))
}

fn open_with(
    link: &Link,
    mut config: Config,
    overrides: &[(&str, &str)],
) -> Result<(Session, Lease), TransportError> {
    for (key, value) in overrides {
        config.insert_json5(key, value).map_err(|error| TransportError::Environment {
            variable: OVERRIDE_VARIABLE,
            found: format!("{key}={value}"),
            expected: format!("a setting of zenoh and its value in JSON5 ({})", words(&error)),
        })?;
    }
    let lease = lease(&config).map_err(|error| middleware(link, "configure", &error))?;
    let session = zenoh::open(config).wait();
    Ok((session.map_err(|error| middleware(link, "open the zenoh session", &error))?, lease))
}

/// The lease in the settings.
fn lease(config: &Config) -> zenoh::Result<Lease> {
    let number = |key| Ok::<u64, zenoh::Error>(config.get_json(key)?.parse()?);
    let duration = Duration::from_millis(number(LEASE)?);
    let keep_alives = u32::try_from(number(KEEP_ALIVE)?)?;
    Ok(Lease { duration, keep_alive: duration / keep_alives.max(1) })
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
    let is_shortened = options.zenoh.lease < ZenohOptions::default().lease;
    let lease = u64::try_from(options.zenoh.lease.as_millis()).unwrap_or(u64::MAX);
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
        // Longest wait for the first peers; without a router, the full time.
        ("scouting/delay", json!(250)),
        ("timestamping/enabled", json!(true)),
        // Lost processes are detected by their closed connection; the lease must not expire for busy ones.
        (LEASE, json!(lease)),
        (KEEP_ALIVE, json!(KEEP_ALIVES[usize::from(is_shortened)])),
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

/// Endpoints to listen on and to connect to, in order of preference: each free port of the range with all lower ports,
/// then any port with the whole range.
fn endpoints(options: &ZenohOptions) -> impl Iterator<Item = (String, Vec<String>)> {
    let connect = |ports: &mut dyn Iterator<Item = u16>| -> Vec<String> {
        let peers = ports.map(|port| format!("tcp/127.0.0.1:{port}#{RETRY}"));
        [options.router.clone()].into_iter().chain(peers).collect()
    };
    let free = options.ports.clone().filter(|&port| is_free(port));
    let within = free.map(move |port| {
        (format!("tcp/127.0.0.1:{port}"), connect(&mut options.ports.clone().filter(|&p| p < port)))
    });
    let beyond = std::iter::once_with(move || {
        ("tcp/127.0.0.1:0".to_owned(), connect(&mut options.ports.clone()))
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
    fn an_invalid_override_is_rejected_with_variable_found_and_expected() {
        let message = open_with_overrides("mode");
        assert_eq!(message, "ZENOH_CONFIG_OVERRIDE: found `mode`, expected key=value;key=value");
        let message = open_with_overrides("mood=\"peer\"");
        let expected = "ZENOH_CONFIG_OVERRIDE: found `mood=\"peer\"`, expected a setting of zenoh";
        assert!(message.starts_with(expected) && !message.contains(".rs"), "{message}");
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
    fn exactly_one_of_any_two_processes_connects_to_the_other() {
        let options = ZenohOptions { ports: 27_448..=27_451, ..ZenohOptions::default() };
        let places: Vec<_> = endpoints(&options).collect();
        let (_, beyond) = places.last().unwrap();
        assert_eq!(beyond.len(), 5, "the router and the whole range");
        for (listen, connect) in &places[..places.len() - 1] {
            let port: u16 = listen.rsplit(':').next().unwrap().parse().unwrap();
            assert_eq!(
                connect.len(),
                1 + usize::from(port - 27_448),
                "{listen} connects to {connect:?}"
            );
            assert_eq!(connect[0], "tcp/localhost:7447");
        }
    }
}
