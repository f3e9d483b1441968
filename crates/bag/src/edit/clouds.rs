//! Adds point clouds to the frames of a bag.

use std::{collections::BTreeMap, path::Path, sync::Arc};

use super::copy::{CopyOptions, copy, recording_of};
use crate::{
    error::BagError,
    format::{channel::Channel, summary::BagSummary},
    read::{messages::BagMessage, reader::BagReader},
};
use eddy_frames::{AnyFrame, with_frame};
use eddy_messages::{
    FrameCdr, Message, ParticleFrame, PointCloud2, QosProfile, cloud, type_support,
};

/// The frame topics that have no cloud topic.
pub fn topics_without_cloud(bag: &BagReader) -> Vec<String> {
    let topics = bag.topics();
    let has_cloud = |name: &str| topics.iter().any(|topic| topic.name == cloud_topic(name));
    let frames = topics.iter().filter(|topic| topic.type_name == ParticleFrame::TYPE);
    frames.map(|topic| topic.name.clone()).filter(|name| !has_cloud(name)).collect()
}

/// Copies a bag into a new one at `output` and adds a `sensor_msgs/msg/PointCloud2` on `TOPIC/cloud` for every
/// frame of [`topics_without_cloud`], with its times. A message that is not a frame has no cloud.
///
/// # Errors
/// As [`extract`](fn@super::extract).
pub fn clouds(
    bag: &BagReader,
    output: &Path,
    options: CopyOptions<'_>,
) -> Result<BagSummary, BagError> {
    let mut channels = BTreeMap::new();
    for topic in topics_without_cloud(bag) {
        let support = type_support(PointCloud2::TYPE)
            .map_err(|reason| BagError::Type { topic: topic.clone(), reason })?;
        let channel = Channel::ros(&cloud_topic(&topic), support, &[QosProfile::default()]);
        channels.insert(topic, Arc::new(channel));
    }
    let with_clouds = bag.messages().flat_map(|message| {
        let cloud = message.as_ref().ok().and_then(|frame| {
            let channel = channels.get(&*frame.topic)?;
            cloud_of(frame, channel)
        });
        [Some(message), cloud.map(Ok)].into_iter().flatten()
    });
    let channels = bag.channels().iter().chain(channels.values());
    copy(output, channels, recording_of(bag), with_clouds, options)
}

/// The topic on which a node publishes the clouds of a topic of frames.
fn cloud_topic(topic: &str) -> String {
    format!("{topic}/cloud")
}

fn cloud_of(message: &BagMessage, channel: &Arc<Channel>) -> Option<BagMessage> {
    match AnyFrame::from_cdr(&message.data) {
        Ok(frame) => Some(BagMessage {
            topic: channel.topic.as_str().into(),
            type_name: PointCloud2::TYPE.into(),
            data: with_frame!(frame, frame => cloud::to_cdr(&frame)),
            channel: Arc::clone(channel),
            ..message.clone()
        }),
        Err(error) => {
            tracing::warn!("{}: message {} has no cloud: {error}", message.topic, message.sequence);
            None
        }
    }
}
