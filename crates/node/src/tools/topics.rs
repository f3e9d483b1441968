//! The topics of tools beside a topic of frames.

use std::collections::VecDeque;

use eddy_frames::{
    Stamp,
    tool::{self, Tools},
};
use eddy_messages::{Message, TOOL_DESCRIPTION_QOS, ToolDescription, ToolFrame, cdr, tool_topics};
use eddy_transport::{Link, Publisher, PublisherOptions, Reliability, TransportError, Transports};

/// The topics of tools, beside that of the frames.
pub struct ToolTopics {
    poses: Box<dyn Publisher>,
    description: Box<dyn Publisher>,
    /// The tools of the last streams, as many as late subscribers receive.
    tools: VecDeque<Tools>,
    /// Subscribers of the description when it was last published.
    informed: usize,
}

impl ToolTopics {
    /// Beside a topic of frames.
    ///
    /// # Errors
    /// [`TransportError`].
    pub fn open(
        transports: &Transports,
        frames: &Link,
        reliability: Reliability,
    ) -> Result<Self, TransportError> {
        let links = tool_topics(&frames.topic).map(|topic| frames.with_topic(&topic));
        Self::open_at(transports, &links, reliability)
    }

    /// At the link of the poses and that of the description.
    ///
    /// # Errors
    /// [`TransportError`].
    pub fn open_at(
        transports: &Transports,
        [poses, description]: &[Link; 2],
        reliability: Reliability,
    ) -> Result<Self, TransportError> {
        let latched =
            PublisherOptions { reliability: Reliability::Drop, qos: Some(TOOL_DESCRIPTION_QOS) };
        Ok(Self {
            poses: transports.publisher(poses, ToolFrame::TYPE, reliability)?,
            description: transports.publisher(description, ToolDescription::TYPE, latched)?,
            tools: VecDeque::new(),
            informed: 0,
        })
    }

    /// Publishes what the tools of a stream are.
    ///
    /// # Errors
    /// [`TransportError`].
    pub fn describe(&mut self, tools: Tools) -> Result<(), TransportError> {
        self.informed = self.description.subscribers();
        let message = cdr::encode(&ToolDescription::of(&tools, Stamp(0)));
        self.tools.retain(|other| other.stream != tools.stream);
        while self.tools.len() >= TOOL_DESCRIPTION_QOS.kept() {
            self.tools.pop_front();
        }
        self.tools.push_back(tools);
        delivered_or_missed(self.description.publish_cdr(&message))
    }

    /// Whether the tools of a stream are described.
    pub fn describes(&self, stream: u64) -> bool {
        self.tools.iter().any(|tools| tools.stream == stream)
    }

    /// Publishes where they are, and again what they are when a subscriber has come: shared memory keeps nothing for it. A stream without
    /// tools has no poses.
    ///
    /// # Errors
    /// [`TransportError`].
    pub fn publish(&mut self, frame: &tool::ToolFrame) -> Result<(), TransportError> {
        if self.description.subscribers() > self.informed {
            for tools in std::mem::take(&mut self.tools) {
                self.describe(tools)?;
            }
        }
        match self.tools.iter().find(|tools| tools.stream == frame.stream) {
            Some(tools) => {
                let message = cdr::encode(&ToolFrame::of(frame, tools));
                delivered_or_missed(self.poses.publish_cdr(&message))
            }
            None => Ok(()),
        }
    }

    /// Waits until subscribers have what was published, as far as the transport knows.
    ///
    /// # Errors
    /// As [`Publisher::flush`].
    pub fn flush(&mut self) -> Result<(), TransportError> {
        self.poses.flush()
    }
}

/// Takes it that a message has missed a subscriber, which the log says.
///
/// # Errors
/// All others.
pub fn delivered_or_missed(outcome: Result<(), TransportError>) -> Result<(), TransportError> {
    match outcome {
        Err(error) if error.is_missed() => {
            tracing::debug!("{error}");
            Ok(())
        }
        outcome => outcome,
    }
}
