//! What the live page shows of a bag that is played: frames, and the predictions that were recorded with them.

use std::{collections::BTreeMap, sync::Arc};

use anyhow::Context;

use crate::commands::page::{Desk, Page};
use eddy_bag::{BagMessage, BagReader};
use eddy_frames::{Frame, FrameView};
use eddy_inference::checkpoint::Checkpoint;
use eddy_messages::{FrameCdr, Message, ParticleFrame, PredictionStatus, cdr};
use eddy_node::{
    Asked, Remote,
    viewer::{Ahead, Explained, Program},
};
use eddy_transport::ListenAddress;

/// What the name of a topic with predictions ends in.
const PREDICTION: &str = "prediction";

/// The page, as long as it plays.
pub(super) struct Screen {
    page: Page,
    remote: Arc<Remote>,
    /// The topic whose frames are the truth: the first one that has frames and no predictions.
    truth: Option<Arc<str>>,
    /// By topic of statuses, those of the predictions beside it.
    explained: BTreeMap<String, Explained>,
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
        let statuses =
            bag.topics().iter().filter(|topic| topic.type_name == PredictionStatus::TYPE);
        let explained = statuses.map(|topic| (topic.name.clone(), Explained::default())).collect();
        Ok(Self { page, remote, truth: truth.map(Into::into), explained })
    }

    /// Shows a message, if it is a frame or says how one was predicted.
    pub(super) fn show(&mut self, message: &BagMessage) {
        if !self.page.hub.is_watched() {
            self.explained.values_mut().for_each(Explained::clear);
            return;
        }
        let (topic, kind) = (&*message.topic, &*message.type_name);
        if kind == ParticleFrame::TYPE {
            let Ok(frame) = Frame::from_cdr(&message.data) else { return };
            if topic.ends_with(PREDICTION) {
                match self.explained.get_mut(&format!("{topic}/status")) {
                    Some(explained) => {
                        let joined = explained.prediction(frame);
                        self.predicted(joined);
                    }
                    None => {
                        let unknown = Ahead { source: 0, frames: 0, free: false };
                        self.predicted(Some((frame, unknown)));
                    }
                }
            } else if self.truth.as_deref() == Some(topic) {
                self.page.hub.observed(&FrameView::from(&frame));
            }
        } else if kind == PredictionStatus::TYPE {
            let Ok(status) = cdr::decode::<PredictionStatus>(&message.data) else { return };
            let joined = self.explained.get_mut(topic).and_then(|joined| joined.status(status));
            self.predicted(joined);
        }
    }

    fn predicted(&self, joined: Option<(Frame, Ahead)>) {
        if let Some((frame, ahead)) = joined {
            self.page.hub.predicted(&frame, ahead);
        }
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
