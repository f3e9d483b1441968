//! Frames as point clouds, for whoever looks at them.

use eddy_frames::FrameView;
use eddy_messages::cloud;
use eddy_transport::Publisher;

/// A topic of clouds. Nothing is encoded while nobody subscribes, as far as the transport can tell.
pub struct CloudTopic {
    publisher: Box<dyn Publisher>,
    /// Whether the last one could not be sent: said once, not with every frame.
    failed: bool,
}

impl CloudTopic {
    /// Publishes through `publisher`.
    pub fn new(publisher: Box<dyn Publisher>) -> Self {
        Self { publisher, failed: false }
    }

    /// Publishes the frame if somebody wants it, and it is one.
    pub fn show(&mut self, frame: &FrameView<'_>) {
        if self.publisher.subscribers() == 0 || frame.check().is_err() {
            return;
        }
        let outcome = self.publisher.publish_cdr(&cloud::to_cdr(&frame.to_frame()));
        if let (Err(error), false) = (&outcome, self.failed) {
            tracing::warn!("cloud: {error}");
        }
        self.failed = outcome.is_err();
    }
}
