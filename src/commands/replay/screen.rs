//! What the live page shows of a bag that is played: frames, and the predictions that were recorded with them.

use std::sync::Arc;

use anyhow::Context;

use crate::commands::page::{Desk, Page};
use eddy::{
    bag::{BagMessage, BagReader},
    checkpoint::Checkpoint,
    frame::{Frame, FrameView, Stamp},
    msg::{Message, ParticleFrame, PredictionStatus, StreamState, cdr},
    node::{Asked, Remote},
    viewer::{Ahead, ListenAddress, Program},
};

/// What the name of a topic with predictions ends in.
const PREDICTION: &str = "prediction";

/// The page, as long as it plays.
pub(super) struct Screen {
    page: Page,
    remote: Arc<Remote>,
    /// The topic whose frames are the truth: the first one that has frames and no predictions.
    truth: Option<Arc<str>>,
    /// A prediction whose status has not been played yet.
    unexplained: Option<Frame>,
}

impl Screen {
    pub(super) fn open(address: ListenAddress, bag: &BagReader) -> anyhow::Result<Self> {
        // Gravity and walls of the baselines, beside which recorded predictions are shown.
        let model = Checkpoint::shipped().context("the shipped checkpoint")?;
        let remote = Arc::new(Remote::default());
        let title = bag.path().display().to_string();
        let program = Program { command: "replay", title, model: None };
        let desk = Desk::of_player(Arc::clone(&remote));
        let page = Page::serve(address, &model.description, program, desk).context("--view")?;
        page.announce();
        let truths = bag.topics().iter().filter(|topic| topic.type_name == ParticleFrame::TYPE);
        let truth =
            truths.map(|topic| topic.name.as_str()).find(|name| !name.ends_with(PREDICTION));
        Ok(Self { page, remote, truth: truth.map(Into::into), unexplained: None })
    }

    /// Shows a message, if it is a frame or says how one was predicted.
    pub(super) fn show(&mut self, message: &BagMessage) {
        if !self.page.hub.is_watched() {
            self.unexplained = None;
            return;
        }
        let (topic, kind) = (&*message.topic, &*message.type_name);
        if kind == ParticleFrame::TYPE {
            let Ok(frame) = Frame::from_cdr(&message.data) else { return };
            if topic.ends_with(PREDICTION) {
                if let Some(before) = self.unexplained.replace(frame) {
                    // Nobody has said how it was predicted.
                    self.predicted(&before, Ahead { source: 0, frames: 0, free: false });
                }
            } else if self.truth.as_deref() == Some(topic) {
                self.page.hub.observed(&FrameView::from(&frame));
            }
        } else if kind == PredictionStatus::TYPE {
            let Ok(status) = cdr::decode::<PredictionStatus>(&message.data) else { return };
            let stamp = Stamp::from(status.header.stamp);
            let explained =
                |frame: &mut Frame| frame.stream == status.stream && frame.stamp == stamp;
            let Some(frame) = self.unexplained.take_if(explained) else { return };
            let ahead = Ahead {
                source: status.source_sequence,
                frames: status.horizon,
                free: status.state == StreamState::FreeRunning as u8,
            };
            self.predicted(&frame, ahead);
        }
    }

    fn predicted(&self, frame: &Frame, ahead: Ahead) {
        self.page.hub.predicted(frame, ahead);
    }

    /// What was asked for since the last look.
    pub(super) fn wishes(&self) -> Vec<Asked> {
        std::iter::from_fn(|| self.remote.next()).collect()
    }
}

impl Drop for Screen {
    fn drop(&mut self) {
        // Before the page, whose controls wait for the answers that are still owed.
        self.remote.close();
    }
}
