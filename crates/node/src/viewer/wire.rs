//! A displayed frame as bytes, little-endian: a header of [`HEADER`] bytes, then 12 bytes per particle, property by property,
//! and 24 bytes per triangle.
//!
//! | offset | type | content |
//! |---|---|---|
//! | 0 | u32 | `EDY` and the [`VERSION`] |
//! | 4 | u32 | flags: 1 truth present, 2 prediction present, 4 both of the same instant, 8 free run |
//! | 8 | u32 | N, number of particles |
//! | 12 | u32 | horizon of the prediction (frames), 0 if unknown |
//! | 16 | u64 | stream |
//! | 24 | u64 ×2 | sequence of truth and prediction |
//! | 40 | f64 ×2 | stamp of truth and prediction (s) |
//! | 56 | f32 ×4 | lower and upper corner of the domain (domain lengths) |
//! | 72 | f32 | speed that 255 stands for (domain lengths per second) |
//! | 76 | f32 ×2 | error of the prediction and of the best baseline (RMSE, domain lengths; NaN if unknown) |
//! | 84 | u32 ×2 | number of triangles T of tools, F of forces on them |
//! | 92 | u32 | zero |
//! | 96 | u16 `[N, 2]` | positions of the truth, 0 to 65535 across the domain |
//! | | u16 `[N, 2]` | positions of the prediction |
//! | | u8 `[N]` ×4 | speed of the truth, speed of the prediction, error, material |
//! | | f32 `[T + F, 3, 2]` | corners of the triangles, 0 to 1 across the domain |
//!
//! Positions are for display only: rounded to 1/65535 of the domain and clamped to it. The error of a particle is on a
//! logarithmic scale from 0 for [`SMALLEST_ERROR`] to 255 for [`LARGEST_ERROR`] (domain lengths). The speed of a particle is
//! 255 times the square root of its share of the speed in the header, so that slow particles differ where few are fast. A
//! missing side is zero.

use std::sync::Arc;

use super::comparison::PredictionInfo;
use eddy_frames::{Domain, Frame, palette, tool::Shape};

/// Bytes before the particles.
pub const HEADER: usize = 96;
/// Version of this layout.
pub const VERSION: u8 = 3;
/// Bytes per particle, both sides together.
const PARTICLE: usize = 12;
/// The error of a particle that 0 stands for (domain lengths).
pub(super) const SMALLEST_ERROR: f32 = 1e-5;
/// The error of a particle that 255 stands for (domain lengths).
pub(super) const LARGEST_ERROR: f32 = 1e-1;

const TRUTH: u32 = 1;
const PREDICTION: u32 = 2;
const SAME_INSTANT: u32 = 4;
const FREE_RUN: u32 = 8;

/// A frame as displayed: truth, prediction, or both with the same number of particles.
#[derive(Clone, Debug, Default)]
pub struct DisplayedFrame {
    /// The observed frame.
    pub truth: Option<Arc<Frame>>,
    /// The predicted frame and where it comes from.
    pub prediction: Option<(Arc<Frame>, PredictionInfo)>,
    /// RMSE of the prediction and of the best baseline (domain lengths).
    pub errors: [Option<f64>; 2],
    /// The tools of that instant, and the forces on them.
    pub shapes: Vec<Shape>,
}

impl DisplayedFrame {
    /// Whether both sides are of the same instant.
    fn is_pair(&self) -> bool {
        let sequence = self.truth.as_ref().map(|frame| frame.sequence);
        sequence.is_some() && sequence == self.prediction.as_ref().map(|(frame, _)| frame.sequence)
    }
}

/// Encodes a frame. `top_speed` is the highest speed that can be told apart (domain lengths per second).
pub fn encode(displayed: &DisplayedFrame, top_speed: f32) -> Vec<u8> {
    let truth = displayed.truth.as_deref();
    let (prediction, info) = match &displayed.prediction {
        Some((frame, info)) => (Some(&**frame), Some(*info)),
        None => (None, None),
    };
    let Some(any) = truth.or(prediction) else { return Vec::new() };
    // Sides with different particles cannot share the materials.
    let prediction = prediction.filter(|frame| frame.len() == any.len());
    let particles = any.len();
    let pair = displayed.is_pair() && prediction.is_some();

    let mut bytes = Vec::with_capacity(HEADER + PARTICLE * particles);
    bytes.extend_from_slice(&[b'E', b'D', b'Y', VERSION]);
    let free_running = info.is_some_and(|info| info.free_running);
    let flags = flags([truth.is_some(), prediction.is_some(), pair, free_running]);
    let horizon = info.map_or(0, |info| info.horizon);
    for number in [flags, particles as u32, horizon] {
        bytes.extend_from_slice(&number.to_le_bytes());
    }
    bytes.extend_from_slice(&any.stream.to_le_bytes());
    for side in [truth, prediction] {
        bytes.extend_from_slice(&side.map_or(0, |frame| frame.sequence).to_le_bytes());
    }
    for side in [truth, prediction] {
        let stamp = side.map_or(0.0, |frame| frame.stamp.seconds());
        bytes.extend_from_slice(&stamp.to_le_bytes());
    }
    let Domain { lower, upper } = any.domain;
    let errors = displayed.errors.map(|error| error.map_or(f32::NAN, |error| error as f32));
    for number in [lower[0], lower[1], upper[0], upper[1], top_speed, errors[0], errors[1]] {
        bytes.extend_from_slice(&number.to_le_bytes());
    }
    let triangles = [palette::TOOL, palette::FORCE].map(|color| {
        let shapes = displayed.shapes.iter().filter(|shape| shape.color == color);
        shapes.flat_map(|shape| shape.triangles(any.domain)).collect::<Vec<_>>()
    });
    for corners in &triangles {
        bytes.extend_from_slice(&(corners.len() as u32 / 3).to_le_bytes());
    }
    bytes.resize(HEADER, 0);

    for side in [truth, prediction] {
        positions(&mut bytes, side, any);
    }
    for side in [truth, prediction] {
        speeds(&mut bytes, side, particles, top_speed);
    }
    match (truth, prediction) {
        (Some(truth), Some(prediction)) if pair => {
            let pairs = truth.position.iter().zip(&prediction.position);
            bytes.extend(pairs.map(|(a, b)| error_level((a[0] - b[0]).hypot(a[1] - b[1]))));
        }
        _ => bytes.resize(bytes.len() + particles, 0),
    }
    bytes.extend(any.material.iter().map(|&material| material as u8));
    for number in triangles.iter().flatten().flatten() {
        bytes.extend_from_slice(&number.to_le_bytes());
    }
    bytes
}

/// The flags of the header: whether there is a truth, a prediction, both of one instant, and a free run.
fn flags(set: [bool; 4]) -> u32 {
    let flags = [TRUTH, PREDICTION, SAME_INSTANT, FREE_RUN];
    set.into_iter().zip(flags).filter(|(set, _)| *set).fold(0, |all, (_, flag)| all | flag)
}

fn positions(bytes: &mut Vec<u8>, side: Option<&Frame>, any: &Frame) {
    let Some(frame) = side else {
        bytes.resize(bytes.len() + 4 * any.len(), 0);
        return;
    };
    let Domain { lower, upper } = any.domain;
    let scale = [0, 1].map(|axis| f32::from(u16::MAX) / (upper[axis] - lower[axis]));
    for position in &frame.position {
        // The cast saturates.
        let [x, y] = [0, 1].map(|axis| ((position[axis] - lower[axis]) * scale[axis] + 0.5) as u16);
        let ([a, b], [c, d]) = (x.to_le_bytes(), y.to_le_bytes());
        bytes.extend_from_slice(&[a, b, c, d]);
    }
}

fn speeds(bytes: &mut Vec<u8>, side: Option<&Frame>, particles: usize, top_speed: f32) {
    let Some(frame) = side else {
        bytes.resize(bytes.len() + particles, 0);
        return;
    };
    let share = |v: &[f32; 2]| v[0].hypot(v[1]) / top_speed.max(f32::MIN_POSITIVE);
    // The cast saturates.
    let level = |v: &[f32; 2]| (share(v).sqrt() * f32::from(u8::MAX) + 0.5) as u8;
    bytes.extend(frame.velocity.iter().map(level));
}

/// An error (domain lengths) on the logarithmic scale.
fn error_level(error: f32) -> u8 {
    let decades = (LARGEST_ERROR / SMALLEST_ERROR).log2();
    // Negative for errors below the smallest; the cast saturates.
    ((error / SMALLEST_ERROR).log2() / decades * f32::from(u8::MAX) + 0.5) as u8
}

#[cfg(test)]
mod tests {
    use super::*;
    use eddy_frames::{
        Material, Stamp,
        tool::{Outline, Pose},
    };

    fn frame(sequence: u64, position: [[f32; 2]; 2]) -> Arc<Frame> {
        Arc::new(Frame {
            stream: u64::MAX,
            sequence,
            stamp: Stamp(1_500_000_000),
            dt: 0.016,
            domain: Domain { lower: [0.0, 0.0], upper: [2.0, 1.0] },
            position: position.to_vec(),
            velocity: vec![[0.0, -1.0], [3.0, 4.0]],
            material: vec![Material::Liquid, Material::Rope],
        })
    }

    #[test]
    fn every_field_is_at_the_offset_in_the_table() {
        let corners = vec![vec![[0.0, 0.0], [1.0, 0.0], [0.0, 0.5]]];
        let wedge =
            Outline::Polygons { corners }.posed(Pose { position: [0.0; 2], angle: 0.0 }).remove(0);
        let displayed = DisplayedFrame {
            truth: Some(frame(7, [[0.0, 0.0], [1.0, 0.5]])),
            prediction: Some((
                frame(7, [[0.0, 0.1], [1.0, 0.5]]),
                PredictionInfo { source: 5, horizon: 2, free_running: true },
            )),
            errors: [Some(0.25), None],
            shapes: vec![Shape { part: wedge, color: palette::FORCE }],
        };
        let bytes = encode(&displayed, 5.0);
        assert_eq!(bytes.len(), HEADER + 2 * PARTICLE + 3 * 8);
        assert_eq!(&bytes[..4], b"EDY\x03");
        let u32_at = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
        let u64_at = |at: usize| u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap());
        let f64_at = |at: usize| f64::from_le_bytes(bytes[at..at + 8].try_into().unwrap());
        let f32_at = |at: usize| f32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
        let u16_at = |at: usize| u16::from_le_bytes(bytes[at..at + 2].try_into().unwrap());
        assert_eq!([u32_at(4), u32_at(8), u32_at(12)], [15, 2, 2]);
        assert_eq!([u64_at(16), u64_at(24), u64_at(32)], [u64::MAX, 7, 7]);
        assert_eq!([f64_at(40), f64_at(48)], [1.5, 1.5]);
        assert_eq!([56, 60, 64, 68, 72, 76].map(f32_at), [0.0, 0.0, 2.0, 1.0, 5.0, 0.25]);
        assert!(f32_at(80).is_nan());
        assert_eq!([96, 98, 100, 102].map(u16_at), [0, 0, 32768, 32768]);
        assert_eq!([104, 106, 108, 110].map(u16_at), [0, 6554, 32768, 32768]);
        // The square root of 1 / 5 is 0.447.
        assert_eq!(bytes[112..120], [114, 255, 114, 255, 255, 0, 0, 3]);
        assert_eq!([u32_at(84), u32_at(88)], [0, 1]);
        let corners: Vec<f32> = (0..6).map(|k| f32_at(120 + 4 * k)).collect();
        assert_eq!(corners, [0.0, 0.0, 0.5, 0.0, 0.0, 0.5]);
    }

    #[test]
    fn a_missing_side_is_zero_and_positions_are_clamped_to_the_domain() {
        let truth = frame(7, [[-9.0, 0.5], [9.0, 1e9]]);
        let bytes =
            encode(&DisplayedFrame { truth: Some(truth), ..DisplayedFrame::default() }, 1.0);
        assert_eq!(bytes[4], 1);
        assert_eq!(bytes[96..104], [0, 0, 0, 128, 255, 255, 255, 255]);
        assert_eq!(bytes[104..112], [0; 8]);
    }

    #[test]
    fn errors_are_on_a_logarithmic_scale() {
        let levels = [0.0, 1e-6, 1e-5, 1e-3, 1e-1, 1e3].map(error_level);
        assert_eq!(levels, [0, 0, 0, 128, 255, 255]);
    }
}
