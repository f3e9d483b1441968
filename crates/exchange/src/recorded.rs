//! Pressure and energy of particles, as `eddy simulate --fields` records them beside the frames.

use std::iter::Peekable;

use super::error::ExchangeError;
use eddy_bag::{BagReader, Messages};
use eddy_frames::{Frame, Stamp};
use eddy_messages::{Message as _, PointCloud2, cdr, cloud};

/// Names of the properties.
pub(super) const NAMES: [&str; 2] = ["pressure", "energy"];

/// The recorded properties of the frames of a topic, in order.
pub(super) struct RecordedProperties {
    messages: Peekable<Messages>,
    /// The clouds with the stamp of the last frame.
    current: (Stamp, Vec<PointCloud2>),
}

impl RecordedProperties {
    /// The properties recorded beside `topic`; `None` if there are none.
    ///
    /// # Errors
    /// [`ExchangeError::Bag`].
    pub(super) fn open(bag: &BagReader, topic: &str) -> Result<Option<Self>, ExchangeError> {
        let name = format!("{topic}/fields");
        let is_there = bag.topics().iter().any(|info| {
            info.name == name && info.type_name == PointCloud2::TYPE && info.message_count > 0
        });
        if !is_there {
            return Ok(None);
        }
        let messages = bag.messages_of(&name, PointCloud2::TYPE)?.peekable();
        Ok(Some(Self { messages, current: (Stamp(i64::MIN), Vec::new()) }))
    }

    /// The properties of each particle of a frame; NaN if they were not recorded. Frames must come in order.
    ///
    /// # Errors
    /// [`ExchangeError::Bag`].
    pub(super) fn of<const D: usize>(
        &mut self,
        frame: &Frame<D>,
    ) -> Result<[Vec<f32>; 2], ExchangeError> {
        if self.current.0 != frame.stamp {
            self.current = (frame.stamp, Vec::new());
        }
        while let Some(message) =
            self.messages.next_if(|next| next.as_ref().is_ok_and(|m| m.log_time <= frame.stamp))
        {
            // A cloud that cannot be decoded is of no frame.
            let Ok(cloud) = cdr::decode::<PointCloud2>(&message?.data) else { continue };
            if Stamp::from(cloud.header.stamp) == frame.stamp {
                self.current.1.push(cloud);
            }
        }
        if let Some(Err(_)) = self.messages.peek()
            && let Some(damage) = self.messages.next()
        {
            damage?;
        }
        // Streams of one bag may have the same stamps.
        let is_of_frame = |cloud: &&PointCloud2| {
            let x = cloud::property(cloud, "x").unwrap_or_default();
            x.iter().copied().eq(frame.position.iter().map(|position| position[0]))
        };
        let found = self.current.1.iter().find(is_of_frame);
        let property = |name| found.and_then(|cloud| cloud::property(cloud, name));
        Ok(NAMES.map(|name| property(name).unwrap_or_else(|| vec![f32::NAN; frame.len()])))
    }
}
