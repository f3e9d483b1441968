//! `eddy topic list`

use super::print;
use crate::{
    cli::TopicListArgs,
    commands::{leave_the_process, search::search},
};
use eddy_cli::{Interrupt, terminal::on_one_line};
use eddy_transport::{SeenTopic, Transports};

pub(super) fn run(
    args: &TopicListArgs,
    transports: &Transports,
    interrupt: &Interrupt,
) -> anyhow::Result<()> {
    leave_the_process(&args.from)?;
    let found = search(&args.from, args.wait, interrupt, |transport| transports.topics(transport));
    if found.all.is_empty() && found.is_complete() {
        let transports: Vec<_> = args.from.iter().map(ToString::to_string).collect();
        let transports = transports.join(", ");
        tracing::warn!(
            "no topics on {transports} within {} s; --from selects transports",
            args.wait
        );
    }
    let link = |topic: &SeenTopic| on_one_line(&topic.link.to_string()).into_owned();
    let width = found.all.iter().map(|topic| link(topic).chars().count()).max().unwrap_or(0);
    for topic in &found.all {
        let type_name = on_one_line(&topic.type_name);
        if !print(&format!("{:width$}  {type_name}", link(topic))) {
            break;
        }
    }
    found.check()
}
