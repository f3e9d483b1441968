//! What may be asked of a running node, whoever brings the question.
//!
//! The node knows no middleware: services put requests into this queue, on threads of their own, and wait;
//! the [driver](super::drive) answers between two frames.

use std::time::Duration;

use super::{InvalidSettings, NodeSettings, SurrogateNode, requests::Requests};
use eddy_messages::services::Parameter;

/// A request to a running node.
#[derive(Clone, Debug, PartialEq)]
pub enum Request {
    /// How it behaves.
    Settings,
    /// Set these parameters, all or none.
    Set(Vec<Parameter>),
    /// Forget every stream.
    Reset,
}

/// What the node says.
#[derive(Clone, Debug, PartialEq)]
pub enum Answer {
    /// How it behaves now.
    Settings(NodeSettings),
    /// The parameters are set.
    Set,
    /// Streams that were forgotten.
    Forgot(usize),
}

/// Why a request was not fulfilled.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Unanswered {
    /// A parameter cannot be set so.
    #[error(transparent)]
    Refused(#[from] InvalidSettings),
    /// The node is busy or has ended.
    #[error("node: found no answer within {} s, expected one", patience.as_secs_f64())]
    Silent {
        /// How long was waited.
        patience: Duration,
    },
}

/// The way to a running node.
#[derive(Debug, Default)]
pub struct Control {
    requests: Requests<Request, Result<Answer, InvalidSettings>>,
}

impl Control {
    /// Asks the node, and waits `patience` at most.
    ///
    /// # Errors
    /// [`Unanswered`] with the node's reason, or when none came.
    pub fn ask(&self, request: Request, patience: Duration) -> Result<Answer, Unanswered> {
        let answer = self.requests.ask(request, patience);
        Ok(answer.ok_or(Unanswered::Silent { patience })??)
    }

    /// No more requests: who has one that is not answered is told so.
    pub fn close(&self) {
        self.requests.close();
    }

    /// Answers everything that was asked by now; parameters are set when `follow` can follow them. Returns those
    /// that were set.
    pub fn serve(
        &self,
        node: &mut SurrogateNode,
        mut follow: impl FnMut(&mut SurrogateNode, &NodeSettings) -> Result<(), InvalidSettings>,
    ) -> Vec<Parameter> {
        let mut changed = Vec::new();
        while let Some(pending) = self.requests.next() {
            let Some((request, reply)) = pending.begin() else { continue };
            let answer = match request {
                Request::Settings => Ok(Answer::Settings(node.settings().clone())),
                Request::Set(parameters) => {
                    let outcome = node.set_and(&parameters, &mut follow);
                    if outcome.is_ok() {
                        changed.extend(parameters);
                    }
                    outcome.map(|()| Answer::Set)
                }
                Request::Reset => Ok(Answer::Forgot(node.reset())),
            };
            reply.send(answer);
        }
        changed
    }
}
