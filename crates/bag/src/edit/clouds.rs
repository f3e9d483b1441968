//! The frames of a bag also as point clouds.

use std::{collections::BTreeMap, path::Path, sync::Arc};

use super::{CopyOptions, copy};
use crate::{
    channel::Channel, error::BagError, messages::BagMessage, reader::BagReader, writer::BagSummary,
};
use eddy_frames::Frame;
use eddy_messages::{FrameCdr, Message, ParticleFrame, PointCloud2, cloud, type_support};

/// The topics of frames that have no cloud beside them yet.
pub fn without_cloud(bag: &BagReader) -> Vec<String> {
    let topics = bag.topics();
    let has_cloud = |name: &str| topics.iter().any(|topic| topic.name == beside(name));
    let frames = topics.iter().filter(|topic| topic.type_name == ParticleFrame::TYPE);
    frames.map(|topic| topic.name.clone()).filter(|name| !has_cloud(name)).collect()
}

/// Copies a bag into a new one at `output`, with a `sensor_msgs/msg/PointCloud2` on `TOPIC/cloud` beside
/// every frame of [`without_cloud`], of the same times. A message that is no frame has none.
///
/// # Errors
/// As [`extract`](fn@super::extract); [`BagError::Type`] never, as the type of clouds is known.
pub fn clouds(
    bag: &BagReader,
    output: &Path,
    options: CopyOptions<'_>,
) -> Result<BagSummary, BagError> {
    let mut channels = BTreeMap::new();
    for topic in without_cloud(bag) {
        let support = type_support(PointCloud2::TYPE)
            .map_err(|reason| BagError::Type { topic: topic.clone(), reason })?;
        let channel =
            Channel::ros(&beside(&topic), PointCloud2::TYPE, &support.schema, &support.hash, 0);
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
    copy(output, channels, bag.extras(), with_clouds, options)
}

/// The topic of the clouds of a topic of frames, as the node publishes them.
fn beside(topic: &str) -> String {
    format!("{topic}/cloud")
}

fn cloud_of(message: &BagMessage, channel: &Arc<Channel>) -> Option<BagMessage> {
    match Frame::from_cdr(&message.data) {
        Ok(frame) => Some(BagMessage {
            topic: channel.topic.as_str().into(),
            type_name: PointCloud2::TYPE.into(),
            data: cloud::to_cdr(&frame),
            channel: Arc::clone(channel),
            ..message.clone()
        }),
        Err(error) => {
            tracing::warn!("{}: message {} has no cloud: {error}", message.topic, message.sequence);
            None
        }
    }
}
