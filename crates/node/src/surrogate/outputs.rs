//! The topics that a node publishes on.

use eddy_transport::Publisher;

use super::{CloudTopic, Observer};

/// The topics of one output link of a node.
pub struct Outputs {
    /// Predicted frames; `None` for an output that carries point clouds only.
    pub prediction: Option<Box<dyn Publisher>>,
    /// Status of each prediction.
    pub status: Box<dyn Publisher>,
    /// Diagnostics of the node, once a second; on one output per transport.
    pub diagnostics: Option<Box<dyn Publisher>>,
    /// Changed parameters; on one output per transport.
    pub parameter_events: Option<Box<dyn Publisher>>,
    /// Transitions of a managed node; on one output per transport.
    pub transition_events: Option<Box<dyn Publisher>>,
    /// Predicted frames as point clouds.
    pub prediction_cloud: Option<CloudTopic>,
    /// Observed frames as point clouds; on one output per transport.
    pub input_cloud: Option<CloudTopic>,
    /// Observers within this process; on one output.
    pub observers: Vec<Box<dyn Observer>>,
}

impl Outputs {
    /// Predictions and their status only.
    pub fn new(prediction: Box<dyn Publisher>, status: Box<dyn Publisher>) -> Self {
        Self { prediction: Some(prediction), ..Self::status_only(status) }
    }

    /// The status of predictions only.
    pub fn status_only(status: Box<dyn Publisher>) -> Self {
        Self {
            prediction: None,
            status,
            diagnostics: None,
            parameter_events: None,
            transition_events: None,
            prediction_cloud: None,
            input_cloud: None,
            observers: Vec::new(),
        }
    }
}
