//! Tools of a live source that move as messages say.

use std::{path::Path, thread, time::Duration};

use anyhow::{Context as _, bail};

use crate::commands::POLL_INTERVAL;
use eddy_cli::Interrupt;
use eddy_frames::{clock::Clock, tool};
use eddy_mpm::{Keyframe, Simulation, Tool};
use eddy_node::{
    ros::RosNode,
    tools::{ToolFollower, ToolInputs, ToolsFile},
};
use eddy_settings as config;
use eddy_transport::{Link, Transports};

/// Longest wait for the first poses.
const MAX_POSE_WAIT: Duration = Duration::from_secs(30);

/// Tools, and the messages that say where they are.
pub(super) struct LiveTools {
    follower: ToolFollower,
    inputs: ToolInputs,
    clock: Clock,
    /// A tool has no pose, which was said.
    is_lost: bool,
}

impl LiveTools {
    /// Subscribes to the poses of the tools of a file, on the transport of a link.
    pub(super) fn open(
        file: &Path,
        transports: &Transports,
        beside: &Link,
        ros: &RosNode,
    ) -> anyhow::Result<Self> {
        let content = config::load::<ToolsFile>(file)?.renamed(ros);
        let named = || file.display().to_string();
        let follower = ToolFollower::new(&content, Duration::ZERO).with_context(named)?;
        let inputs = ToolInputs::poses(transports, beside, &follower, ros)?;
        Ok(Self { follower, inputs, clock: Clock::start(), is_lost: false })
    }

    /// Waits until all tools have poses, and returns them there; `None` if interrupted.
    pub(super) fn begin(&mut self, interrupt: &Interrupt) -> anyhow::Result<Option<Vec<Tool>>> {
        let began = self.clock.now();
        while !interrupt.requested() {
            self.receive()?;
            let poses = match self.follower.newest() {
                Ok(poses) => poses,
                Err(none) if self.clock.now() - began > MAX_POSE_WAIT => {
                    bail!("{none}, after 30 s")
                }
                Err(none) => {
                    self.say(&none);
                    thread::sleep(POLL_INTERVAL);
                    continue;
                }
            };
            self.is_lost = false;
            let tool = |(tool, pose): (tool::Tool, tool::Pose)| {
                let tool::Tool { name, shape, contact } = tool;
                let angle_degrees = pose.angle.to_degrees();
                let start = Keyframe { time: 0.0, position: pose.position, angle_degrees };
                Tool { name, shape, contact, keyframes: vec![start] }
            };
            let tools = self.follower.tools(0).tools;
            return Ok(Some(tools.into_iter().zip(poses).map(tool).collect()));
        }
        Ok(None)
    }

    /// Moves the tools of a simulation to their newest poses until its next frame; they rest while one of them has none.
    pub(super) fn steer(&mut self, simulation: &mut Simulation) -> anyhow::Result<()> {
        self.receive()?;
        match self.follower.newest() {
            Ok(poses) => {
                self.is_lost = false;
                // Messages have angles of at most half a turn; a tool turns the shorter way.
                let from = simulation.poses();
                let poses = poses.into_iter().zip(from).map(|(to, from)| to.nearest_to(from));
                Ok(simulation.move_tools(&poses.collect::<Vec<_>>())?)
            }
            Err(none) => {
                self.say(&none);
                Ok(simulation.move_tools(&simulation.poses())?)
            }
        }
    }

    /// Takes in what has arrived.
    fn receive(&mut self) -> anyhow::Result<()> {
        self.inputs.drain(&mut self.follower, self.clock.now())?;
        for warning in self.follower.warnings() {
            tracing::warn!("{warning}");
        }
        Ok(())
    }

    /// Says once that a tool has no pose, until all have.
    fn say(&mut self, none: &dyn std::fmt::Display) {
        if !self.is_lost {
            tracing::warn!("{none}");
        }
        self.is_lost = true;
    }
}
