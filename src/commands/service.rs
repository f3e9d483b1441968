//! `eddy service`: services, without ROS.

use std::time::Duration;

use anyhow::Context as _;

use super::{
    leaves_the_process,
    search::{Found, search},
};
use crate::cli::{SearchArgs, ServiceArgs, ServiceCallArgs, ServiceCommand, ServiceListArgs};
use eddy_cli::Interrupt;
use eddy_node::clients::{Definitions, ServiceClient, find_service};
use eddy_settings::ensure_usage;
use eddy_transport::{Link, TransportError, TransportKind, TransportOptions, Transports};

/// Name of this process in the ROS graph.
const NAME: &str = "eddy_service";
/// How long to wait for a service.
const FIND_TIMEOUT: Duration = Duration::from_secs(10);

/// Runs the subcommand.
pub fn run(args: ServiceArgs, interrupt: &Interrupt) -> anyhow::Result<()> {
    let transports = Transports::new(TransportOptions::from_env(NAME)?);
    match args.command {
        ServiceCommand::List(args) => list(&args, &transports, interrupt),
        ServiceCommand::Type { service } => {
            has_services(service.transport)?;
            let stopped = || interrupt.requested();
            if let Some(found) = find_service(&transports, &service, FIND_TIMEOUT, stopped)? {
                println!("{}", found.type_name);
            }
            Ok(())
        }
        ServiceCommand::Call(args) => call(args, &transports, interrupt),
    }
}

fn list(
    args: &ServiceListArgs,
    transports: &Transports,
    interrupt: &Interrupt,
) -> anyhow::Result<()> {
    let found =
        search_services(&args.search, interrupt, |transport| transports.services(transport))?;
    for service in &found.all {
        match args.show_types {
            true => println!("{} [{}]", service.link, service.type_name),
            false => println!("{}", service.link),
        }
    }
    found.check()
}

/// What is found on the transports within the search time.
pub(super) fn search_services<T: Ord>(
    args: &SearchArgs,
    interrupt: &Interrupt,
    on: impl Fn(TransportKind) -> Result<Vec<T>, TransportError>,
) -> anyhow::Result<Found<T>> {
    args.from.iter().try_for_each(|&transport| has_services(transport))?;
    Ok(search(&args.from, args.wait, interrupt, on))
}

/// Rejects transports without services.
pub(super) fn has_services(transport: TransportKind) -> anyhow::Result<()> {
    leaves_the_process(&Link { transport, topic: "/".to_owned() })?;
    ensure_usage!(transport.is_of_ros(), "{transport}: has no services, expected zenoh or dds");
    Ok(())
}

fn call(
    args: ServiceCallArgs,
    transports: &Transports,
    interrupt: &Interrupt,
) -> anyhow::Result<()> {
    has_services(args.service.transport)?;
    let timeout = Duration::from_secs_f64(args.timeout);
    let stopped = || interrupt.requested();
    let Some(found) = find_service(transports, &args.service, timeout, stopped)? else {
        return Ok(());
    };
    let definitions = Definitions::new(args.ament_prefix_path);
    let client = ServiceClient::new(transports, found, args.type_name.as_deref(), &definitions)?;
    let response = client.call(&args.values, timeout)?;
    print!("{}", serde_saphyr::to_string(&response).context("the response")?);
    Ok(())
}
