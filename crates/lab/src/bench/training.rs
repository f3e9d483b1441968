//! Time per training step by window length: the paper's Table 4.

use std::{fmt, str::FromStr};

use serde::{Deserialize, Serialize};

use eddy_frames::clock::Clock;
use eddy_learning::{
    model::{Core, DeviceKind, GpuOptions},
    train::{
        TrainError,
        step_benchmark::{Part, StepBenchmark},
    },
};

/// Samples per epoch in the paper's Table 4.
pub const PAPER_SAMPLES: u32 = 23_856;

/// Window lengths in the table (frames); the paper's is 2.
pub const FRAMES: [usize; 4] = [2, 16, 64, 256];

/// The table's cores, in the paper's order.
pub const CORES: [Core; 4] = [Core::Lstm, Core::Gru, Core::MinLstm, Core::MinGru];

/// Time ratios LSTM/minLSTM and GRU/minGRU of PyTorch 2.15 (eager) for the cores alone at B = 16, by window length: measured
/// with `tests/peers/torch_speed.py` on two cores of an Intel Xeon (AVX-512).
pub const PYTORCH_CORES: [(usize, [f64; 2]); 3] =
    [(2, [9.61, 2.84]), (16, [4.10, 4.02]), (64, [3.50, 5.40])];

/// Untimed warm-up steps.
const WARM_UP: usize = 2;
/// Minimum number of timed steps.
const MIN_SAMPLES: usize = 3;

/// A kind of step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Step {
    /// The trained part.
    pub part: Part,
    /// Its core.
    pub core: Core,
    /// Frames per window.
    pub frames: usize,
    /// Windows per batch, if different from the default.
    pub windows: Option<usize>,
}

impl FromStr for Step {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = |field: &str, expected: &str| {
            format!(
                "{field} of {text}: expected {expected}, as in frame:mingru:2 or core:lstm:16:32"
            )
        };
        let words: Vec<&str> = text.split(':').collect();
        let &[part, core, frames, ref windows @ ..] = words.as_slice() else {
            return Err(wrong("step", "WHAT:CORE:FRAMES[:WINDOWS]"));
        };
        let number = |field, word: &str| {
            word.parse().ok().filter(|&n| n > 0).ok_or_else(|| wrong(field, "a number from 1"))
        };
        let part = match part {
            "frame" => Part::Frame,
            "core" => Part::Core,
            _ => return Err(wrong("what", "frame or core")),
        };
        let names = Core::ALL.map(Core::name).join(", ");
        let core = Core::ALL.into_iter().find(|kind| kind.name() == core);
        let core = core.ok_or_else(|| wrong("core", &format!("one of {names}")))?;
        let windows = match windows {
            [] => None,
            [windows] => Some(number("windows", windows)?),
            _ => return Err(wrong("step", "WHAT:CORE:FRAMES[:WINDOWS]")),
        };
        Ok(Self { part, core, frames: number("frames", frames)?, windows })
    }
}

impl fmt::Display for Step {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let part = if self.part == Part::Frame { "frame" } else { "core" };
        write!(f, "{part}:{}:{}", self.core.name(), self.frames)
    }
}

/// Time per step.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Timing {
    /// The trained part.
    pub what: Part,
    /// Its core.
    pub core: Core,
    /// Frames per window.
    pub frames: usize,
    /// Windows per batch.
    pub windows: usize,
    /// Median time per step: forward, loss, backward, Adam (ms).
    pub milliseconds: f64,
}

/// A time per step (ms) in tables: three digits, also of a GPU's times.
pub fn milliseconds(time: f64) -> String {
    format!("{time:.*}", if time < 10.0 { 3 } else { 1 })
}

impl Step {
    /// Times steps for about `seconds`.
    ///
    /// # Errors
    /// [`TrainError`] of an NVIDIA GPU.
    pub fn time(
        &self,
        windows: usize,
        seconds: f64,
        device: DeviceKind,
        gpu: GpuOptions,
    ) -> Result<Timing, TrainError> {
        let windows = self.windows.unwrap_or(windows);
        let mut exercise =
            StepBenchmark::new(self.part, self.core, self.frames, windows, device, gpu)?;
        for _ in 0..WARM_UP {
            exercise.run()?;
        }
        let total = Clock::start();
        let mut times = Vec::new();
        while times.len() < MIN_SAMPLES || total.now().as_secs_f64() < seconds {
            let clock = Clock::start();
            let steps = exercise.run()?;
            times.push(clock.now().as_secs_f64() / steps as f64);
        }
        times.sort_by(f64::total_cmp);
        let milliseconds = 1e3 * times[times.len() / 2];
        let Self { part, core, frames, .. } = *self;
        Ok(Timing { what: part, core, frames, windows, milliseconds })
    }
}

/// The steps of the paper's table: the whole network by `whole`, then the core alone by `frames`.
pub fn paper_steps(whole: &[usize], frames: &[usize]) -> Vec<Step> {
    let alone = frames.iter().map(|&t| (Part::Core, t));
    let kinds = whole.iter().map(|&t| (Part::Frame, t)).chain(alone);
    kinds
        .flat_map(|(part, frames)| CORES.map(|core| Step { part, core, frames, windows: None }))
        .collect()
}

/// Multiply-adds of a core's matrix products per layer and frame, in units of H^2.
pub fn products(core: Core) -> f64 {
    let read = if core.recurrent_part().is_some() { 2 } else { 1 };
    (read * core.gates()) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_step_is_formatted_as_it_is_parsed() {
        for text in ["frame:mingru:2", "core:lstm:16"] {
            assert_eq!(text.parse::<Step>().unwrap().to_string(), text);
        }
        assert_eq!("core:gru:4:32".parse::<Step>().unwrap().windows, Some(32));
    }

    #[test]
    fn an_invalid_step_is_rejected_with_the_expected_syntax() {
        for (text, word) in [
            ("core:lstm", "WHAT:CORE:FRAMES"),
            ("all:lstm:2", "frame or core"),
            ("core:rnn:2", "mlp, lstm, gru, minlstm, mingru"),
            ("core:lstm:0", "a number from 1"),
            ("core:lstm:2:2:2", "WHAT:CORE:FRAMES"),
        ] {
            let message = text.parse::<Step>().unwrap_err();
            assert!(message.contains(word), "{text}: {message}");
        }
    }
}
