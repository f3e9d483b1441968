//! Parsers of option values.

/// A duration from 0 (s), up to the longest between two times of ROS: a bag may begin at time 0 and go on today.
pub(super) fn seconds(text: &str) -> Result<f64, String> {
    number(text, |seconds| (0.0..=9e9).contains(&seconds), "0 to 9e9 s")
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

/// Where the solver runs, or a network predicts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Device {
    /// On the processor.
    Cpu,
    /// On the NVIDIA GPU of this number.
    #[cfg(feature = "cuda")]
    Cuda(u8),
}

impl Device {
    #[cfg(feature = "cuda")]
    pub(super) fn parse(text: &str) -> Result<Self, String> {
        use eddy_cuda::{MOST_GPUS, gpu_number};
        let expected = || format!("expected cpu, cuda or cuda:N, N up to {}", MOST_GPUS - 1);
        match text {
            "cpu" => Ok(Self::Cpu),
            _ => gpu_number(text).map(Self::Cuda).ok_or_else(expected),
        }
    }

    #[cfg(not(feature = "cuda"))]
    pub(super) fn parse(text: &str) -> Result<Self, String> {
        match text {
            "cpu" => Ok(Self::Cpu),
            _ => Err("expected cpu: this program was built without the feature cuda".to_owned()),
        }
    }
}
