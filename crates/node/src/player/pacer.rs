//! A source of frames at the pace of their stamps, with the commands of a player as far as they apply.

use std::{thread, time::Duration};

use super::{CommandOutcome, PlayerCommand, PlayerHandle, Timeline};
use eddy_frames::{Frame, clock::Clock};

/// Longest sleep, so that signals and commands take effect soon.
const MAX_SLEEP: Duration = Duration::from_millis(20);

/// Paces a source of frames.
pub struct Pacer<'a> {
    clock: Clock,
    timeline: Timeline,
    handle: Option<&'a PlayerHandle>,
}

impl<'a> Pacer<'a> {
    /// At a constant rate (simulated time per real time).
    pub fn steady(rate: f64) -> Self {
        Self { clock: Clock::start(), timeline: Timeline::new(rate), handle: None }
    }

    /// In real time, changed by commands.
    pub fn controlled(handle: &'a PlayerHandle) -> Self {
        Self { handle: Some(handle), ..Self::steady(1.0) }
    }

    /// Passes each frame of `source` to `publish` when it is due, or as soon as the source has it. Returns `true` at the
    /// end of the source and `false` when stopped. A pause lasts across calls.
    ///
    /// # Errors
    /// Those of `next` and `publish`.
    pub fn run<S, E>(
        &mut self,
        source: &mut S,
        mut next: impl FnMut(&mut S) -> Result<Option<Frame>, E>,
        is_stopped: impl Fn() -> bool,
        mut publish: impl FnMut(&Frame, &S) -> Result<(), E>,
    ) -> Result<bool, E> {
        self.timeline.jump(0.0, self.clock.now());
        while let Some(frame) = next(source)? {
            let position = frame.stamp.0 as f64;
            while !is_stopped() && !self.answer(position) {
                match self.timeline.until(position, self.clock.now()) {
                    Some(wait) if wait <= 0.0 => break,
                    Some(wait) => thread::sleep(Duration::from_nanos(wait as u64).min(MAX_SLEEP)),
                    None => thread::sleep(MAX_SLEEP), // paused
                }
            }
            if is_stopped() {
                return Ok(false);
            }
            publish(&frame, source)?;
        }
        Ok(true)
    }

    /// Carries out commands. Returns whether the frame at `position` (simulated ns) is to be published at once.
    fn answer(&mut self, position: f64) -> bool {
        let Self { clock, timeline, handle } = self;
        while let Some(pending) = handle.and_then(PlayerHandle::next) {
            let Some((command, responder)) = pending.accept() else { continue };
            let now = clock.now();
            let done = match command {
                PlayerCommand::Status => true,
                PlayerCommand::TogglePause => timeline.set_paused(!timeline.is_paused(), now),
                PlayerCommand::Pause => timeline.set_paused(true, now),
                PlayerCommand::Resume => timeline.set_paused(false, now),
                PlayerCommand::Rate(rate) => timeline.set_rate(rate, now),
                PlayerCommand::Next => {
                    timeline.jump(position, now);
                    true
                }
                // A simulation cannot jump in time, and has no keys.
                PlayerCommand::Seek(_)
                | PlayerCommand::Skip(_)
                | PlayerCommand::Faster
                | PlayerCommand::Slower => false,
            };
            let (rate, paused) = (timeline.rate(), timeline.is_paused());
            responder.send(CommandOutcome { done, rate, paused });
            if command == PlayerCommand::Next {
                return true;
            }
        }
        false
    }
}

#[cfg(test)]
mod tests {
    use std::{cell::Cell, convert::Infallible};

    use super::*;
    use eddy_frames::{Domain, Material, Stamp};

    const LONG: Duration = Duration::from_secs(60);

    /// The next of `count` frames, 10 ms of simulated time apart.
    fn next(count: u64) -> impl FnMut(&mut u64) -> Result<Option<Frame>, Infallible> {
        move |sequence| {
            let frame = Frame {
                stream: 0,
                sequence: *sequence,
                stamp: Stamp(0).advance(0.01, *sequence as u32),
                dt: 0.01,
                domain: Domain::UNIT,
                position: vec![[0.5; 2]],
                velocity: vec![[0.0; 2]],
                material: vec![Material::Snow],
            };
            *sequence += 1;
            Ok((frame.sequence < count).then_some(frame))
        }
    }

    #[test]
    fn frames_are_published_in_order_and_not_before_they_are_due() {
        let (clock, mut published) = (Clock::start(), Vec::new());
        let publish = |frame: &Frame, _: &u64| {
            assert!(clock.now().as_nanos() as f64 * 2.0 >= frame.stamp.0 as f64);
            published.push(frame.sequence);
            Ok(())
        };
        assert_eq!(Pacer::steady(2.0).run(&mut 0, next(4), || false, publish), Ok(true));
        assert_eq!(published, [0, 1, 2, 3]);
    }

    #[test]
    fn a_paused_source_publishes_one_frame_per_command_and_ends_when_stopped() {
        let (handle, published) = (PlayerHandle::default(), Cell::new(0));
        thread::scope(|scope| {
            let commands = scope.spawn(|| {
                let call = |command| handle.call(command, LONG).unwrap();
                assert!(call(PlayerCommand::Pause).paused);
                assert!(!call(PlayerCommand::Skip(1.0)).done, "a simulation cannot skip");
                (0..2).for_each(|_| assert!(call(PlayerCommand::Next).done));
                assert_eq!(call(PlayerCommand::Rate(0.5)).rate, 0.5);
            });
            let publish = |_: &Frame, _: &u64| {
                published.set(published.get() + 1);
                Ok(())
            };
            let is_stopped = || commands.is_finished();
            let mut pacer = Pacer::controlled(&handle);
            // The pause may come after some of the million frames.
            assert_eq!(pacer.run(&mut 0, next(1_000_000), is_stopped, publish), Ok(false));
            assert!(published.get() >= 2);
        });
    }
}
