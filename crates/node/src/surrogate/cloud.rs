//! Frames as point clouds, for viewers.

use eddy_frames::FrameView;
use eddy_messages::cloud;
use eddy_transport::Publisher;

/// A topic of point clouds. Nothing is encoded without subscribers, as far as the transport knows them.
pub struct CloudTopic {
    publisher: Box<dyn Publisher>,
    /// Whether the last cloud could not be sent: a failure is logged once, not for every frame.
    failed: bool,
}

impl CloudTopic {
    /// Publishes through `publisher`.
    pub fn new(publisher: Box<dyn Publisher>) -> Self {
        Self { publisher, failed: false }
    }

    /// Publishes the frame if it is valid and the topic has subscribers.
    pub fn publish(&mut self, frame: &FrameView<'_>) {
        if self.publisher.subscribers() == 0 || frame.check().is_err() {
            return;
        }
        let outcome = self.publisher.publish_cdr(&cloud::to_cdr(&frame.to_frame()));
        if let (Err(error), false) = (&outcome, self.failed) {
            tracing::warn!("cannot publish point cloud: {error}");
        }
        self.failed = outcome.is_err();
    }
}
