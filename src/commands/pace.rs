//! A simulation at the pace of its stamps, or as somebody wants it.

use std::{thread, time::Duration};

use eddy_frames::{Frame, clock::Clock};
use eddy_mpm::Simulation;
use eddy_node::{Outcome, Remote, Timeline, Wish};

/// Longest sleep, so that a signal or a wish is soon obeyed.
const NAP: Duration = Duration::from_millis(20);

/// How fast simulated time runs, and who may change that.
pub(super) struct Pace<'a> {
    clock: Clock,
    timeline: Timeline,
    remote: Option<&'a Remote>,
}

impl<'a> Pace<'a> {
    /// So many times as fast as real time.
    pub(super) fn steady(rate: f64) -> Self {
        Self { clock: Clock::start(), timeline: Timeline::new(rate), remote: None }
    }

    /// In real time, until `remote` asks for something else.
    pub(super) fn driven(remote: &'a Remote) -> Self {
        Self { remote: Some(remote), ..Self::steady(1.0) }
    }

    /// Hands every frame to `publish` when it is due, or as soon after that as the machine can. Ends with the
    /// scene, or when `stop` says so: `false` then. A pace that pauses stays paused for the next scene.
    pub(super) fn run(
        &mut self,
        simulation: &mut Simulation,
        stop: impl Fn() -> bool,
        mut publish: impl FnMut(&Frame, &Simulation) -> anyhow::Result<()>,
    ) -> anyhow::Result<bool> {
        self.timeline.jump(0.0, self.clock.now());
        while let Some(frame) = simulation.next_frame()? {
            let position = frame.stamp.0 as f64;
            while !stop() && !self.answer(position) {
                // Nothing positive is left of what is due; a pause has no end of its own.
                match self.timeline.until(position, self.clock.now()) {
                    Some(wait) if wait <= 0.0 => break,
                    Some(wait) => thread::sleep(Duration::from_nanos(wait as u64).min(NAP)),
                    None => thread::sleep(NAP),
                }
            }
            if stop() {
                return Ok(false);
            }
            publish(&frame, simulation)?;
        }
        Ok(true)
    }

    /// Answers what is asked for. Returns whether the frame at `position` (simulated ns) is wanted at once.
    fn answer(&mut self, position: f64) -> bool {
        let Self { clock, timeline, remote } = self;
        while let Some(asked) = remote.and_then(Remote::next) {
            let Some((wish, reply)) = asked.begin() else { continue };
            let now = clock.now();
            let done = match wish {
                Wish::Look => true,
                Wish::TogglePause => timeline.set_paused(!timeline.is_paused(), now),
                Wish::Pause => timeline.set_paused(true, now),
                Wish::Resume => timeline.set_paused(false, now),
                Wish::Rate(rate) => timeline.set_rate(rate, now),
                Wish::Next => {
                    timeline.jump(position, now);
                    true
                }
                // A simulation knows no way back, and no way on but its own; the keys of a player are not asked.
                Wish::Seek(_) | Wish::Skip(_) | Wish::Faster | Wish::Slower => false,
            };
            reply.send(Outcome { done, rate: timeline.rate(), paused: timeline.is_paused() });
            if wish == Wish::Next {
                return true;
            }
        }
        false
    }
}
