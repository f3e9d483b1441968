//! Time of training steps: the paper's Table 4 for this machine.

use super::Work;
use crate::commands::progress_bar;
use eddy::{bench::training::paper_steps, page::Machine, study::Speed};

/// Windows a batch.
const WINDOWS: usize = 16;

/// Times a step of every recurrent core with each of the lengths of a window, unless that was done.
pub(super) fn run(work: &Work) -> anyhow::Result<()> {
    let folder = work.folders.report(work.comparison);
    if Speed::find(&folder, work.device)?.is_some() {
        return Ok(());
    }
    let kinds = paper_steps(&work.study.step_frames);
    let bar = progress_bar(kinds.len() as u64, "training steps timed", work.quiet);
    let mut steps = Vec::new();
    for step in kinds {
        if work.stops() {
            return Ok(());
        }
        steps.push(step.time(WINDOWS, work.study.step_seconds, work.device));
        bar.inc(1);
    }
    bar.finish_and_clear();
    Speed { machine: Machine::here(), device: work.device, steps }.save(&folder)?;
    Ok(())
}
