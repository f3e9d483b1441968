//! Time of training steps: the paper's Table 4 for this machine.

use super::Work;
use crate::commands::progress_bar;
use eddy::{
    bench::training::{CORES, FRAMES, Step, Timing},
    model::DeviceKind,
    train::exercise::Part,
};

/// Windows a batch, and about how long each is timed (s).
const WINDOWS: usize = 16;
const SECONDS: f64 = 2.0;

/// Times a step of every recurrent core with each of the lengths of a window.
pub(super) fn run(work: &Work) -> anyhow::Result<Vec<Timing>> {
    let steps: Vec<Step> = [(Part::Frame, FRAMES[0])]
        .into_iter()
        .chain(FRAMES.map(|frames| (Part::Core, frames)))
        .flat_map(|(part, frames)| CORES.map(|core| Step { part, core, frames, windows: None }))
        .collect();
    let bar = progress_bar(steps.len() as u64, "training steps timed", work.quiet);
    let mut timings = Vec::new();
    for step in steps {
        if work.stops() {
            break;
        }
        timings.push(step.time(WINDOWS, SECONDS, DeviceKind::Flex));
        bar.inc(1);
    }
    bar.finish_and_clear();
    Ok(timings)
}
