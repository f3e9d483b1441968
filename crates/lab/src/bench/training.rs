//! How long a training step takes: the paper's Table 4, by length of the window.

use std::{fmt, str::FromStr};

use serde::{Deserialize, Serialize};

use eddy_frames::clock::Clock;
use eddy_learning::{
    model::{Core, DeviceKind},
    train::step_benchmark::{Part, StepBenchmark},
};

/// Samples an epoch of the paper's Table 4.
pub const PAPER_SAMPLES: u32 = 23_856;

/// Lengths of the window in the table (frames). The paper's is 2.
pub const FRAMES: [usize; 4] = [2, 16, 64, 256];

/// The table's cores, the paper's order.
pub const CORES: [Core; 4] = [Core::Lstm, Core::Gru, Core::MinLstm, Core::MinGru];

/// What PyTorch 2.15, eager, takes for the cores alone at B = 16, LSTM by minLSTM and GRU by minGRU, by
/// frames a window: measured by `tests/peers/torch_speed.py` on two cores of an Intel Xeon (AVX-512).
pub const PYTORCH_CORES: [(usize, [f64; 2]); 3] =
    [(2, [9.61, 2.84]), (16, [4.10, 4.02]), (64, [3.50, 5.40])];

/// Steps before the clock starts.
const WARM_UP: usize = 2;
/// Fewest steps that are timed.
const FEWEST: usize = 3;

/// A kind of step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Step {
    /// What takes it.
    pub part: Part,
    /// Its core.
    pub core: Core,
    /// Frames a window.
    pub frames: usize,
    /// Windows a batch, if they are not those of the other steps.
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

/// The time of a step.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Timing {
    /// What took it.
    pub what: Part,
    /// Its core.
    pub core: Core,
    /// Frames a window.
    pub frames: usize,
    /// Windows a batch.
    pub windows: usize,
    /// Median time of a step: forward, loss, backward, Adam (ms).
    pub milliseconds: f64,
}

impl Step {
    /// Times steps of this kind for about so long (s).
    pub fn time(&self, windows: usize, seconds: f64, device: DeviceKind) -> Timing {
        let windows = self.windows.unwrap_or(windows);
        let mut exercise = StepBenchmark::new(self.part, self.core, self.frames, windows, device);
        for _ in 0..WARM_UP {
            exercise.step();
        }
        let total = Clock::start();
        let mut times = Vec::new();
        while times.len() < FEWEST || total.now().as_secs_f64() < seconds {
            let clock = Clock::start();
            exercise.step();
            times.push(clock.now().as_secs_f64());
        }
        times.sort_by(f64::total_cmp);
        let milliseconds = 1e3 * times[times.len() / 2];
        let Self { part, core, frames, .. } = *self;
        Timing { what: part, core, frames, windows, milliseconds }
    }
}

/// The paper's table, row by row: the whole network with its window, then the core alone by `frames`.
pub fn paper_steps(frames: &[usize]) -> Vec<Step> {
    let alone = frames.iter().map(|&t| (Part::Core, t));
    let kinds = [(Part::Frame, FRAMES[0])].into_iter().chain(alone);
    kinds
        .flat_map(|(part, frames)| CORES.map(|core| Step { part, core, frames, windows: None }))
        .collect()
}

/// Multiplications (each with an addition) of a core's matrix products for each layer and frame, in units
/// of H^2.
pub fn products(core: Core) -> f64 {
    match core {
        Core::Mlp => 1.0,
        Core::MinGru => 2.0,
        Core::MinLstm => 3.0,
        Core::Gru => 6.0,
        Core::Lstm => 8.0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_step_is_written_as_it_is_read() {
        for text in ["frame:mingru:2", "core:lstm:16"] {
            assert_eq!(text.parse::<Step>().unwrap().to_string(), text);
        }
        assert_eq!("core:gru:4:32".parse::<Step>().unwrap().windows, Some(32));
    }

    #[test]
    fn a_wrong_step_is_refused_with_what_is_expected() {
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
