//! The first screen of help: commands in groups, and what `eddy help TOPIC` explains.

use std::fmt::Write as _;

use clap::Command;

/// The most frequently used commands, grouped by purpose. All others are listed on one line below.
const GROUPS: &[(&str, &[&str])] = &[
    ("Start here", &["demo"]),
    ("Simulate, learn, judge", &["simulate", "train", "eval", "predict"]),
    ("Live", &["node", "record", "replay"]),
    ("Look inside", &["bag", "topic"]),
];

/// Texts that belong to several commands.
const TOPICS: &[(&str, &str)] = &[("links", LINKS), ("bags", BAGS), ("checkpoints", CHECKPOINTS)];

const LINKS: &str = "\
Links: where messages come from and go to

A link is a transport and a topic: zenoh:/particles, shm:/prediction, dds:/particles.

  zenoh    the wire of ROS 2 with rmw_zenoh; also between machines
  shm      shared memory (iceoryx2) on one machine, the fastest for large frames
  dds      the wire of ROS 2 with Fast DDS or Cyclone DDS

A topic alone, such as /particles, is on the transport in EDDY_TRANSPORT, on zenoh
without it. ROS_DOMAIN_ID separates groups of programs (default 0). By default, all
transports are limited to this machine. To reach others, set ZENOH_CONFIG_OVERRIDE or
ZENOH_SESSION_CONFIG_URI for zenoh, ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET for dds.

  --reliability block   a publisher waits for its subscribers and loses nothing
  --reliability drop    it never waits; slow subscribers miss messages

Frames are eddy_msgs/msg/ParticleFrame; for shm, the same in the publisher's memory.

Examples:
  eddy topic list                              what is published
  eddy record zenoh:/particles -o bags/live    record a link
  eddy node --input shm:/particles --output shm:/prediction";

const BAGS: &str = "\
Bags: recordings of topics, as in ROS 2

A bag is a directory with metadata.yaml and MCAP files, as rosbag2 writes it; ros2 bag,
Foxglove and rosbags read it. Frames of particles are on /particles, predictions on
/prediction. Commands that take several bags also take directories of bags.

What a frame has: x, y, velocity and material of each particle; the time between frames
dt (s), the domain (walls), a stream, a sequence number, a stamp. Lengths are in one
unit of your choice; the shipped model wants a box of about 1 x 1 and particles 1/128
apart. metadata.yaml may say eddy_stiffness (Young's modulus, density x velocity^2) and
eddy_gravity (along y, negative is down).

Where bags come from:
  eddy simulate        eddy's own solver
  eddy record          any publisher
  eddy bag import      npz, GNS, LagrangeBench (HDF5)
  eddy.BagWriter       Python

Examples:
  eddy bag info bags/sample     what is in it
  eddy bag check bags/sample    what is wrong with it
  eddy bag render bags/sample --output sample.gif";

const CHECKPOINTS: &str = "\
Checkpoints: trained networks

A checkpoint is a directory with model.toml (what the network is and expects) and
model.safetensors (its weights); error_model.toml, if `eddy calibrate` has written it,
holds estimates of the errors of predictions.

Without --checkpoint, all commands but eval and calibrate use the shipped one,
particle-mingru (--checkpoint takes this name, too): liquid, snow, jelly and rope of
Young's moduli 3e2 to 3e5, gravity -9.8, frames 16 ms apart. It knows eddy's own solver.
For other data, train one:

  eddy train --data bags/mine --output checkpoints/mine
  eddy eval --checkpoint checkpoints/mine --data bags/unseen --output reports/mine
  eddy node --checkpoint checkpoints/mine

Frames with another dt, dimension or material than those of the training are refused;
another gravity, stiffness or spacing of particles is warned of.";

/// The command line with its first screen in groups, and with topics of help.
pub(super) fn with_topics(command: Command) -> Command {
    let screen = first_screen(&command);
    let topics = TOPICS.iter().map(|&(name, text)| {
        Command::new(name)
            .about(text)
            .help_template("{about}")
            .hide(true)
            .arg_required_else_help(true)
    });
    command.help_template(screen).subcommands(topics)
}

/// The names of the topics, for a sentence.
pub(super) fn listed() -> String {
    TOPICS.iter().map(|(name, _)| *name).collect::<Vec<_>>().join(", ")
}

/// A template of clap's.
fn first_screen(command: &Command) -> String {
    let mut text = "{about}\n\n{usage-heading} {usage}\n".to_owned();
    for (heading, names) in GROUPS {
        write!(text, "\n{heading}:\n").expect("memory");
        for name in *names {
            let about = command.find_subcommand(name).and_then(Command::get_about);
            let about = about.expect("a group names commands");
            writeln!(text, "  {name:10}{about}").expect("memory");
        }
    }
    let first = |name: &str| GROUPS.iter().any(|(_, names)| names.contains(&name));
    let names = command.get_subcommands().map(Command::get_name).filter(|name| !first(name));
    let others = names.collect::<Vec<_>>().join(", ");
    write!(
        text,
        "\nMore commands: {others}\n\
        `eddy help COMMAND` explains a command, `eddy help TOPIC` one of {}.\n\n\
        Global options:\n{{options}}",
        listed()
    )
    .expect("memory");
    text
}
