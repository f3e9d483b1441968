//! `eddy tools`: poses of a robot's tools beside frames of particles.

use std::time::Duration;

use anyhow::Context;

use super::{counted, has_no_parameters, leaves_the_process, publish_log};
use crate::cli::ToolsArgs;
use eddy_cli::Interrupt;
use eddy_messages::tool_topics;
use eddy_node::{
    ros::{RosNode, Rosout},
    tools::{FollowCounts, ToolFollower, ToolInputs, ToolTopics, ToolsFile, follow},
};
use eddy_settings::{self as config, usage::Usage};
use eddy_transport::{Link, TransportKind, Transports};

/// Publishes where tools are until a signal comes.
pub fn run(
    args: &ToolsArgs,
    ros: &RosNode,
    rosout: Option<&Rosout>,
    quiet: bool,
    interrupt: &Interrupt,
) -> anyhow::Result<()> {
    has_no_parameters(ros)?;
    let file = config::load::<ToolsFile>(&args.file)?.renamed(ros);
    let wait = Duration::from_secs_f64(args.wait);
    let named = || args.file.display().to_string();
    let mut follower = ToolFollower::new(&file, wait).with_context(named)?;
    let input = ros.link(&input(args)?);
    leaves_the_process(&input)?;
    let transports = Transports::stopped_by(interrupt.shared(), ros.transport_options()?);
    let outputs = tool_topics(&input.topic).map(|topic| ros.link(&input.with_topic(&topic)));
    let mut topics = ToolTopics::open_at(&transports, &outputs, args.reliability)?;
    let _log = publish_log(rosout, &transports, ros, [input.transport])?;
    let mut inputs = ToolInputs::open(&transports, &input, &follower, ros)?;
    if !quiet {
        let tools = counted(file.tools.len() as u64, "tool");
        println!("{tools} beside {input} -> {}", outputs[0]);
    }
    let counts = follow(&mut follower, &mut inputs, &mut topics, interrupt.flag())?;
    if !quiet {
        println!("{}", summary(counts));
    }
    Ok(())
}

/// The link of the command line, else the default one.
fn input(args: &ToolsArgs) -> anyhow::Result<Link> {
    if let Some(input) = &args.input {
        return Ok(input.clone());
    }
    let wrong = |error| Usage::new(format_args!("EDDY_TRANSPORT: {error}"));
    let transport = TransportKind::from_env().map_err(wrong)?;
    Ok(Link { transport, topic: "particles".to_owned() })
}

fn summary(FollowCounts { frames, published, held, refused }: FollowCounts) -> String {
    let without = frames - published;
    let frames = counted(frames, "frame");
    format!(
        "{frames}, {held} with a held pose, {without} without tools; {refused} messages refused"
    )
}
