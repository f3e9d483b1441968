//! The scenes of the demo, and where their frames are published.

use std::{
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    thread,
    time::Duration,
};

use super::{SCENE, push};
use eddy_frames::{Frame, FrameView, Material, Stamp};
use eddy_messages::{self as msg, cdr};
use eddy_mpm::{self as mpm, Preset, Scene, Simulation};
use eddy_node::{
    NodeReport, Observer, Pacer, Prediction,
    tools::ToolTopics,
    viewer::{Hub, ToolTarget},
};
use eddy_transport::Publisher;

/// Frames that the simulation may be ahead of the node. Where a prediction takes longer than a frame lasts, time passes more slowly,
/// and predictions still come before what they predict.
const LEAD: u64 = 4;
/// Between two looks at how far the node has come.
const NAP: Duration = Duration::from_millis(1);
/// Most looks: a page may have paused the node.
const PATIENCE: u32 = 1000;

/// Counts the frames that the node has worked on.
#[derive(Clone, Default)]
pub(super) struct Progress(Arc<AtomicU64>);

impl Progress {
    /// Nobody waits for a node that has ended.
    pub(super) fn end(&self) {
        self.0.store(u64::MAX / 2, Ordering::Relaxed);
    }

    /// Waits until fewer than [`LEAD`] of `published` frames are left.
    fn wait(&self, published: u64) {
        let is_late = || published >= self.0.load(Ordering::Relaxed) + LEAD;
        (0..PATIENCE).take_while(|_| is_late()).for_each(|_| thread::sleep(NAP));
    }
}

impl Observer for Progress {
    fn observed(&mut self, _: &FrameView<'_>) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }

    fn predicted(&mut self, _: &Prediction<'_>) {}

    fn reported(&mut self, _: &NodeReport<'_>) {}
}

/// Duration after which a scene ends as soon as it is at rest, if others follow (simulated s).
const SHORTEST: f64 = 2.0;

pub(super) struct Scenes {
    pub(super) seed: u64,
    /// Longest duration of a scene (simulated s).
    pub(super) seconds: f64,
    /// Whether another scene follows at the end of one, or as soon as little moves in it.
    pub(super) endless: bool,
    /// Where the page wants the blade, if there is one.
    pub(super) blade: Option<Arc<ToolTarget>>,
}

/// The name of the scene that a frame belongs to.
pub(super) fn name(frame: &Frame) -> String {
    let materials: Vec<_> =
        Material::ALL.into_iter().filter(|m| frame.material.contains(m)).collect();
    let names: Vec<_> = materials.iter().map(|material| material.name()).collect();
    format!("scene {}: {}", frame.stream.saturating_sub(SCENE) + 1, names.join(" and "))
}

impl Scenes {
    /// The scene of this number, a stream of its own.
    pub(super) fn simulation(&self, number: u64) -> anyhow::Result<Simulation> {
        let mut scene = match self.blade {
            Some(_) => push::scene(self.seed, SCENE + number),
            None => Scene::generate(Preset::MultiMaterial, self.seed, SCENE + number),
        };
        scene.frames.duration = self.seconds;
        // What rests is pushed again.
        let ends_at_rest = self.endless && self.blade.is_none();
        scene.frames.shortest = ends_at_rest.then_some(SHORTEST.min(self.seconds));
        Ok(Simulation::new(scene, &mpm::Settings::default())?)
    }

    /// The next frame; matter that a blade has crushed ends the scene.
    fn next_frame(&self, simulation: &mut Simulation) -> anyhow::Result<Option<Frame>> {
        let Some(target) = &self.blade else { return Ok(simulation.next_frame()?) };
        if simulation.has_begun() {
            push::follow(target, simulation)?;
        }
        match simulation.next_frame() {
            Err(error) if self.endless => {
                tracing::warn!("the scene ends: {error}");
                Ok(None)
            }
            outcome => Ok(outcome?),
        }
    }

    /// Simulates scenes one after the other. Returns whether the first was complete.
    pub(super) fn play(
        &mut self,
        first: Simulation,
        pacer: &mut Pacer<'_>,
        is_stopped: impl Fn() -> bool,
        source: &mut Source,
    ) -> anyhow::Result<bool> {
        let mut simulation = first;
        for number in 1.. {
            source.describe(simulation.scene())?;
            let next = |simulation: &mut Simulation| self.next_frame(simulation);
            let publish = |frame: &Frame, simulation: &Simulation| {
                source.publish_tools(frame, simulation)?;
                source.publish(frame)
            };
            let complete = pacer.run(&mut simulation, next, &is_stopped, publish)?;
            if !complete || !self.endless {
                return Ok(complete || number > 1);
            }
            source.next_scene(SCENE + number - 1);
            simulation = self.simulation(number)?;
        }
        Ok(true)
    }
}

/// Publishes frames and simulated time.
pub(super) struct Source {
    pub(super) truth: Box<dyn Publisher>,
    pub(super) clock: Box<dyn Publisher>,
    /// Simulated time at the start of the scene: it continues from scene to scene.
    pub(super) began: Stamp,
    /// Simulated time of the last frame.
    pub(super) now: Stamp,
    /// How far the node has come, and the number of frames that were published.
    pub(super) progress: Progress,
    pub(super) published: u64,
    /// The live page.
    pub(super) hub: Option<Arc<Hub>>,
    /// The scene whose name it has.
    pub(super) named: Option<u64>,
    /// The tools, if the scenes have some.
    pub(super) tools: Option<ToolTopics>,
}

impl Source {
    /// Says what the tools of the next scene are.
    fn describe(&mut self, scene: &Scene) -> anyhow::Result<()> {
        let (Some(topics), Some(tools)) = (&mut self.tools, scene.tools_of_stream()) else {
            return Ok(());
        };
        if let Some(hub) = &self.hub {
            hub.describes(tools.clone());
        }
        Ok(topics.describe(tools)?)
    }

    /// Says where the tools are at a frame, before it is published.
    fn publish_tools(&mut self, frame: &Frame, simulation: &Simulation) -> anyhow::Result<()> {
        let Some(topics) = &mut self.tools else { return Ok(()) };
        let tools = simulation.tool_frame(frame);
        topics.publish(&tools)?;
        if let Some(hub) = &self.hub {
            hub.moved(tools);
        }
        Ok(())
    }

    fn publish(&mut self, frame: &Frame) -> anyhow::Result<()> {
        if let Some(hub) = self.hub.as_ref().filter(|_| self.named != Some(frame.stream)) {
            hub.begins(frame.stream, name(frame));
            self.named = Some(frame.stream);
        }
        self.progress.wait(self.published);
        self.published += 1;
        self.truth.publish_frame(frame)?;
        self.now = Stamp(self.began.0 + frame.stamp.0);
        Ok(self.clock.publish_cdr(&cdr::encode(&msg::Clock { clock: self.now.into() }))?)
    }

    /// Ends the stream `ended` of the previous scene.
    fn next_scene(&mut self, ended: u64) {
        self.began = self.now;
        if let Some(hub) = &self.hub {
            hub.ended(ended);
        }
    }
}
