//! States and transitions of a managed node (<https://design.ros2.org/articles/node_lifecycle.html>), with the numbers and
//! labels of `rcl_lifecycle/src/default_state_machine.c`. The transitions of this node always succeed.

use eddy_messages::lifecycle::{State, Transition, TransitionDescription};

/// State of a managed node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum LifecycleState {
    /// No state of a node.
    Unknown = 0,
    /// After the start, and after `cleanup`.
    Unconfigured = 1,
    /// Configured; frames are ignored.
    Inactive = 2,
    /// Frames are observed, predictions are published.
    Active = 3,
    /// Shut down; only the end of the process follows.
    Finalized = 4,
    /// On the way to `Inactive`.
    Configuring = 10,
    /// On the way to `Unconfigured`.
    CleaningUp = 11,
    /// On the way to `Finalized`.
    ShuttingDown = 12,
    /// On the way to `Active`.
    Activating = 13,
    /// On the way to `Inactive`.
    Deactivating = 14,
    /// After a failure, which this node does not have.
    ErrorProcessing = 15,
}

use LifecycleState::{
    Activating, Active, CleaningUp, Configuring, Deactivating, ErrorProcessing, Finalized,
    Inactive, ShuttingDown, Unconfigured, Unknown,
};

impl LifecycleState {
    /// All states of ROS 2.
    pub const ALL: [Self; 11] = [
        Unknown,
        Unconfigured,
        Inactive,
        Active,
        Finalized,
        Configuring,
        CleaningUp,
        ShuttingDown,
        Activating,
        Deactivating,
        ErrorProcessing,
    ];

    /// Its name in ROS 2.
    pub fn label(self) -> &'static str {
        match self {
            Unknown => "unknown",
            Unconfigured => "unconfigured",
            Inactive => "inactive",
            Active => "active",
            Finalized => "finalized",
            Configuring => "configuring",
            CleaningUp => "cleaningup",
            ShuttingDown => "shuttingdown",
            Activating => "activating",
            Deactivating => "deactivating",
            ErrorProcessing => "errorprocessing",
        }
    }

    /// The state after `wanted`, with the two transitions that lead to it. `None` if `wanted` does not start here.
    pub fn after(self, wanted: &Transition) -> Option<[LifecycleTransition; 2]> {
        let is_wanted = |transition: &&LifecycleTransition| match wanted.label.as_str() {
            "" => transition.id == wanted.id,
            label => transition.label == label,
        };
        let first = self.transitions().find(is_wanted)?;
        let second = first.goal.transitions().next()?;
        Some([*first, *second])
    }

    /// The transitions that start here.
    pub fn transitions(self) -> impl Iterator<Item = &'static LifecycleTransition> {
        TRANSITIONS.iter().filter(move |transition| transition.start == self)
    }
}

impl From<LifecycleState> for State {
    fn from(state: LifecycleState) -> Self {
        Self { id: state as u8, label: state.label().to_owned() }
    }
}

/// A transition of a managed node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LifecycleTransition {
    /// Its number in ROS 2.
    pub id: u8,
    /// Its name in ROS 2.
    pub label: &'static str,
    /// State before it.
    pub start: LifecycleState,
    /// State after it.
    pub goal: LifecycleState,
}

const fn of(
    id: u8,
    label: &'static str,
    start: LifecycleState,
    goal: LifecycleState,
) -> LifecycleTransition {
    LifecycleTransition { id, label, start, goal }
}

const SUCCESS: &str = "transition_success";

/// All transitions that a node of eddy makes.
pub const TRANSITIONS: [LifecycleTransition; 12] = [
    of(1, "configure", Unconfigured, Configuring),
    of(10, SUCCESS, Configuring, Inactive),
    of(2, "cleanup", Inactive, CleaningUp),
    of(20, SUCCESS, CleaningUp, Unconfigured),
    of(3, "activate", Inactive, Activating),
    of(30, SUCCESS, Activating, Active),
    of(4, "deactivate", Active, Deactivating),
    of(40, SUCCESS, Deactivating, Inactive),
    of(5, "shutdown", Unconfigured, ShuttingDown),
    of(6, "shutdown", Inactive, ShuttingDown),
    of(7, "shutdown", Active, ShuttingDown),
    of(50, SUCCESS, ShuttingDown, Finalized),
];

impl From<&LifecycleTransition> for TransitionDescription {
    fn from(transition: &LifecycleTransition) -> Self {
        let LifecycleTransition { id, label, start, goal } = *transition;
        Self {
            transition: Transition { id, label: label.to_owned() },
            start_state: start.into(),
            goal_state: goal.into(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn after(state: LifecycleState, id: u8, label: &str) -> Option<LifecycleState> {
        let wanted = Transition { id, label: label.to_owned() };
        let [first, second] = state.after(&wanted)?;
        assert_eq!((first.start, first.goal, second.label), (state, second.start, SUCCESS));
        Some(second.goal)
    }

    #[test]
    fn a_node_goes_through_its_life() {
        let mut state = Unconfigured;
        for (id, goal) in [
            (1, Inactive),
            (3, Active),
            (4, Inactive),
            (2, Unconfigured),
            (1, Inactive),
            (3, Active),
            (7, Finalized),
        ] {
            state = after(state, id, "").unwrap();
            assert_eq!(state, goal);
        }
        assert_eq!(state.transitions().count(), 0);
    }

    #[test]
    fn transitions_from_another_state_are_rejected() {
        for (state, id) in [(Unconfigured, 3), (Inactive, 1), (Active, 2), (Unconfigured, 6)] {
            assert_eq!(after(state, id, ""), None, "{state:?} {id}");
        }
        // Transitions of the node itself are not for others to make.
        assert_eq!(after(Inactive, 30, ""), None);
    }

    #[test]
    fn a_label_precedes_the_number() {
        assert_eq!(after(Active, 5, "shutdown"), Some(Finalized));
        assert_eq!(after(Active, 0, "deactivate"), Some(Inactive));
        assert_eq!(after(Active, 4, "activate"), None);
    }
}
