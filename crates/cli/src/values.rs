//! Parsers of option values.

/// A duration from 0 (s), up to the longest between two times of ROS: a bag may begin at time 0 and go on today.
pub fn seconds(text: &str) -> Result<f64, String> {
    number(text, |seconds| (0.0..=9e9).contains(&seconds), "0 to 9e9 s")
}

/// A duration of more than 0 (s).
pub fn positive_seconds(text: &str) -> Result<f64, String> {
    number(text, |seconds| seconds > 0.0 && seconds <= 1e9, "more than 0, at most 1e9 s")
}

/// A factor or a rate of more than 0.
pub fn positive(text: &str) -> Result<f64, String> {
    number(text, |value| value > 0.0 && value.is_finite(), "a positive number")
}

/// A key and its value.
pub fn key_value(text: &str) -> Result<(String, String), String> {
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
