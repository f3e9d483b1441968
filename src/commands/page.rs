//! The live page of a command: what it is shown, and what it may ask for.

use std::{
    io::{Write, stdout},
    sync::Arc,
    time::Duration,
};

use eddy_frames::FrameView;
use eddy_inference::checkpoint::Description;
use eddy_messages::{
    StreamState,
    services::{Parameter, ParameterValue},
};
use eddy_node::{
    Answer, Control, Counters, NodeSettings, Onlooker, Outcome, Prediction, Publish, Remote,
    Request, Wish,
    diagnostics::Rates,
    viewer::{
        Ahead, Command, Comparison, Controls, Hub, Program, Report, State, Viewer, ViewerError,
    },
};
use eddy_transport::ListenAddress;

/// How long what is controlled may take to begin with an answer.
const PATIENCE: Duration = Duration::from_secs(5);
/// The same where only a look is wanted.
const GLANCE: Duration = Duration::from_millis(500);

/// A page that is served.
pub(super) struct Page {
    pub(super) hub: Arc<Hub>,
    viewer: Viewer,
}

impl Page {
    /// Serves it. Baselines have the gravity and walls of `model`.
    pub(super) fn serve(
        address: ListenAddress,
        model: &Description,
        program: Program,
        desk: Desk,
    ) -> Result<Self, ViewerError> {
        let hub = Arc::new(Hub::default());
        let comparison = Comparison::new(model);
        let viewer = Viewer::start(address, Arc::clone(&hub), comparison, program, Arc::new(desk))?;
        Ok(Self { hub, viewer })
    }

    /// Says where it is.
    pub(super) fn announce(&self) {
        let beyond = !self.viewer.address().ip().is_loopback();
        let whom =
            if beyond { " (whoever reaches this address can watch and control)" } else { "" };
        println!("page:   {}{whom}", self.viewer.url());
        // Who starts this and waits for the address should not wait for more.
        let _ = stdout().flush();
    }

    /// Shows it what a node does.
    pub(super) fn onlooker(&self) -> Box<dyn Onlooker> {
        Box::new(NodeOnlooker(Arc::clone(&self.hub)))
    }
}

/// Passes on what a node does.
struct NodeOnlooker(Arc<Hub>);

impl Onlooker for NodeOnlooker {
    fn observed(&mut self, frame: &FrameView<'_>) {
        self.0.observed(frame);
    }

    fn predicted(&mut self, prediction: &Prediction<'_>) {
        let ahead = Ahead {
            source: prediction.source_sequence,
            frames: prediction.horizon,
            free: prediction.state == StreamState::FreeRunning,
        };
        self.0.predicted(prediction.frame, ahead);
    }

    fn reported(&mut self, rates: &Rates, counters: &Counters, streams: usize) {
        self.0.report(Report {
            rate: rates.rate,
            latency: [rates.latency_p50, rates.latency_p99],
            streams,
            lost: counters.frames_lost(),
            counters: counters.named().to_vec(),
        });
    }
}

/// What a page may ask for: of a node, of a source, or of both.
pub(super) struct Desk {
    node: Option<Arc<Control>>,
    source: Option<Arc<Remote>>,
    offered: &'static [&'static str],
}

impl Desk {
    /// A node whose source is elsewhere.
    pub(super) fn of_node(node: Arc<Control>) -> Self {
        let offered = &["reset", "horizon", "publish_all", "free_run"];
        Self { node: Some(node), source: None, offered }
    }

    /// A bag that is played.
    pub(super) fn of_player(source: Arc<Remote>) -> Self {
        let offered = &["pause", "step", "rate", "skip"];
        Self { node: None, source: Some(source), offered }
    }

    /// A node and the simulation that it observes.
    pub(super) fn of_both(node: Arc<Control>, source: Arc<Remote>) -> Self {
        let offered = &["pause", "step", "rate", "reset", "horizon", "publish_all", "free_run"];
        Self { node: Some(node), source: Some(source), offered }
    }

    fn ask(&self, request: Request, patience: Duration) -> Result<Answer, String> {
        let node = self.node.as_ref().ok_or("found no node to ask")?;
        node.ask(request, patience).map_err(|reason| reason.to_string())
    }

    fn set(&self, name: &str, value: ParameterValue) -> Result<String, String> {
        let parameter = Parameter { name: name.to_owned(), value };
        self.ask(Request::Set(vec![parameter]), PATIENCE).map(|_| String::new())
    }

    fn reset(&self) -> Result<String, String> {
        match self.ask(Request::Reset, PATIENCE)? {
            Answer::Forgot(1) => Ok("1 stream was forgotten".to_owned()),
            Answer::Forgot(streams) => Ok(format!("{streams} streams were forgotten")),
            _ => Ok(String::new()),
        }
    }

    fn wish(&self, wish: Wish, patience: Duration) -> Result<Outcome, String> {
        let source = self.source.as_ref().ok_or("found no source to ask")?;
        source.ask(wish, patience).ok_or_else(|| "found no answer of the source".to_owned())
    }

    fn have(&self, wish: Wish) -> Result<String, String> {
        match self.wish(wish, PATIENCE)? {
            Outcome { done: true, .. } => Ok(String::new()),
            _ => Err("it cannot be done now".to_owned()),
        }
    }
}

impl Controls for Desk {
    fn offered(&self) -> &'static [&'static str] {
        self.offered
    }

    fn act(&self, command: Command) -> Result<String, String> {
        match command {
            Command::Pause => self.have(Wish::Pause),
            Command::Resume => self.have(Wish::Resume),
            Command::Step => self.have(Wish::Next),
            Command::Rate { rate } => self.have(Wish::Rate(rate)),
            Command::Skip { seconds } => self.have(Wish::Skip(seconds)),
            Command::Reset => self.reset(),
            Command::Horizon { frames } => {
                self.set("horizon", ParameterValue::integer(frames.into()))
            }
            Command::PublishAll { on } => {
                let publish = if on { Publish::All } else { Publish::Last };
                self.set("publish", ParameterValue::string(publish.name().to_owned()))
            }
            // A node waits for its warm-up however few frames it is to observe.
            Command::FreeRun { on: true } => self.set("free_run", ParameterValue::integer(1)),
            // A stream that runs free goes on until it is forgotten.
            Command::FreeRun { on: false } => {
                self.set("free_run", ParameterValue::integer(0))?;
                self.reset()
            }
        }
    }

    fn state(&self) -> State {
        let mut state = State::default();
        if let Ok(Outcome { paused, rate, .. }) = self.wish(Wish::Look, GLANCE) {
            (state.paused, state.rate) = (Some(paused), Some(rate));
        }
        if let Ok(Answer::Settings(settings)) = self.ask(Request::Settings, GLANCE) {
            let NodeSettings { horizon, publish, free_run, .. } = settings;
            state.horizon = Some(horizon);
            state.publish_all = Some(publish == Publish::All);
            state.free_run = Some(free_run.is_some());
        }
        state
    }
}
