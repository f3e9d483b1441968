//! Parsers of option values.

use eddy_inference::engine::Precision;

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

/// Where the solver runs.
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
        match text {
            "cpu" => Ok(Self::Cpu),
            #[cfg(feature = "cuda")]
            _ => gpu(text, "cpu").map(Self::Cuda),
            #[cfg(not(feature = "cuda"))]
            _ => Err(no_gpu("cpu")),
        }
    }
}

/// Where a network predicts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NetworkDevice {
    /// On the processor, with factors of this precision.
    Cpu(Precision),
    /// On the NVIDIA GPU of this number.
    #[cfg(feature = "cuda")]
    Cuda(u8),
}

impl NetworkDevice {
    pub(super) fn parse(text: &str) -> Result<Self, String> {
        match text {
            "cpu" => Ok(Self::Cpu(Precision::Single)),
            "cpu:bf16" => Ok(Self::Cpu(Precision::Bf16)),
            #[cfg(feature = "cuda")]
            _ => gpu(text, "cpu, cpu:bf16").map(Self::Cuda),
            #[cfg(not(feature = "cuda"))]
            _ => Err(no_gpu("cpu or cpu:bf16")),
        }
    }
}

/// The number of an NVIDIA GPU, beside devices of other names.
#[cfg(feature = "cuda")]
fn gpu(text: &str, others: &str) -> Result<u8, String> {
    use eddy_cuda::{MOST_GPUS, gpu_number};
    let expected = || format!("expected {others}, cuda or cuda:N, N up to {}", MOST_GPUS - 1);
    gpu_number(text).ok_or_else(expected)
}

#[cfg(not(feature = "cuda"))]
fn no_gpu(others: &str) -> String {
    format!("expected {others}: this program was built without the feature cuda")
}
