//! What the demo simulates, scene after scene, and where the truth goes.

use std::sync::Arc;

use super::SCENE;
use crate::commands::pace::Pace;
use eddy_frames::{Frame, Stamp};
use eddy_messages::{self as msg, cdr};
use eddy_mpm::{self as mpm, Preset, Scene, Simulation};
use eddy_node::viewer::Hub;
use eddy_transport::Publisher;

/// What is simulated, scene after scene.
pub(super) struct Scenes {
    pub(super) seed: u64,
    /// Length of each (simulated s).
    pub(super) seconds: f64,
    pub(super) endless: bool,
}

impl Scenes {
    /// The scene of this number; each is a stream of its own.
    pub(super) fn simulation(&self, number: u64) -> anyhow::Result<Simulation> {
        let seed = self.seed.wrapping_add(number);
        let scene = Scene::generate(Preset::MultiMaterial, seed, SCENE);
        let scene = Scene { id: SCENE + number, ..scene };
        let settings = mpm::Settings { duration: Some(self.seconds), ..mpm::Settings::default() };
        Ok(Simulation::new(scene, &settings)?)
    }

    /// Plays one after the other. Returns whether the first was whole.
    pub(super) fn play(
        &mut self,
        first: Simulation,
        pace: &mut Pace<'_>,
        ends: impl Fn() -> bool,
        source: &mut Source,
    ) -> anyhow::Result<bool> {
        let mut simulation = first;
        for number in 1.. {
            let whole = pace.run(&mut simulation, &ends, |frame, _| source.publish(frame))?;
            if !whole || !self.endless {
                return Ok(whole || number > 1);
            }
            source.next_scene(SCENE + number - 1);
            simulation = self.simulation(number)?;
        }
        Ok(true)
    }
}

/// Where the truth goes, with the time.
pub(super) struct Source {
    pub(super) truth: Box<dyn Publisher>,
    pub(super) clock: Box<dyn Publisher>,
    /// When the scene began, and how far it is: time goes on from scene to scene.
    pub(super) began: Stamp,
    pub(super) now: Stamp,
    /// What the page shows.
    pub(super) hub: Option<Arc<Hub>>,
}

impl Source {
    fn publish(&mut self, frame: &Frame) -> anyhow::Result<()> {
        self.truth.publish_frame(frame)?;
        self.now = Stamp(self.began.0 + frame.stamp.0);
        Ok(self.clock.publish_cdr(&cdr::encode(&msg::Clock { clock: self.now.into() }))?)
    }

    /// The stream of the scene before has `ended`.
    fn next_scene(&mut self, ended: u64) {
        self.began = self.now;
        if let Some(hub) = &self.hub {
            hub.ended(ended);
        }
    }
}
