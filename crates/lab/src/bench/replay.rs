//! Delay of replayed messages, compared with a loop that only sleeps until each is due.

use std::{path::Path, thread, time::Duration};

use serde::Serialize;

use super::{Spread, particles};
use eddy_bag::{BagError, BagMessage, BagReader, BagWriter, WriterOptions};
use eddy_frames::{Stamp, clock::Clock};
use eddy_messages::{FrameCdr, Message, ParticleFrame};
use eddy_node::{PendingCommand, PlaybackSink, Player, PlayerError, PlayerOptions, play};

/// Parameters of the benchmark.
#[derive(Clone, Copy, Debug)]
pub struct Plan {
    /// Particles of a frame.
    pub particles: usize,
    /// Frame rate (Hz).
    pub hertz: f64,
    /// Frames per turn.
    pub frames: u32,
    /// Number of turns of each.
    pub turns: usize,
}

/// Delays of messages after they were due.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Timing {
    /// Replay.
    pub replay: Spread,
    /// The sleeping loop.
    pub timer: Spread,
}

/// Why a measurement failed.
#[derive(Debug, thiserror::Error)]
pub enum BenchError {
    /// The bag could not be written or read.
    #[error(transparent)]
    Bag(#[from] BagError),
    /// The bag cannot be played.
    #[error(transparent)]
    Player(#[from] PlayerError),
}

/// Writes a bag to the unused `path` and plays it, until `is_over`.
///
/// # Errors
/// [`BenchError`].
pub fn time(path: &Path, plan: &Plan, is_over: &dyn Fn() -> bool) -> Result<Timing, BenchError> {
    let dues: Vec<_> =
        (0..plan.frames).map(|n| Duration::from_secs_f64(f64::from(n) / plan.hertz)).collect();
    let mut bag = BagWriter::create(path, WriterOptions::default())?;
    let topic = bag.topic("/particles", ParticleFrame::TYPE)?;
    let mut frame = particles::frame(plan.particles);
    for due in &dues {
        let stamp = Stamp(due.as_nanos() as i64);
        bag.write_stamped(topic, stamp, &frame.to_cdr())?;
        // Distinct frames, so that they do not compress to nothing.
        frame.position.as_flattened_mut().iter_mut().for_each(|x| *x = (1.01 * *x).fract());
    }
    bag.finish()?;
    let (mut slept, mut played) = (Vec::new(), Vec::new());
    for _ in 0..plan.turns {
        let clock = Clock::start();
        for due in dues.iter().take_while(|_| !is_over()) {
            thread::sleep(due.saturating_sub(clock.now()));
            slept.push(clock.now().saturating_sub(*due));
        }
        let bag = BagReader::open(path)?;
        let mut player = Player::new(&bag, PlayerOptions::default())?;
        let clock = Clock::start();
        let mut late = DelayRecorder { dues: dues.iter(), clock, late: &mut played, is_over };
        play(&mut player, &clock, &mut late)?;
    }
    Ok(Timing { replay: Spread::of(played), timer: Spread::of(slept) })
}

/// Records the delay of each message.
struct DelayRecorder<'a> {
    dues: std::slice::Iter<'a, Duration>,
    clock: Clock,
    late: &'a mut Vec<Duration>,
    is_over: &'a dyn Fn() -> bool,
}

impl PlaybackSink for DelayRecorder<'_> {
    type Error = BagError;

    fn message(&mut self, _: BagMessage, _: Duration) -> Result<(), BagError> {
        let late = self.dues.next().map(|&due| self.clock.now().saturating_sub(due));
        self.late.extend(late);
        Ok(())
    }

    fn clock(&mut self, _: Stamp) -> Result<(), BagError> {
        Ok(())
    }

    fn commands(&mut self) -> Vec<PendingCommand> {
        Vec::new()
    }

    fn is_stopped(&self) -> bool {
        (self.is_over)()
    }
}
