//! A ROS service as CDR in and CDR out; a transport carries the bytes.

use std::sync::Arc;

use serde::{Serialize, de::DeserializeOwned};

use eddy_messages::{
    cdr,
    type_descriptions::{
        GET_TYPE_DESCRIPTION, SERVICE_NAME, TypeDescriptionRequest, TypeDescriptionResponse,
    },
};
use eddy_transport::Handler;

/// A service of a node.
pub struct Service {
    /// Absolute name, such as `/eddy_node/reset`.
    pub name: String,
    /// Type, such as `std_srvs/srv/Trigger`.
    pub type_name: &'static str,
    /// Request to response.
    pub handler: Handler,
}

impl Service {
    /// The service `name` of the node with the full name `node`.
    pub(crate) fn of(node: &str, name: &str, type_name: &'static str, handler: Handler) -> Self {
        Self { name: format!("{node}/{name}"), type_name, handler }
    }
}

/// The service with which a node tells the definitions of its types: `rosbag2` and `eddy record` ask for them.
pub(crate) fn describe_types(node: &str) -> Service {
    let describe =
        |(): &(), request: TypeDescriptionRequest| Some(TypeDescriptionResponse::to(&request));
    Service::of(node, SERVICE_NAME, GET_TYPE_DESCRIPTION, handler(&Arc::new(()), describe))
}

/// Decodes the request, calls `function`, encodes the response. Bytes that cannot be decoded get no response.
pub(crate) fn handler<C: Send + Sync + 'static, A: DeserializeOwned, B: Serialize>(
    context: &Arc<C>,
    function: impl Fn(&C, A) -> Option<B> + Send + 'static,
) -> Handler {
    let context = Arc::clone(context);
    Box::new(move |request| match cdr::decode(request) {
        Ok(request) => function(&context, request).map(|response| cdr::encode(&response)),
        Err(error) => {
            tracing::warn!("service request: {error}");
            None
        }
    })
}
