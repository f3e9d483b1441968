//! What may be asked of a running node, whoever brings the question.
//!
//! The node knows no middleware: services put requests into this queue, on threads of their own, and wait;
//! the [driver](super::drive) answers between two frames.

use std::{
    sync::mpsc::{RecvTimeoutError, SyncSender, sync_channel},
    time::Duration,
};

use super::{InvalidSettings, NodeSettings, SurrogateNode};
use crate::{msg::services::Parameter, transport::Queue};

/// Requests that may wait.
const DEPTH: usize = 16;

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

type Asked = (Request, SyncSender<Result<Answer, Unanswered>>);

/// The way to a running node.
#[derive(Debug)]
pub struct Control {
    requests: Queue<Asked>,
}

impl Default for Control {
    fn default() -> Self {
        Self { requests: Queue::new(DEPTH) }
    }
}

impl Control {
    /// Asks the node, and waits `patience` at most.
    ///
    /// # Errors
    /// [`Unanswered`] with the node's reason, or when none came.
    pub fn ask(&self, request: Request, patience: Duration) -> Result<Answer, Unanswered> {
        let (sender, receiver) = sync_channel(1);
        let silent = Unanswered::Silent { patience };
        self.requests
            .push_or_wait((request, sender), Duration::ZERO)
            .map_err(|_| silent.clone())?;
        match receiver.recv_timeout(patience) {
            Ok(answer) => answer,
            Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => Err(silent),
        }
    }

    /// No more questions: who has one that is not answered is told so.
    pub fn close(&self) {
        self.requests.close();
    }

    /// Answers everything that was asked by now. Returns the parameters that were set.
    pub fn serve(&self, node: &mut SurrogateNode) -> Vec<Parameter> {
        let mut changed = Vec::new();
        while let Some((request, asker)) = self.requests.pop(Duration::ZERO) {
            let answer = match request {
                Request::Settings => Ok(Answer::Settings(node.settings().clone())),
                Request::Set(parameters) => {
                    let outcome = node.set(&parameters);
                    if outcome.is_ok() {
                        changed.extend(parameters);
                    }
                    outcome.map(|()| Answer::Set).map_err(Unanswered::from)
                }
                Request::Reset => Ok(Answer::Forgot(node.reset())),
            };
            // Nobody to tell it to: the asker's patience has ended.
            let _ = asker.send(answer);
        }
        changed
    }
}
