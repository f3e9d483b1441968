//! Requests and responses as YAML.

use std::{fs, path::PathBuf, time::Duration};

use super::ClientError;
use crate::ros::yaml;
use eddy_messages::{
    TypeSupport, UnknownService,
    dynamic::{self, Value},
    service_messages, type_support,
};
use eddy_transport::{SeenService, Transports};

/// Definitions of services: the built-in ones, and those in installations of ROS 2.
#[derive(Debug, Default)]
pub struct Definitions {
    prefixes: Vec<PathBuf>,
}

impl Definitions {
    /// `prefixes`: installations of ROS 2, as in `AMENT_PREFIX_PATH`.
    pub fn new(prefixes: Vec<PathBuf>) -> Self {
        Self { prefixes }
    }

    /// Request and response of a service type.
    ///
    /// # Errors
    /// [`ClientError::Unknown`] without a definition, [`ClientError::Definition`] when it cannot be used.
    fn of(&self, type_name: &str) -> Result<[TypeSupport; 2], ClientError> {
        let built_in = ["Request", "Response"]
            .map(|part| type_support(&format!("{type_name}_{part}")).cloned());
        if let [Ok(request), Ok(response)] = built_in {
            return Ok([request, response]);
        }
        match self.installed(type_name, "srv") {
            Some(text) => {
                let text_of = |of: &str| self.installed(of, "msg");
                Ok(service_messages(type_name, &text, &text_of)?)
            }
            None => Err(UnknownService { found: type_name.to_owned() }.into()),
        }
    }

    /// The text in `share/<package>/<msg|srv>/<name>.<extension>`.
    fn installed(&self, name: &str, extension: &str) -> Option<String> {
        let file = format!("share/{name}.{extension}");
        self.prefixes.iter().find_map(|prefix| fs::read_to_string(prefix.join(&file)).ok())
    }
}

/// A service of another node.
pub struct ServiceClient<'a> {
    transports: &'a Transports,
    service: SeenService,
    messages: [TypeSupport; 2],
}

impl<'a> ServiceClient<'a> {
    /// A service that was found, of type `expected` if that is given.
    ///
    /// # Errors
    /// [`ClientError`] when it has another type, or one without a definition.
    pub fn new(
        transports: &'a Transports,
        service: SeenService,
        expected: Option<&str>,
        definitions: &Definitions,
    ) -> Result<Self, ClientError> {
        if let Some(expected) = expected.filter(|expected| *expected != service.type_name) {
            let (link, found) = (service.link, service.type_name);
            return Err(ClientError::Type { link, found, expected: expected.to_owned() });
        }
        let messages = definitions.of(&service.type_name)?;
        Ok(Self { transports, service, messages })
    }

    /// Sends a request in YAML; missing fields are 0, false or empty. Returns the response.
    ///
    /// # Errors
    /// [`ClientError`].
    pub fn call(&self, request: &str, timeout: Duration) -> Result<Value, ClientError> {
        let [request_type, response_type] = &self.messages;
        let parsed = yaml::read(request).ok().and_then(yaml::Yaml::into_dynamic);
        let value = parsed.ok_or_else(|| ClientError::Yaml { found: request.to_owned() })?;
        let request = dynamic::encode(request_type, &value)?;
        let response = self.transports.call(&self.service, &request, timeout)?;
        let link = || self.service.link.clone();
        let response = response.ok_or_else(|| ClientError::NoResponse { link: link(), timeout })?;
        Ok(dynamic::decode(response_type, &response)?)
    }
}
