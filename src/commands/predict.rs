//! `eddy predict`: the node's code over a bag.

use std::{path::Path, time::Duration};

use anyhow::{anyhow, bail};

use super::{node::summary, streams, surrogate};
use crate::cli::PredictArgs;
use eddy_bag::{BagError, BagReader, BagWriter, TopicId, WriterOptions, custom_data::Quantity};
use eddy_cli::{Interrupt, Output, OutputKind};
use eddy_dataset::DatasetError;
use eddy_evaluation::EvaluationError;
use eddy_frames::Frame;
use eddy_messages::{FrameCdr, Message, ParticleFrame};
use eddy_node::{NodeSettings, Prediction, SurrogateNode};
use eddy_settings::usage::Usage;
use eddy_transport::Payload;

/// The topic of the predictions.
const PREDICTION: &str = "/prediction";

/// Writes the predictions from every frame of a bag into another. Log time is the predicted stamp, counted from the first one if
/// that is before 0, so that two runs give identical files.
pub fn run(args: PredictArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    let (reader, mut node) = open(&args)?;
    let found = eddy_dataset::survey_streams(&reader, &args.topic, &|| interrupt.requested())?;
    if let (Some(first), false) = (found.unusable.values().next(), args.skip_streams) {
        return Err(streams::refused_frame(first));
    }
    let skipped: Vec<_> = found.unusable.values().cloned().collect();
    streams::count_skipped(&skipped, found.usable.len());

    let room =
        Output::at(&args.output, OutputKind::Bag, args.force, std::slice::from_ref(&args.input))?;
    // Stiffness and gravity of the predictions are those of the bag.
    let stated = Quantity::ALL.into_iter().filter_map(|quantity| {
        Some((quantity.key().to_owned(), reader.custom_data().get(quantity.key())?.clone()))
    });
    let mut predictions =
        Predictions { output: &args.output, stated: stated.collect(), written: None };
    let mut failure = None;
    for message in reader.messages_of(&args.topic, ParticleFrame::TYPE)? {
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
        predictions.add(&mut node, payload)?;
        if let Err(error) = node.check() {
            failure = Some(error.into());
            break;
        }
    }
    let is_empty = !predictions.finish()?;
    let input = args.input.display();
    // Without predictions, the error below says why.
    if !is_empty {
        node.rejections().totals().iter().for_each(|total| tracing::warn!("{input}: {total}"));
    }
    if !quiet && !is_empty {
        println!("{}: {}", args.output.display(), summary(&node));
    }
    if let Some(failure) = failure {
        return Err(failure);
    }
    if is_empty {
        let received = node.counters().received;
        match node.rejections().last() {
            Some(reason) if node.counters().bad() == received => {
                bail!("{input}: all {received} frames were rejected: {reason}")
            }
            Some(_) => bail!("{input}: no frames to predict from: {}", summary(&node)),
            None => bail!("{input}: no frames to predict from"),
        }
    }
    room.replaced();
    Ok(())
}

/// The bag, and a node with the settings of the command line and what the bag states about its streams.
fn open(args: &PredictArgs) -> anyhow::Result<(BagReader, SurrogateNode)> {
    let surrogate = surrogate::load(args.checkpoint.as_deref(), args.threads, args.device)?;
    let mut settings = NodeSettings::default();
    let options = args.settings.parameters();
    options.iter().try_for_each(|option| settings.set(option)).map_err(Usage::new)?;
    let reader = BagReader::open(&args.input)?;
    let description = surrogate.description();
    if description.stiffness && settings.stiffness.is_none() {
        settings.stiffness = match eddy_dataset::stiffness_of(&reader, &args.topic) {
            Ok(stiffness) => Some(stiffness.into()),
            Err(DatasetError::Stiffness { .. }) if description.assumed_stiffness.is_some() => None,
            Err(error @ DatasetError::Stiffness { .. }) => {
                return Err(EvaluationError::UnknownStiffness(error).into());
            }
            Err(other) => return Err(other.into()),
        };
    }
    let stated = eddy_dataset::stated_by(&reader, &args.topic)?;
    let mut node = SurrogateNode::new(surrogate, settings)?;
    node.streams_state(stated);
    Ok((reader, node))
}

/// The bag of the predictions. It begins with the first one, so that there is no empty bag.
struct Predictions<'a> {
    output: &'a Path,
    /// Entries of its `custom_data`.
    stated: Vec<(String, String)>,
    written: Option<(BagWriter, TopicId)>,
}

impl Predictions<'_> {
    /// Writes what the node predicts from a frame.
    fn add(&mut self, node: &mut SurrogateNode, frame: Payload) -> Result<(), BagError> {
        let (mut published, mut outcome) = (0, Ok(()));
        node.on_frames(&mut [(Duration::ZERO, frame)], None, &mut |_, predicted| match predicted {
            Ok(Prediction { frame, .. }) if outcome.is_ok() => {
                outcome = self.write(frame);
                published += 1;
            }
            // The node logs what it rejects.
            Ok(_) | Err(_) => {}
        });
        outcome?;
        node.counters_mut().published += published;
        Ok(())
    }

    fn write(&mut self, frame: &Frame) -> Result<(), BagError> {
        let (writer, topic) = match &mut self.written {
            Some(open) => open,
            none => {
                let mut writer = BagWriter::create(self.output, WriterOptions::default())?;
                writer.extend_custom_data(std::mem::take(&mut self.stated));
                let topic = writer.topic(PREDICTION, ParticleFrame::TYPE)?;
                none.insert((writer, topic))
            }
        };
        writer.write_stamped(*topic, frame.stamp, &frame.to_cdr())
    }

    /// Closes the bag. Returns whether there is one.
    fn finish(self) -> Result<bool, BagError> {
        let Some((writer, _)) = self.written else { return Ok(false) };
        writer.finish()?;
        Ok(true)
    }
}
