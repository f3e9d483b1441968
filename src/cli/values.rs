//! Parsers of option values.

/// A duration from 0 (s).
pub(super) fn seconds(text: &str) -> Result<f64, String> {
    number(text, |seconds| (0.0..=1e9).contains(&seconds), "0 to 1e9 s")
}

/// A duration of more than 0 (s).
pub(super) fn positive_seconds(text: &str) -> Result<f64, String> {
    number(text, |seconds| seconds > 0.0 && seconds <= 1e9, "more than 0, at most 1e9 s")
}

/// A factor or a rate of more than 0.
pub(super) fn positive(text: &str) -> Result<f64, String> {
    number(text, |value| value > 0.0 && value.is_finite(), "a positive number")
}

/// A key and its value.
pub(super) fn key_value(text: &str) -> Result<(String, String), String> {
    match text.split_once('=') {
        Some((key, value)) if !key.is_empty() => Ok((key.to_owned(), value.to_owned())),
        _ => Err("expected KEY=VALUE".to_owned()),
    }
}

fn number(text: &str, is_valid: impl Fn(f64) -> bool, expected: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(value) if is_valid(value) => Ok(value),
        _ => Err(format!("expected {expected}")),
    }
}

/// Where a network predicts, or the solver runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ComputeDevice {
    /// On the processor.
    Cpu,
    /// On the NVIDIA GPU of this number.
    #[cfg(feature = "cuda")]
    Cuda(u8),
}

impl ComputeDevice {
    pub(super) fn parse(text: &str) -> Result<Self, String> {
        if text == "cpu" {
            return Ok(Self::Cpu);
        }
        #[cfg(feature = "cuda")]
        {
            use eddy_learning::model::{MOST_GPUS, gpu_number};
            let number = gpu_number(text).map(Self::Cuda);
            number.ok_or_else(|| format!("expected cpu, cuda or cuda:N, N up to {}", MOST_GPUS - 1))
        }
        #[cfg(not(feature = "cuda"))]
        Err("expected cpu: this program was built without the feature cuda".to_owned())
    }
}
