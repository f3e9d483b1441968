//! The topics of tools beside a topic of simulated frames.

use eddy_frames::{
    Stamp,
    tool::{self, Tools},
};
use eddy_messages::{Message, TOOL_DESCRIPTION_QOS, ToolDescription, ToolFrame, cdr, tool_topics};
use eddy_transport::{Link, Publisher, PublisherOptions, Reliability, TransportError, Transports};

/// The topics of tools, beside that of the frames.
pub(super) struct ToolTopics {
    poses: Box<dyn Publisher>,
    description: Box<dyn Publisher>,
    /// The tools of the scene that runs, if it has any.
    tools: Option<Tools>,
    /// Subscribers of the description when it was last published.
    informed: usize,
}

impl ToolTopics {
    /// Beside a topic of frames.
    pub(super) fn open(
        transports: &Transports,
        frames: &Link,
        reliability: Reliability,
    ) -> Result<Self, TransportError> {
        let [poses, description] =
            tool_topics(&frames.topic).map(|topic| Link { transport: frames.transport, topic });
        let latched =
            PublisherOptions { reliability: Reliability::Drop, qos: Some(TOOL_DESCRIPTION_QOS) };
        Ok(Self {
            poses: transports.publisher(&poses, ToolFrame::TYPE, reliability)?,
            description: transports.publisher(&description, ToolDescription::TYPE, latched)?,
            tools: None,
            informed: 0,
        })
    }

    /// Publishes what the tools of the next scene are, if it has any.
    pub(super) fn describe(&mut self, tools: Option<Tools>) -> Result<(), TransportError> {
        self.tools = tools;
        let Some(tools) = &self.tools else { return Ok(()) };
        self.informed = self.description.subscribers();
        let message = ToolDescription::of(tools, Stamp(0));
        delivered_or_missed(self.description.publish_cdr(&cdr::encode(&message)))
    }

    /// Publishes where they are, and again what they are when a subscriber has come: shared memory keeps nothing for it.
    pub(super) fn publish(&mut self, frame: &tool::ToolFrame) -> Result<(), TransportError> {
        if self.description.subscribers() > self.informed {
            let tools = self.tools.take();
            self.describe(tools)?;
        }
        let Some(tools) = &self.tools else { return Ok(()) };
        delivered_or_missed(self.poses.publish_cdr(&cdr::encode(&ToolFrame::of(frame, tools))))
    }
}

/// Takes it that a message has missed a subscriber, which the log says.
pub(super) fn delivered_or_missed(
    outcome: Result<(), TransportError>,
) -> Result<(), TransportError> {
    match outcome {
        Err(error) if error.is_missed() => {
            tracing::debug!("{error}");
            Ok(())
        }
        outcome => outcome,
    }
}
