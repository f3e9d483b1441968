//! States and transitions of managed nodes (`lifecycle_msgs`, <https://design.ros2.org/articles/node_lifecycle.html>).

use serde::{Deserialize, Serialize};

use super::Message;

/// `lifecycle_msgs/msg/State`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct State {
    /// Number of the state.
    pub id: u8,
    /// Its name.
    pub label: String,
}

/// `lifecycle_msgs/msg/Transition`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Transition {
    /// Number of the transition.
    pub id: u8,
    /// Its name; in a request it precedes the number unless it is empty.
    pub label: String,
}

/// `lifecycle_msgs/msg/TransitionDescription`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct TransitionDescription {
    /// The transition.
    pub transition: Transition,
    /// State before it.
    pub start_state: State,
    /// State after it.
    pub goal_state: State,
}

/// `lifecycle_msgs/msg/TransitionEvent`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct TransitionEvent {
    /// Wall-clock time (ns since the epoch).
    pub timestamp: u64,
    /// The transition.
    pub transition: Transition,
    /// State before it.
    pub start_state: State,
    /// State after it.
    pub goal_state: State,
}

impl Message for TransitionEvent {
    const TYPE: &'static str = "lifecycle_msgs/msg/TransitionEvent";
}

/// Request of `lifecycle_msgs/srv/ChangeState`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ChangeStateRequest {
    /// The transition to make.
    pub transition: Transition,
}

/// Response of `lifecycle_msgs/srv/GetState`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct GetStateResponse {
    /// The current state.
    pub current_state: State,
}

/// Response of `lifecycle_msgs/srv/GetAvailableStates`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct GetAvailableStatesResponse {
    /// All states.
    pub available_states: Vec<State>,
}

/// Response of `lifecycle_msgs/srv/GetAvailableTransitions`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct GetAvailableTransitionsResponse {
    /// The transitions from the current state, or all of them.
    pub available_transitions: Vec<TransitionDescription>,
}
