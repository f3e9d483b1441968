//! The live page of a node, a player or both.

use std::{sync::Arc, time::Duration};

use super::{
    Comparison, ControlState, Controls, Hub, NodeStatus, PageCommand, PageInfo, PredictionInfo,
    ToolTarget, Viewer, ViewerError,
};
use crate::{
    CommandOutcome, NodeHandle, NodeReport, NodeRequest, NodeResponse, NodeSettings, Observer,
    PlayerCommand, PlayerHandle, Prediction, Publish,
};
use eddy_frames::FrameView;
use eddy_inference::checkpoint::Description;
use eddy_messages::{
    StreamState,
    services::{Parameter, ParameterValue},
};
use eddy_transport::ListenAddress;

/// Time for a node or player to accept a command.
const TIMEOUT: Duration = Duration::from_secs(5);
/// The same for a query of its state.
const STATE_TIMEOUT: Duration = Duration::from_millis(500);

/// A live page while it is served.
pub struct LivePage {
    hub: Arc<Hub>,
    viewer: Viewer,
}

impl LivePage {
    /// Serves a page. Baselines use gravity and walls of `model`.
    ///
    /// # Errors
    /// [`ViewerError`] when the address cannot be listened on.
    pub fn serve(
        address: ListenAddress,
        model: &Description,
        info: PageInfo,
        panel: ControlPanel,
    ) -> Result<Self, ViewerError> {
        let hub = Arc::new(Hub::default());
        let comparison = Comparison::new(model);
        let viewer = Viewer::start(address, Arc::clone(&hub), comparison, info, Arc::new(panel))?;
        Ok(Self { hub, viewer })
    }

    /// The hub that passes frames to the page.
    pub fn hub(&self) -> &Arc<Hub> {
        &self.hub
    }

    /// The URL, with a warning if other machines can reach it. It then contains the token that commands need.
    pub fn announcement(&self) -> String {
        let is_local = self.viewer.address().ip().is_loopback();
        let warning = if is_local {
            ""
        } else {
            " (anyone who can reach this address can watch; anyone with this URL can also control)"
        };
        format!("{}{warning}", self.viewer.url())
    }

    /// Shows the output of a node.
    pub fn observer(&self) -> Box<dyn Observer> {
        Box::new(HubObserver(Arc::clone(&self.hub)))
    }
}

struct HubObserver(Arc<Hub>);

impl Observer for HubObserver {
    fn observed(&mut self, frame: &FrameView<'_>) {
        self.0.observed(frame);
    }

    fn predicted(&mut self, prediction: &Prediction<'_>) {
        let info = PredictionInfo {
            source: prediction.source_sequence,
            horizon: prediction.horizon,
            free_running: prediction.state == StreamState::FreeRunning,
        };
        self.0.predicted(prediction.frame, info);
    }

    fn reported(&mut self, report: &NodeReport<'_>) {
        let &NodeReport { rates, counters, streams, rejected, warnings } = report;
        self.0.report(NodeStatus {
            rate: rates.rate,
            latency: [rates.latency_p50, rates.latency_p99],
            streams,
            lost: counters.frames_lost(),
            group: counters.group,
            counters: counters.named().to_vec(),
            rejected: rejected.map(str::to_owned),
            warnings: warnings.to_vec(),
        });
    }
}

/// The controls of a node and its simulation; the first is that of its tool.
const OF_BOTH: [&str; 8] =
    ["tool", "pause", "step", "rate", "reset", "horizon", "publish_all", "free_run"];

/// The controls of a page: of a node, of its source, or of both.
pub struct ControlPanel {
    node: Option<Arc<NodeHandle>>,
    source: Option<Arc<PlayerHandle>>,
    tool: Option<Arc<ToolTarget>>,
    available: &'static [&'static str],
}

impl ControlPanel {
    /// A node whose source is another process.
    pub fn of_node(node: Arc<NodeHandle>) -> Self {
        let available = &["reset", "horizon", "publish_all", "free_run"];
        Self { node: Some(node), source: None, tool: None, available }
    }

    /// A bag player.
    pub fn of_player(source: Arc<PlayerHandle>) -> Self {
        let available = &["pause", "step", "rate", "skip"];
        Self { node: None, source: Some(source), tool: None, available }
    }

    /// A node and the simulation that it observes.
    pub fn of_both(node: Arc<NodeHandle>, source: Arc<PlayerHandle>) -> Self {
        Self { node: Some(node), source: Some(source), tool: None, available: &OF_BOTH[1..] }
    }

    /// The same with a tool of the simulation that follows the pointer.
    pub fn of_both_and_tool(
        node: Arc<NodeHandle>,
        source: Arc<PlayerHandle>,
        tool: Arc<ToolTarget>,
    ) -> Self {
        Self { tool: Some(tool), available: &OF_BOTH, ..Self::of_both(node, source) }
    }

    fn request(&self, request: NodeRequest, timeout: Duration) -> Result<NodeResponse, String> {
        let node = self.node.as_ref().ok_or("there is no node here")?;
        node.request(request, timeout).map_err(|error| error.to_string())
    }

    fn set(&self, name: &str, value: ParameterValue) -> Result<String, String> {
        let parameter = Parameter { name: name.to_owned(), value };
        self.request(NodeRequest::Set(vec![parameter]), TIMEOUT).map(|_| String::new())
    }

    fn move_tool(&self, position: [f32; 2]) -> Result<String, String> {
        let tool = self.tool.as_ref().ok_or("there is no tool here")?;
        if !position.iter().all(|x| x.is_finite()) {
            return Err(format!("position: found {position:?}, expected two finite numbers"));
        }
        tool.set(position);
        Ok(String::new())
    }

    fn reset(&self) -> Result<String, String> {
        match self.request(NodeRequest::Reset, TIMEOUT)? {
            NodeResponse::Reset(1) => Ok("Reset 1 stream".to_owned()),
            NodeResponse::Reset(streams) => Ok(format!("Reset {streams} streams")),
            _ => Ok(String::new()),
        }
    }

    fn call(&self, command: PlayerCommand, timeout: Duration) -> Result<CommandOutcome, String> {
        let source = self.source.as_ref().ok_or("the source is another program")?;
        source.call(command, timeout).ok_or_else(|| "the source did not answer".to_owned())
    }

    fn control(&self, command: PlayerCommand) -> Result<String, String> {
        match self.call(command, TIMEOUT)? {
            CommandOutcome { done: true, .. } => Ok(String::new()),
            _ => Err("not possible now".to_owned()),
        }
    }
}

impl Controls for ControlPanel {
    fn available(&self) -> &'static [&'static str] {
        self.available
    }

    fn execute(&self, command: PageCommand) -> Result<String, String> {
        match command {
            PageCommand::Pause => self.control(PlayerCommand::Pause),
            PageCommand::Resume => self.control(PlayerCommand::Resume),
            PageCommand::Step => self.control(PlayerCommand::Next),
            PageCommand::Rate { rate } => self.control(PlayerCommand::Rate(rate)),
            PageCommand::Skip { seconds } => self.control(PlayerCommand::Skip(seconds)),
            PageCommand::Reset => self.reset(),
            PageCommand::Tool { position } => self.move_tool(position),
            PageCommand::Horizon { frames } => {
                self.set("horizon", ParameterValue::integer(frames.into()))
            }
            PageCommand::PublishAll { on } => {
                let publish = if on { Publish::All } else { Publish::Last };
                self.set("publish", ParameterValue::string(publish.name().to_owned()))
            }
            // A free run begins after the warm-up at the earliest, hence 1.
            PageCommand::FreeRun { on: true } => self.set("free_run", ParameterValue::integer(1)),
            // Streams that are in a free run leave it by a reset only.
            PageCommand::FreeRun { on: false } => {
                self.set("free_run", ParameterValue::integer(0))?;
                self.reset()
            }
        }
    }

    fn state(&self) -> ControlState {
        let mut state = ControlState::default();
        if let Ok(outcome) = self.call(PlayerCommand::Status, STATE_TIMEOUT) {
            (state.paused, state.rate) = (Some(outcome.paused), Some(outcome.rate));
        }
        if let Ok(NodeResponse::Settings(settings)) =
            self.request(NodeRequest::Settings, STATE_TIMEOUT)
        {
            let NodeSettings { horizon, publish, free_run, .. } = settings;
            state.horizon = Some(horizon);
            state.publish_all = Some(publish == Publish::All);
            state.free_run = Some(free_run.is_some());
        }
        state
    }
}

#[cfg(test)]
mod tests {
    use std::{sync::atomic::AtomicBool, thread};

    use super::*;

    #[test]
    fn a_tool_is_moved_where_there_is_one() {
        let (node, source) = (Arc::default(), Arc::default());
        let there = PageCommand::Tool { position: [0.25, 0.5] };
        let without = ControlPanel::of_both(Arc::clone(&node), Arc::clone(&source));
        assert_eq!(without.execute(there), Err("there is no tool here".to_owned()));
        assert!(!without.available().contains(&"tool"));
        let tool = Arc::new(ToolTarget::default());
        let panel = ControlPanel::of_both_and_tool(node, source, Arc::clone(&tool));
        assert!(panel.available().contains(&"tool"));
        assert_eq!(tool.position(), None);
        assert_eq!(panel.execute(there), Ok(String::new()));
        let nowhere = PageCommand::Tool { position: [f32::INFINITY, 0.5] };
        assert!(panel.execute(nowhere).unwrap_err().contains("expected two finite numbers"));
        assert_eq!(tool.position(), Some([0.25, 0.5]));
    }

    #[test]
    fn commands_reach_the_player_and_its_state_is_shown() {
        let player = Arc::new(PlayerHandle::default());
        let panel = ControlPanel::of_player(Arc::clone(&player));
        let stop = AtomicBool::new(false);
        thread::scope(|scope| {
            scope.spawn(|| {
                while !stop.load(std::sync::atomic::Ordering::Relaxed) {
                    let Some(pending) = player.next() else { continue };
                    let Some((command, responder)) = pending.accept() else { continue };
                    let done = command != PlayerCommand::Skip(5.0);
                    responder.send(CommandOutcome { done, rate: 2.0, paused: true });
                }
            });
            assert_eq!(panel.execute(PageCommand::Pause), Ok(String::new()));
            let skip = panel.execute(PageCommand::Skip { seconds: 5.0 });
            assert_eq!(skip, Err("not possible now".to_owned()));
            assert_eq!(panel.execute(PageCommand::Reset), Err("there is no node here".to_owned()));
            let expected =
                ControlState { paused: Some(true), rate: Some(2.0), ..ControlState::default() };
            assert_eq!(panel.state(), expected);
            stop.store(true, std::sync::atomic::Ordering::Relaxed);
        });
    }
}
