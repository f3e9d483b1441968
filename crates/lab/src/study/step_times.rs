//! Times of training steps: the paper's Table 4 for this machine.

use super::{Speed, run::Work};
use crate::bench::training::paper_steps;
use eddy_evaluation::page::Machine;

/// Windows per batch.
const WINDOWS: usize = 16;

/// Times a step of every recurrent core for each window length through burn, unless already done.
pub(super) fn run(work: &Work) -> anyhow::Result<()> {
    let folder = work.folders.report(work.comparison);
    let device = work.device.through_burn();
    if Speed::find(&folder, device)?.is_some() {
        return Ok(());
    }
    let kinds = paper_steps(&work.study.step_frames);
    work.progress.begin(kinds.len() as u64, "training steps timed");
    let mut steps = Vec::new();
    for step in kinds {
        if work.stops() {
            work.progress.finish();
            return Ok(());
        }
        steps.push(step.time(WINDOWS, work.study.step_seconds, device));
        work.progress.advance(1);
    }
    work.progress.finish();
    Speed { machine: Machine::here(), device, steps }.save(&folder)?;
    Ok(())
}
