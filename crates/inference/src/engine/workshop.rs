//! Threads, and room for what they hand on to each other: for one stream at a time, or for several at once.
//!
//! Threads that share a frame wait for each other at every stage. Where several streams have a frame
//! waiting, each thread takes one and nobody waits: more frames a second, each of them later.
#![expect(unsafe_code, reason = "threads write to disjoint parts of one slice")]

use super::{
    Memory, Surrogate,
    crew::{Crew, Parts, Task},
    frame_model::{self, FrameModel},
    particle_model::{self, ParticleModel},
};
use crate::checkpoint::Core;
use eddy_frames::{Frame, FrameView};

/// Multiplications of a frame for which the other threads are woken: some ten microseconds.
const WORTH_WAKING: usize = 1 << 18;

#[expect(clippy::large_enum_variant, reason = "there is one a surrogate")]
pub(super) enum Network {
    Frame(FrameModel),
    Particle(ParticleModel),
}

/// Room for frames under way.
pub(super) struct Workshop {
    together: Team,
    /// One for each thread, where each works alone; empty where there is only one.
    alone: Vec<Team>,
}

/// Threads with room for one frame under way.
struct Team {
    crew: Crew,
    room: Room,
}

enum Room {
    Frame(Box<frame_model::Room>),
    Particle(Box<particle_model::Room>),
}

/// Steps one stream at a time: by all threads, or by the one that has it.
pub struct Stepper<'a> {
    surrogate: &'a Surrogate,
    team: &'a mut Team,
}

impl Workshop {
    pub(super) fn new(network: &Network, core: Core, threads: usize) -> Self {
        let together = Team::new(network, core, threads);
        let several = Some(together.crew.threads()).filter(|&threads| threads > 1);
        let alone = (0..several.unwrap_or(0)).map(|_| Team::new(network, core, 1));
        Self { alone: alone.collect(), together }
    }

    pub(super) fn threads(&self) -> usize {
        self.together.crew.threads()
    }

    /// All threads on one stream.
    pub(super) fn together<'a>(&'a mut self, surrogate: &'a Surrogate) -> Stepper<'a> {
        Stepper { surrogate, team: &mut self.together }
    }

    /// See [`Surrogate::each`].
    pub(super) fn each<T: Send + Sync>(
        &mut self,
        surrogate: &Surrogate,
        items: &mut [T],
        work: impl Fn(&mut Stepper<'_>, &mut T) + Sync,
    ) {
        if items.len() < 2 || self.alone.is_empty() {
            let mut stepper = self.together(surrogate);
            items.iter_mut().for_each(|item| work(&mut stepper, item));
            return;
        }
        let (count, items, teams) = (items.len(), Parts::new(items), Parts::new(&mut self.alone));
        self.together.crew.run([count], false, &|Task { item, thread, .. }| {
            // SAFETY: an item is done once, and no other one has this thread's number meanwhile.
            let (item, team) = unsafe {
                (&mut items.part(item..item + 1)[0], &mut teams.part(thread..thread + 1)[0])
            };
            work(&mut Stepper { surrogate, team }, item);
        });
    }
}

impl Team {
    fn new(network: &Network, core: Core, threads: usize) -> Self {
        match network {
            Network::Frame(model) => {
                let crew = Crew::new(threads, model.stages());
                let room = Room::Frame(Box::new(model.room(crew.threads(), core)));
                Self { crew, room }
            }
            Network::Particle(model) => {
                let crew = Crew::new(threads, model.stages.len());
                let room = Room::Particle(Box::new(model.room(crew.threads())));
                Self { crew, room }
            }
        }
    }
}

impl Stepper<'_> {
    /// As [`Surrogate::step_into`].
    ///
    /// # Panics
    /// As [`Surrogate::step_into`].
    pub fn step_into<'a>(
        &mut self,
        memory: &mut Memory,
        frame: impl Into<FrameView<'a>>,
        next: &mut Frame,
    ) {
        let frame = frame.into();
        let particles = memory.particles();
        self.surrogate.begin(particles, &frame, next);
        let Team { crew, room } = &mut *self.team;
        match (self.surrogate.network(), room) {
            (Network::Frame(model), Room::Frame(room)) => {
                let alone = model.work() < WORTH_WAKING;
                model.step(crew, alone, room, memory, frame, next);
            }
            (Network::Particle(model), Room::Particle(room)) => {
                let alone = particles.saturating_mul(model.work()) < WORTH_WAKING;
                model.step(crew, alone, room, memory, frame, next);
            }
            _ => unreachable!("a network and its room are made together"),
        }
    }
}
