//! `eddy topic echo`

use anyhow::Context;
use serde_json::Value;

use super::{PATIENCE, find};
use crate::{cli::TopicEchoArgs, commands::Interrupt};
use eddy::{
    msg::{Clock, DiagnosticArray, Message, ParticleFrame, PredictionStatus, RosString, cdr},
    transport::{Payload, Transports},
};

pub(super) fn run(
    args: &TopicEchoArgs,
    transports: &Transports,
    interrupt: &Interrupt,
) -> anyhow::Result<()> {
    let Some(topic) = find(&args.link, transports, interrupt)? else { return Ok(()) };
    let mut subscriber = transports
        .subscriber_of(&topic.link, &topic.type_support())
        .with_context(|| format!("cannot subscribe to {}", topic.link))?;
    let mut printed = 0;
    while !interrupt.requested() && args.count.is_none_or(|count| printed < count.get()) {
        let Some(payload) = subscriber.receive(PATIENCE)? else { continue };
        println!("{}---", text(&topic.type_name, payload, args.truncate)?);
        printed += 1;
    }
    Ok(())
}

/// A message as YAML; of types that are not known here only the size.
fn text(type_name: &str, payload: Payload, truncate: usize) -> anyhow::Result<String> {
    let bytes = payload.into_cdr();
    let value = match type_name {
        ParticleFrame::TYPE => value::<ParticleFrame>(&bytes),
        PredictionStatus::TYPE => value::<PredictionStatus>(&bytes),
        DiagnosticArray::TYPE => value::<DiagnosticArray>(&bytes),
        Clock::TYPE => value::<Clock>(&bytes),
        RosString::TYPE => value::<RosString>(&bytes),
        _ => return Ok(format!("# {} bytes of {type_name}\n", bytes.len())),
    };
    match value {
        Ok(mut value) => {
            shorten(&mut value, truncate);
            Ok(serde_saphyr::to_string(&value)?)
        }
        Err(error) => Ok(format!("# no {type_name}: {error}\n")),
    }
}

fn value<M: Message>(bytes: &[u8]) -> anyhow::Result<Value> {
    Ok(serde_json::to_value(cdr::decode::<M>(bytes)?)?)
}

/// Leaves so many numbers of each list, and says how many there were.
fn shorten(value: &mut Value, most: usize) {
    match value {
        Value::Array(values) if most > 0 && values.len() > most && values[0].is_number() => {
            let count = values.len();
            values.truncate(most);
            values.push(Value::from(format!("... of {count}")));
        }
        Value::Array(values) => values.iter_mut().for_each(|value| shorten(value, most)),
        Value::Object(fields) => fields.values_mut().for_each(|value| shorten(value, most)),
        _ => {}
    }
}
