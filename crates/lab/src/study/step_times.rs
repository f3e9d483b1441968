//! Times of training steps: the paper's Table 4 for this machine.

use super::{Speed, run::Work};
use crate::bench::training::{FRAMES, paper_steps};
use eddy_pages::Machine;

/// Windows per batch.
const WINDOWS: usize = 16;

/// Times a step of every recurrent core for each window length, unless already done.
pub(super) fn run(work: &Work) -> anyhow::Result<()> {
    let folder = work.folders.report(work.comparison);
    let device = work.device;
    let precision = work.gpu_precision();
    if Speed::find(&folder, device, precision, &work.study.step_frames)?.is_some() {
        return Ok(());
    }
    // Long windows of the whole network take minutes on a processor.
    let all = &work.study.step_frames;
    let whole = if precision.is_empty() { &FRAMES[..1] } else { all };
    let kinds = paper_steps(whole, all);
    work.progress.begin(kinds.len() as u64, "training steps timed");
    let mut steps = Vec::new();
    for step in kinds {
        if work.stops() {
            work.progress.finish();
            return Ok(());
        }
        steps.push(step.time(WINDOWS, work.study.step_seconds, device, work.gpu())?);
        work.progress.advance(1);
    }
    work.progress.finish();
    let precision = precision.to_owned();
    Speed { machine: Machine::here(), device, precision, steps }.save(&folder)?;
    Ok(())
}
