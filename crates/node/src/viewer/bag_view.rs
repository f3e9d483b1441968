//! The live page of a bag that is played: its frames, and the predictions recorded with them.

use std::{collections::BTreeMap, fmt::Display, sync::Arc};

use super::{ControlPanel, Hub, LivePage, PageInfo, PredictionInfo, StatusJoiner, ViewerError};
use crate::player::{PendingCommand, PlayerHandle};
use eddy_bag::{BagMessage, BagReader};
use eddy_frames::{
    Frame, FrameView,
    tool::{self, Tools},
};
use eddy_inference::checkpoint::Description;
use eddy_messages::{
    BadTool, FrameCdr, Message, ParticleFrame, PredictionStatus, ToolDescription, ToolFrame, cdr,
    tool_topics,
};
use eddy_transport::ListenAddress;

/// Topics of predictions end in this.
const PREDICTION: &str = "prediction";

/// The page while it is served.
pub struct BagView {
    page: LivePage,
    player: Arc<PlayerHandle>,
    /// The topic shown as truth: the first with frames that are not predictions.
    truth: Option<Arc<str>>,
    /// By status topic: its statuses with the predictions beside it.
    joiners: BTreeMap<String, StatusJoiner>,
    /// Whether a message that is not shown was logged.
    has_warned: bool,
}

impl BagView {
    /// Serves a page for `bag`. Baselines use gravity and walls of `model`.
    ///
    /// # Errors
    /// [`ViewerError`] when the address cannot be listened on.
    pub fn serve(
        address: ListenAddress,
        bag: &BagReader,
        model: &Description,
    ) -> Result<Self, ViewerError> {
        let player = Arc::new(PlayerHandle::default());
        let title = bag.path().display().to_string();
        let info = PageInfo { command: "replay", title, model: None };
        let panel = ControlPanel::of_player(Arc::clone(&player));
        let page = LivePage::serve(address, model, info, panel)?;
        let of_type = |type_name: &'static str| {
            bag.topics().iter().filter(move |topic| topic.type_name == type_name)
        };
        let mut frames = of_type(ParticleFrame::TYPE).map(|topic| topic.name.as_str());
        let truth = frames.find(|name| !name.ends_with(PREDICTION)).map(Into::into);
        let joiner = |name: &String| (name.clone(), StatusJoiner::default());
        let joiners = of_type(PredictionStatus::TYPE).map(|topic| joiner(&topic.name)).collect();
        Ok(Self { page, player, truth, joiners, has_warned: false })
    }

    /// The page.
    pub fn page(&self) -> &LivePage {
        &self.page
    }

    /// Shows a message if it is a frame, the status of a prediction, or of tools.
    pub fn show(&mut self, message: &BagMessage) {
        if [ToolDescription::TYPE, ToolFrame::TYPE].contains(&&*message.type_name) {
            // Kept for browsers that come later.
            return self.show_tools(message);
        }
        if !self.page.hub().is_watched() {
            self.joiners.values_mut().for_each(StatusJoiner::clear);
            return;
        }
        let (topic, kind) = (&*message.topic, &*message.type_name);
        if kind == ParticleFrame::TYPE {
            let frame = match Frame::from_cdr(&message.data) {
                Ok(frame) => frame,
                Err(reason) => return self.warn(message, &reason),
            };
            if topic.ends_with(PREDICTION) {
                match self.joiners.get_mut(&format!("{topic}/status")) {
                    Some(joiner) => {
                        let joined = joiner.prediction(frame);
                        self.show_prediction(joined);
                    }
                    None => self.show_prediction(Some((frame, PredictionInfo::default()))),
                }
            } else if self.truth.as_deref() == Some(topic) {
                self.page.hub().observed(&FrameView::from(&frame));
            }
        } else if kind == PredictionStatus::TYPE {
            let Ok(status) = cdr::decode::<PredictionStatus>(&message.data) else { return };
            let joined = self.joiners.get_mut(topic).and_then(|joiner| joiner.status(status));
            self.show_prediction(joined);
        }
    }

    /// Shows a message of tools that belong to the truth, if it is valid.
    fn show_tools(&mut self, message: &BagMessage) {
        let Some(truth) = self.truth.as_deref() else { return };
        let (hub, [poses, description]) = (self.page.hub(), tool_topics(truth));
        let data = &message.data;
        let shown = match &*message.topic {
            topic if topic == description => read_description(data).map(|it| hub.describes(it)),
            topic if topic == poses => read_frame(data, hub).map(|frame| {
                frame.into_iter().for_each(|frame| hub.moved(frame));
            }),
            _ => Ok(()),
        };
        if let Err(reason) = shown {
            self.warn(message, &reason);
        }
    }

    /// Logs the first message that is not shown.
    fn warn(&mut self, message: &BagMessage, reason: &dyn Display) {
        if !std::mem::replace(&mut self.has_warned, true) {
            let (topic, number) = (&message.topic, message.sequence);
            tracing::warn!("topic {topic}: message {number} is not shown: {reason}");
        }
    }

    fn show_prediction(&self, joined: Option<(Frame, PredictionInfo)>) {
        if let Some((frame, info)) = joined {
            self.page.hub().predicted(&frame, info);
        }
    }

    /// The commands since the last call.
    pub fn commands(&self) -> impl Iterator<Item = PendingCommand> {
        std::iter::from_fn(|| self.player.next())
    }
}

fn read_description(data: &[u8]) -> Result<Tools, BadTool> {
    Ok(cdr::decode::<ToolDescription>(data)?.checked()?)
}

/// The poses of tools that the page knows.
fn read_frame(data: &[u8], hub: &Hub) -> Result<Option<tool::ToolFrame>, BadTool> {
    let frame = cdr::decode::<ToolFrame>(data)?;
    Ok(hub.tools(frame.stream).map(|tools| frame.checked(&tools)).transpose()?)
}

impl Drop for BagView {
    fn drop(&mut self) {
        // Before the page, whose controls wait for pending responses when dropped.
        self.player.close();
    }
}
