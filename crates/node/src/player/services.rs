//! The services of rosbag2's player, in the form of `rosbag2_interfaces`
//! (`rosbag2_transport/src/rosbag2_transport/player.cpp`, `create_control_services`).

use std::{sync::Arc, time::Duration};

use serde::{Serialize, de::DeserializeOwned};

use super::{CommandOutcome, PendingCommand, PlayerCommand, PlayerHandle};
use crate::{
    ros::RosNode,
    service::{Service, describe_types, handler},
};
use eddy_messages::{
    playback::{Paused, PlayingRate, SeekRequest, Success},
    services::Empty,
};
use eddy_transport::{Handler, Link, Served, TransportError, TransportKind, Transports};

/// Time for the player to accept a command.
const TIMEOUT: Duration = Duration::from_secs(5);

/// The services of the player with the full name `node`, such as `/eddy_replay`.
pub fn player_services(node: &str, player: &Arc<PlayerHandle>) -> Vec<Service> {
    let service = |name, type_name, handler| Service::of(node, name, type_name, handler);
    vec![
        service("pause", "rosbag2_interfaces/srv/Pause", answer(player, pause)),
        service("resume", "rosbag2_interfaces/srv/Resume", answer(player, resume)),
        service("toggle_paused", "rosbag2_interfaces/srv/TogglePaused", answer(player, toggle)),
        service("is_paused", "rosbag2_interfaces/srv/IsPaused", answer(player, is_paused)),
        service("set_rate", "rosbag2_interfaces/srv/SetRate", answer(player, set_rate)),
        service("get_rate", "rosbag2_interfaces/srv/GetRate", answer(player, get_rate)),
        service("play_next", "rosbag2_interfaces/srv/PlayNext", answer(player, play_next)),
        service("seek", "rosbag2_interfaces/srv/Seek", answer(player, seek)),
        describe_types(node),
    ]
}

/// The services while they are offered.
pub struct PlayerServices {
    player: Arc<PlayerHandle>,
    _served: Vec<Box<dyn Served>>,
}

impl PlayerServices {
    /// Offers the services on a transport under their names after remapping. `None` on a transport without services.
    ///
    /// # Errors
    /// [`TransportError`].
    pub fn offer(
        transports: &Transports,
        transport: TransportKind,
        ros: &RosNode,
    ) -> Result<Option<Self>, TransportError> {
        let player = Arc::new(PlayerHandle::default());
        let mut served = Vec::new();
        for Service { name, type_name, handler } in player_services(&ros.full_name(), &player) {
            let link = Link { transport, topic: ros.service(&name) };
            served.extend(transports.serve(&link, type_name, handler)?);
        }
        Ok((!served.is_empty()).then_some(Self { player, _served: served }))
    }

    /// The commands since the last call.
    pub fn commands(&self) -> impl Iterator<Item = PendingCommand> {
        std::iter::from_fn(|| self.player.next())
    }
}

impl Drop for PlayerServices {
    fn drop(&mut self) {
        // Before the services, which wait for pending responses when dropped.
        self.player.close();
    }
}

fn answer<A: DeserializeOwned + 'static, B: Serialize + 'static>(
    player: &Arc<PlayerHandle>,
    function: fn(&PlayerHandle, A) -> Option<B>,
) -> Handler {
    handler(player, function)
}

fn call(player: &PlayerHandle, command: PlayerCommand) -> Option<CommandOutcome> {
    player.call(command, TIMEOUT)
}

fn pause(player: &PlayerHandle, request: Empty) -> Option<Empty> {
    call(player, PlayerCommand::Pause).map(|_| request)
}

fn resume(player: &PlayerHandle, request: Empty) -> Option<Empty> {
    call(player, PlayerCommand::Resume).map(|_| request)
}

fn toggle(player: &PlayerHandle, request: Empty) -> Option<Empty> {
    call(player, PlayerCommand::TogglePause).map(|_| request)
}

fn is_paused(player: &PlayerHandle, _: Empty) -> Option<Paused> {
    call(player, PlayerCommand::Status).map(|now| Paused { paused: now.paused })
}

fn get_rate(player: &PlayerHandle, _: Empty) -> Option<PlayingRate> {
    call(player, PlayerCommand::Status).map(|now| PlayingRate { rate: now.rate })
}

fn set_rate(player: &PlayerHandle, request: PlayingRate) -> Option<Success> {
    call(player, PlayerCommand::Rate(request.rate)).map(|now| Success { success: now.done })
}

/// As in rosbag2, only a paused player steps.
fn play_next(player: &PlayerHandle, _: Empty) -> Option<Success> {
    if !call(player, PlayerCommand::Status)?.paused {
        return Some(Success { success: false });
    }
    call(player, PlayerCommand::Next).map(|now| Success { success: now.done })
}

/// Times before the first message lead to it; times after the last are rejected.
fn seek(player: &PlayerHandle, request: SeekRequest) -> Option<Success> {
    call(player, PlayerCommand::Seek(request.time.into())).map(|now| Success { success: now.done })
}
