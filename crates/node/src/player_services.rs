//! The services of rosbag2's player, as CDR in and CDR out, in the form of `rosbag2_interfaces`
//! (`rosbag2_transport/src/rosbag2_transport/player.cpp`, `create_control_services`).

use std::{sync::Arc, time::Duration};

use serde::{Serialize, de::DeserializeOwned};

use super::{
    Remote, Service,
    services::handler,
    wish::{Outcome, Wish},
};
use eddy_messages::{
    playback::{Paused, PlayingRate, SeekRequest, Success},
    services::Empty,
};
use eddy_transport::Handler;

/// How long a player may take to begin with an answer.
const PATIENCE: Duration = Duration::from_secs(5);

/// The services of the player with the full name `node`, such as `/eddy_replay`, which is asked through `remote`.
pub fn player_services(node: &str, remote: &Arc<Remote>) -> Vec<Service> {
    let service = |name, type_name, handler| Service::of(node, name, type_name, handler);
    vec![
        service("pause", "rosbag2_interfaces/srv/Pause", answer(remote, pause)),
        service("resume", "rosbag2_interfaces/srv/Resume", answer(remote, resume)),
        service("toggle_paused", "rosbag2_interfaces/srv/TogglePaused", answer(remote, toggle)),
        service("is_paused", "rosbag2_interfaces/srv/IsPaused", answer(remote, is_paused)),
        service("set_rate", "rosbag2_interfaces/srv/SetRate", answer(remote, set_rate)),
        service("get_rate", "rosbag2_interfaces/srv/GetRate", answer(remote, get_rate)),
        service("play_next", "rosbag2_interfaces/srv/PlayNext", answer(remote, play_next)),
        service("seek", "rosbag2_interfaces/srv/Seek", answer(remote, seek)),
    ]
}

fn answer<A: DeserializeOwned + 'static, B: Serialize + 'static>(
    remote: &Arc<Remote>,
    function: fn(&Remote, A) -> Option<B>,
) -> Handler {
    handler(remote, function)
}

fn ask(remote: &Remote, wish: Wish) -> Option<Outcome> {
    remote.ask(wish, PATIENCE)
}

fn pause(remote: &Remote, request: Empty) -> Option<Empty> {
    ask(remote, Wish::Pause).map(|_| request)
}

fn resume(remote: &Remote, request: Empty) -> Option<Empty> {
    ask(remote, Wish::Resume).map(|_| request)
}

fn toggle(remote: &Remote, request: Empty) -> Option<Empty> {
    ask(remote, Wish::TogglePause).map(|_| request)
}

fn is_paused(remote: &Remote, _: Empty) -> Option<Paused> {
    ask(remote, Wish::Look).map(|now| Paused { paused: now.paused })
}

fn get_rate(remote: &Remote, _: Empty) -> Option<PlayingRate> {
    ask(remote, Wish::Look).map(|now| PlayingRate { rate: now.rate })
}

fn set_rate(remote: &Remote, request: PlayingRate) -> Option<Success> {
    ask(remote, Wish::Rate(request.rate)).map(|now| Success { success: now.done })
}

/// Only a player that pauses can be asked for its next message.
fn play_next(remote: &Remote, _: Empty) -> Option<Success> {
    if !ask(remote, Wish::Look)?.paused {
        return Some(Success { success: false });
    }
    ask(remote, Wish::Next).map(|now| Success { success: now.done })
}

/// Times before the first message lead to it; none follows those after the last, and they are refused.
fn seek(remote: &Remote, request: SeekRequest) -> Option<Success> {
    ask(remote, Wish::Seek(request.time.into())).map(|now| Success { success: now.done })
}
