//! `eddy param`: parameters of nodes, without ROS.

use std::time::Duration;

use anyhow::{Context as _, bail};

use super::service::{has_services, search_services};
use crate::cli::{ParamArgs, ParamCommand};
use eddy_cli::Interrupt;
use eddy_messages::services::Parameter;
use eddy_node::clients::{ParameterClient, nodes_with_parameters, parse_value, value_text};
use eddy_settings::usage::Usage;
use eddy_transport::{Link, TransportOptions, Transports};

/// Name of this process in the ROS graph.
const NAME: &str = "eddy_param";
/// How long to wait for a node, and for each response.
const TIMEOUT: Duration = Duration::from_secs(10);

/// Runs the subcommand.
pub fn run(args: ParamArgs, interrupt: &Interrupt) -> anyhow::Result<()> {
    let transports = Transports::new(TransportOptions::from_env(NAME)?);
    let open = |node: Link| -> anyhow::Result<Option<ParameterClient<'_>>> {
        has_services(node.transport)?;
        let stopped = || interrupt.requested();
        Ok(ParameterClient::open(&transports, node, TIMEOUT, stopped)?)
    };
    match args.command {
        ParamCommand::List { node: Some(node), .. } => {
            let Some(client) = open(node)? else { return Ok(()) };
            client.names()?.iter().for_each(|name| println!("{name}"));
        }
        ParamCommand::List { node: None, search: args } => {
            let found = search_services(&args, interrupt, |transport| {
                Ok(nodes_with_parameters(&transports, transport)?.into_iter().collect())
            })?;
            for node in &found.all {
                println!("{node}:");
                if let Some(client) = open(node.clone())? {
                    client.names()?.iter().for_each(|name| println!("  {name}"));
                }
            }
            found.check()?;
        }
        ParamCommand::Get { node, name, hide_type } => {
            let shown = node.clone();
            let Some(client) = open(node)? else { return Ok(()) };
            let values = client.values(vec![name.clone()])?;
            match values.first().and_then(value_text) {
                Some((_, text)) if hide_type => println!("{text}"),
                Some((kind, text)) if kind.ends_with('s') => println!("{kind} are: {text}"),
                Some((kind, text)) => println!("{kind} value is: {text}"),
                None => bail!("{shown}: parameter {name} is not set"),
            }
        }
        ParamCommand::Set { node, name, value } => {
            let value = parse_value(&value).map_err(Usage::new)?;
            let Some(client) = open(node)? else { return Ok(()) };
            let result = client.set(Parameter { name: name.clone(), value })?;
            if !result.successful {
                bail!("{name} was not set: {}", result.reason);
            }
            println!("Set parameter successful");
        }
        ParamCommand::Dump { node } => {
            let Some(client) = open(node)? else { return Ok(()) };
            print!("{}", serde_saphyr::to_string(&client.dump()?).context("the parameters")?);
        }
    }
    Ok(())
}
