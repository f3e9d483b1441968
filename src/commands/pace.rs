//! A simulation at the pace of its stamps.

use std::{thread, time::Duration};

use eddy::{clock::Clock, frame::Frame, mpm::Simulation};

/// Longest sleep, so that a signal ends it soon.
const NAP: Duration = Duration::from_millis(20);

/// Hands every frame to `publish` when it is due, `rate` times as fast as real time, or as soon
/// after that as the machine can. Ends with the scene, or when `stop` says so: `false` then.
pub(super) fn run(
    simulation: &mut Simulation,
    rate: f64,
    stop: impl Fn() -> bool,
    mut publish: impl FnMut(&Frame, &Simulation) -> anyhow::Result<()>,
) -> anyhow::Result<bool> {
    let clock = Clock::start();
    while let Some(frame) = simulation.next_frame()? {
        let due =
            Duration::try_from_secs_f64(frame.stamp.seconds() / rate).unwrap_or(Duration::MAX);
        while !stop() && clock.now() < due {
            thread::sleep(due.saturating_sub(clock.now()).min(NAP));
        }
        if stop() {
            return Ok(false);
        }
        publish(&frame, simulation)?;
    }
    Ok(true)
}
