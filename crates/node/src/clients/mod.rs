//! Services of other nodes as a command line uses them.
//!
//! 1. [`find`]: wait until a service is offered.
//! 2. [`ServiceClient`]: requests and responses as YAML, of any service whose definition is known.
//! 3. [`ParameterClient`]: the parameters of a node.

mod find;
mod parameters;
mod service;

pub use find::find_service;
pub use parameters::{ParameterClient, nodes_with_parameters, parse_value, value_text};
pub use service::{Definitions, ServiceClient};

use std::time::Duration;

use eddy_messages::{InvalidDefinition, UnknownService, dynamic::InvalidValue};
use eddy_transport::{Link, TransportError};

/// Why a request failed.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the message says what the fields are")]
pub enum ClientError {
    /// The transport fails.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// Nobody offers the service.
    #[error("{link}: no such service within {} s; available on {}: {available}", timeout.as_secs_f64(), link.transport)]
    NotFound { link: Link, timeout: Duration, available: String },
    /// The service has another type.
    #[error("{link}: found type {found}, expected {expected}")]
    Type { link: Link, found: String, expected: String },
    /// The service does not answer.
    #[error("{link}: no response within {} s", timeout.as_secs_f64())]
    NoResponse { link: Link, timeout: Duration },
    /// The definition of the service is not known.
    #[error("{0}; AMENT_PREFIX_PATH may name an installation with this type")]
    Unknown(#[from] UnknownService),
    /// The definition of the service cannot be used.
    #[error(transparent)]
    Definition(#[from] InvalidDefinition),
    /// Request or response does not suit the definition.
    #[error(transparent)]
    Value(#[from] InvalidValue),
    /// The request is not YAML.
    #[error("request: found `{found}`, expected a map of fields in YAML, such as `{{data: true}}`")]
    Yaml { found: String },
    /// The response is not of the type of the service.
    #[error("{link}: the response is not of type {type_name}: {reason}")]
    Response { link: Link, type_name: String, reason: String },
}
