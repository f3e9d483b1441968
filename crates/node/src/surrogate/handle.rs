//! Requests to a running node, independent of middleware: services and the live page send them from their own threads,
//! and the [driver](super::drive) answers between two frames.

use std::time::Duration;

use super::{InvalidSettings, LifecycleState, NodeSettings, SurrogateNode};
use crate::requests::RequestChannel;
use eddy_messages::{lifecycle::Transition, services::Parameter};

/// A request to a running node.
#[derive(Clone, Debug, PartialEq)]
pub enum NodeRequest {
    /// Get the settings.
    Settings,
    /// Set these parameters, all or none.
    Set(Vec<Parameter>),
    /// Reset all streams.
    Reset,
    /// Get the state of a managed node.
    State,
    /// Change it.
    ChangeState(Transition),
}

/// The response to the request of the same name.
#[derive(Clone, Debug, PartialEq)]
pub enum NodeResponse {
    /// The current settings.
    Settings(NodeSettings),
    /// The parameters are set.
    Set,
    /// Number of streams that were reset.
    Reset(usize),
    /// The current state; `None` if the node is not managed.
    State(Option<LifecycleState>),
    /// Whether there is such a transition from the current state.
    ChangeState(bool),
}

/// Why a request failed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[expect(missing_docs, reason = "the message says what the fields are")]
pub enum RequestError {
    /// A parameter cannot be set.
    #[error(transparent)]
    Rejected(#[from] InvalidSettings),
    /// The node is busy or has ended.
    #[error("the node did not answer within {} s", timeout.as_secs_f64())]
    Timeout { timeout: Duration },
}

/// Sends requests to a running node.
#[derive(Debug, Default)]
pub struct NodeHandle {
    requests: RequestChannel<NodeRequest, Result<NodeResponse, InvalidSettings>>,
}

impl NodeHandle {
    /// Sends a request and waits up to `timeout` for the node to accept it.
    ///
    /// # Errors
    /// [`RequestError`].
    pub fn request(
        &self,
        request: NodeRequest,
        timeout: Duration,
    ) -> Result<NodeResponse, RequestError> {
        let response = self.requests.call(request, timeout);
        Ok(response.ok_or(RequestError::Timeout { timeout })??)
    }

    /// Rejects all requests, now and later.
    pub fn close(&self) {
        self.requests.close();
    }

    /// Answers all waiting requests; parameters are set if `apply`, called with the new settings, succeeds. Returns the
    /// parameters that were set.
    pub fn serve(
        &self,
        node: &mut SurrogateNode,
        mut apply: impl FnMut(&mut SurrogateNode, &NodeSettings) -> Result<(), InvalidSettings>,
    ) -> Vec<Parameter> {
        let mut changed = Vec::new();
        while let Some(pending) = self.requests.next() {
            let Some((request, responder)) = pending.accept() else { continue };
            let response = match request {
                NodeRequest::Settings => Ok(NodeResponse::Settings(node.settings().clone())),
                NodeRequest::Set(parameters) => {
                    let outcome = node.set_and(&parameters, &mut apply);
                    if outcome.is_ok() {
                        changed.extend(parameters);
                    }
                    outcome.map(|()| NodeResponse::Set)
                }
                NodeRequest::Reset => Ok(NodeResponse::Reset(node.reset())),
                NodeRequest::State => Ok(NodeResponse::State(node.lifecycle())),
                NodeRequest::ChangeState(wanted) => {
                    Ok(NodeResponse::ChangeState(node.change_state(&wanted)))
                }
            };
            responder.send(response);
        }
        changed
    }
}
