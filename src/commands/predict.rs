//! `eddy predict`: the node's code over a bag.

use std::time::Duration;

use anyhow::{anyhow, ensure};

use super::{
    Interrupt,
    node::summary,
    output::{Output, OutputKind},
    streams, surrogate,
};
use crate::cli::PredictArgs;
use eddy_bag::{BagReader, BagWriter, WriterOptions};
use eddy_evaluation::{EvaluationError, dataset};
use eddy_messages::{FrameCdr, Message, ParticleFrame};
use eddy_node::{NodeSettings, Prediction, SurrogateNode};
use eddy_settings::usage::Usage;
use eddy_transport::Payload;

/// The topic of the predictions.
const PREDICTION: &str = "/prediction";

/// Writes the predictions from every frame of a bag into another. Log time is the predicted stamp, counted from the first one if
/// that is before 0, so that two runs give identical files.
pub fn run(args: PredictArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    let surrogate = surrogate::load(args.checkpoint.as_deref(), args.threads, args.device)?;
    let mut settings = NodeSettings::default();
    let options = args.settings.parameters();
    options.iter().try_for_each(|option| settings.set(option)).map_err(Usage::new)?;
    let reader = BagReader::open(&args.input)?;
    if surrogate.description().stiffness && settings.stiffness.is_none() {
        let stiffness = dataset::stiffness_of(&reader, &args.topic);
        settings.stiffness = Some(stiffness.map_err(EvaluationError::UnknownStiffness)?.into());
    }
    let mut node = SurrogateNode::new(surrogate, settings)?;
    let found = dataset::survey_streams(&reader, &args.topic, &|| interrupt.requested())?;
    if let (Some(first), false) = (found.unusable.values().next(), args.skip_streams) {
        return Err(streams::refused_frame(first));
    }
    let skipped: Vec<_> = found.unusable.values().cloned().collect();
    streams::count_skipped(&skipped, found.usable.len());

    let room =
        Output::at(&args.output, OutputKind::Bag, args.force, std::slice::from_ref(&args.input))?;
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
            // The predictions so far are kept.
            Err(error) => {
                failure = Some(error.into());
                break;
            }
        };
        let payload = Payload::Cdr(message.data);
        if payload.stream().is_some_and(|stream| found.unusable.contains_key(&stream)) {
            continue;
        }
        let mut arrival = [(Duration::ZERO, payload)];
        let (mut published, mut outcome) = (0, Ok(()));
        node.on_frames(&mut arrival, None, &mut |_, predicted| match predicted {
            Ok(Prediction { frame, .. }) if outcome.is_ok() => {
                outcome = writer.write_stamped(topic, frame.stamp, &frame.to_cdr());
                published += 1;
            }
            Ok(_) => {}
            Err(rejection) => {
                tracing::warn!("{}: frame rejected: {rejection}", args.input.display());
            }
        });
        outcome?;
        node.counters_mut().published += published;
        if let Err(error) = node.check() {
            failure = Some(error.into());
            break;
        }
    }
    writer.finish()?;
    if !quiet {
        println!("{}: {}", args.output.display(), summary(node.counters()));
    }
    if let Some(failure) = failure {
        return Err(failure);
    }
    ensure!(node.counters().published > 0, "{}: no frames to predict from", args.input.display());
    room.replaced();
    Ok(())
}
