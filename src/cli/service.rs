//! `eddy service` and `eddy param`: their subcommands.

use std::path::PathBuf;

use clap::{Args, Subcommand};

use super::values;
use eddy_transport::{Link, TransportKind};

/// `eddy service`
#[derive(Debug, Args)]
pub struct ServiceArgs {
    #[command(subcommand)]
    pub command: ServiceCommand,
}

#[derive(Debug, Subcommand)]
pub enum ServiceCommand {
    /// List services.
    List(ServiceListArgs),
    /// Print the type of a service.
    Type {
        /// Service, for example /eddy_node/reset or dds:/eddy_node/reset.
        #[arg(value_parser = Link::from_argument)]
        service: Link,
    },
    /// Send a request and print the response as YAML.
    Call(ServiceCallArgs),
}

/// `eddy service list`
#[derive(Debug, Args)]
pub struct ServiceListArgs {
    #[command(flatten)]
    pub search: SearchArgs,
    /// Show the types.
    #[arg(long, short = 't')]
    pub show_types: bool,
}

/// `eddy service call`
#[derive(Debug, Args)]
pub struct ServiceCallArgs {
    /// Service, for example /eddy_node/reset or dds:/eddy_node/reset.
    #[arg(value_parser = Link::from_argument)]
    pub service: Link,
    /// Its type, for example std_srvs/srv/Trigger [default: what it offers].
    #[arg(value_name = "TYPE")]
    pub type_name: Option<String>,
    /// The request in YAML; missing fields are 0, false or empty.
    #[arg(value_name = "VALUES", default_value = "{}", hide_default_value = true)]
    pub values: String,
    /// Wait this long for the service, and then for the response (s).
    #[arg(long, value_name = "SECONDS", default_value_t = 10.0, value_parser = values::positive_seconds)]
    pub timeout: f64,
    /// Installations of ROS 2 with definitions of service types, separated by colons [default: none].
    #[arg(
        long,
        value_name = "PATHS",
        env = "AMENT_PREFIX_PATH",
        hide_env_values = true,
        value_delimiter = ':'
    )]
    pub ament_prefix_path: Vec<PathBuf>,
}

/// Where and for how long to search.
#[derive(Debug, Args)]
pub struct SearchArgs {
    /// Transports to search; discovery on dds takes several seconds.
    #[arg(long, value_name = "TRANSPORT", value_delimiter = ',', default_values = ["zenoh"], env = "EDDY_TRANSPORT", hide_env_values = true)]
    pub from: Vec<TransportKind>,
    /// Search time (s).
    #[arg(long, value_name = "SECONDS", default_value_t = 2.0, value_parser = values::seconds)]
    pub wait: f64,
}

/// `eddy param`
#[derive(Debug, Args)]
pub struct ParamArgs {
    #[command(subcommand)]
    pub command: ParamCommand,
}

#[derive(Debug, Subcommand)]
pub enum ParamCommand {
    /// List the parameters of a node, or of all nodes.
    List {
        /// Node, for example /eddy_node or dds:/eddy_node [default: all nodes].
        #[arg(value_parser = node)]
        node: Option<Link>,
        #[command(flatten)]
        search: SearchArgs,
    },
    /// Print the value of a parameter.
    Get {
        /// Node, for example /eddy_node or dds:/eddy_node.
        #[arg(value_parser = node)]
        node: Link,
        /// Name of the parameter.
        name: String,
        /// Print the value without its type.
        #[arg(long)]
        hide_type: bool,
    },
    /// Set a parameter.
    Set {
        /// Node, for example /eddy_node or dds:/eddy_node.
        #[arg(value_parser = node)]
        node: Link,
        /// Name of the parameter.
        name: String,
        /// Value in YAML.
        #[arg(allow_negative_numbers = true)]
        value: String,
    },
    /// Print all parameters of a node as a file for --params-file.
    Dump {
        /// Node, for example /eddy_node or dds:/eddy_node.
        #[arg(value_parser = node)]
        node: Link,
    },
}

/// A node; the slash before its name may be missing, as for `ros2 param`.
fn node(text: &str) -> Result<Link, eddy_transport::InvalidLink> {
    match text.contains(':') || text.starts_with('/') {
        true => Link::from_argument(text),
        false => Link::from_argument(&format!("/{text}")),
    }
}
