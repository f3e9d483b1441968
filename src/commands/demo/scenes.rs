//! The scenes of the demo, and where their frames are published.

use std::sync::Arc;

use super::SCENE;
use eddy_frames::{Frame, Stamp};
use eddy_messages::{self as msg, cdr};
use eddy_mpm::{self as mpm, Preset, Scene, Simulation};
use eddy_node::{Pacer, viewer::Hub};
use eddy_transport::Publisher;

pub(super) struct Scenes {
    pub(super) seed: u64,
    /// Duration of each scene (simulated s).
    pub(super) seconds: f64,
    pub(super) endless: bool,
}

impl Scenes {
    /// The scene of this number, a stream of its own.
    pub(super) fn simulation(&self, number: u64) -> anyhow::Result<Simulation> {
        let seed = self.seed.wrapping_add(number);
        let scene = Scene::generate(Preset::MultiMaterial, seed, SCENE);
        let scene = Scene { id: SCENE + number, ..scene };
        let settings = mpm::Settings { duration: Some(self.seconds), ..mpm::Settings::default() };
        Ok(Simulation::new(scene, &settings)?)
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
            let next = |simulation: &mut Simulation| Ok(simulation.next_frame()?);
            let publish = |frame: &Frame, _: &Simulation| source.publish(frame);
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
    /// The live page.
    pub(super) hub: Option<Arc<Hub>>,
}

impl Source {
    fn publish(&mut self, frame: &Frame) -> anyhow::Result<()> {
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
