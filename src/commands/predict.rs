//! `eddy predict`: the node's code over a bag.

use std::time::Duration;

use anyhow::{anyhow, ensure};

use super::{Interrupt, node::summary, surrogate};
use crate::cli::PredictArgs;
use eddy::{
    bag::{BagReader, BagWriter, WriterOptions},
    frame::Frame,
    msg::{Message, ParticleFrame},
    node::{NodeSettings, SurrogateNode},
};

/// The topic of the predictions.
const PREDICTION: &str = "/prediction";

/// Writes the predictions of every frame of a bag into another one. Log time is the predicted stamp,
/// so that two runs give equal files.
pub fn run(args: PredictArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    let surrogate = surrogate::load(args.checkpoint.as_deref(), args.threads)?;
    let settings =
        NodeSettings { horizon: args.horizon, publish: args.publish, ..NodeSettings::default() };
    let mut node = SurrogateNode::new(surrogate, settings)?;

    let reader = BagReader::open(&args.input)?;
    let messages = reader.messages_of(&args.topic, ParticleFrame::TYPE)?;
    let mut writer = BagWriter::create(&args.output, WriterOptions::default())?;
    let topic = writer.topic(PREDICTION, ParticleFrame::TYPE)?;
    let mut failure = None;
    for message in messages {
        if interrupt.requested() {
            failure = Some(anyhow!("{}: interrupted", args.output.display()));
            break;
        }
        let message = match message {
            Ok(message) => message,
            // What was predicted so far is kept.
            Err(error) => {
                failure = Some(error.into());
                break;
            }
        };
        let frame = Frame::from_cdr(&message.data);
        let predictions = match node.on_frame(frame, Duration::ZERO) {
            Ok(predictions) => predictions,
            Err(refusal) => {
                tracing::warn!("{}: frame refused: {refusal}", args.input.display());
                Vec::new()
            }
        };
        for prediction in predictions {
            let stamp = prediction.frame.stamp;
            writer.write(topic, stamp, stamp, &prediction.frame.to_cdr())?;
            node.counters_mut().published += 1;
        }
    }
    writer.finish()?;
    if !quiet {
        println!("{}: {}", args.output.display(), summary(node.counters()));
    }
    if let Some(failure) = failure {
        return Err(failure);
    }
    ensure!(
        node.counters().published > 0,
        "{}: found no frame that could be predicted from, expected at least one",
        args.input.display()
    );
    Ok(())
}
