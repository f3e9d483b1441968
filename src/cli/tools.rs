//! `eddy tools`: the file of tools, and where frames and poses come from.

use std::path::PathBuf;

use clap::Args;

use super::RosArgs;
use eddy_cli::values;
use eddy_transport::{Link, Reliability};

/// `eddy tools`
#[derive(Debug, Args)]
pub struct ToolsArgs {
    /// TOML file with `[[tools]]`: name, shape and contact as in scenes, and pose = TOPIC (geometry_msgs/msg/PoseStamped) or
    /// frame = FRAME (on /tf and /tf_static).
    pub file: PathBuf,
    /// Link of the frames of particles; poses come from its transport [default: /particles in the namespace of --ros-args].
    #[arg(long, value_name = "LINK", value_parser = Link::parse_of_node)]
    pub input: Option<Link>,
    /// How long a frame waits for poses at or after its stamp (s); after that, tools hold their last pose.
    #[arg(long, value_name = "SECONDS", default_value_t = 0.1, value_parser = values::seconds)]
    pub wait: f64,
    /// What happens when a subscriber cannot keep up.
    #[arg(long, value_enum, default_value_t = Reliability::Drop)]
    pub reliability: Reliability,
    #[command(flatten)]
    pub ros: RosArgs,
}
