//! A client of services in the wire format of rmw_zenoh, with plain zenoh.

use std::{cell::Cell, time::Duration};

use eddy_messages::{cdr, service_hash};
use serde::{Serialize, de::DeserializeOwned};
use zenoh::{
    Session, Wait,
    query::{ConsolidationMode, QueryTarget},
};

/// Timeout of a request.
const PATIENCE: Duration = Duration::from_secs(10);
/// In ROS XXH3-128 of a token; services return it unchanged.
const GID: [u8; 16] = *b"a client's gid..";

/// A session connected to the port of one process.
pub struct Client {
    session: Session,
    domain: u16,
    sequence: Cell<i64>,
}

impl Client {
    pub fn of(port: u16, domain: u16) -> Self {
        let mut config = zenoh::Config::default();
        for (key, value) in [
            ("mode", r#""peer""#.to_owned()),
            ("listen/endpoints", r#"["tcp/127.0.0.1:0"]"#.to_owned()),
            ("connect/endpoints", format!(r#"["tcp/127.0.0.1:{port}"]"#)),
            ("scouting/multicast/enabled", "false".to_owned()),
        ] {
            config.insert_json5(key, &value).unwrap();
        }
        Self { session: zenoh::open(config).wait().unwrap(), domain, sequence: Cell::new(0) }
    }

    /// Calls a service such as `/eddy_node/reset`, waiting until it exists. Checks that the response identifies the
    /// request.
    pub fn ask<A: Serialize, B: DeserializeOwned>(
        &self,
        name: &str,
        type_name: &str,
        request: &A,
    ) -> B {
        let payload = crate::support::wait_for(&format!("{name} answers"), || {
            self.request(name, type_name, cdr::encode(request))
        });
        cdr::decode(&payload.unwrap()).unwrap()
    }

    /// One request: the response, or the error of the service; `None` without a service.
    pub fn request(
        &self,
        name: &str,
        type_name: &str,
        request: Vec<u8>,
    ) -> Option<Result<Vec<u8>, String>> {
        let (package, kind) = type_name.split_once("/srv/").unwrap();
        let hash = service_hash(type_name).unwrap();
        let key = format!("{}{name}/{package}::srv::dds_::{kind}_/{hash}", self.domain);
        let sequence = self.sequence.get() + 1;
        self.sequence.set(sequence);
        let asked = [&sequence.to_le_bytes()[..], &7i64.to_le_bytes(), &[16], &GID].concat();
        let replies = self
            .session
            .get(&key)
            .target(QueryTarget::AllComplete)
            .consolidation(ConsolidationMode::None)
            .timeout(PATIENCE)
            .payload(request)
            .attachment(&asked)
            .wait()
            .unwrap();
        let reply = replies.recv().ok()?;
        Some(match reply.into_result() {
            Err(error) => Err(error.payload().try_to_string().unwrap().into_owned()),
            Ok(sample) => {
                assert_eq!(sample.key_expr().as_str(), key);
                let answered = sample.attachment().unwrap().to_bytes().into_owned();
                assert_eq!(answered.len(), 33);
                assert_eq!((&answered[..8], &answered[16..]), (&asked[..8], &asked[16..]));
                let time = i64::from_le_bytes(answered[8..16].try_into().unwrap());
                assert!(time > 1_700_000_000_000_000_000, "{time}");
                Ok(sample.payload().to_bytes().into_owned())
            }
        })
    }

    /// The liveliness tokens of services.
    pub fn services(&self) -> Vec<String> {
        let tokens = format!("@ros2_lv/{}/*/*/*/SS/**", self.domain);
        let replies = self.session.liveliness().get(tokens).wait().unwrap();
        let mut tokens: Vec<_> =
            replies.iter().map(|reply| reply.result().unwrap().key_expr().to_string()).collect();
        tokens.sort();
        tokens
    }
}
