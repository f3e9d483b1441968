//! `metadata.json` of learned simulators: GNS (`learning_to_simulate`, `gns`) and LagrangeBench
//! (`data_gen/lagrangebench_data/gen_dataset.py`). Each ignores the keys of the other.

use std::{array, fmt, fs, path::Path};

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{error::ExchangeError, streams::Track};
use eddy_frames::{AnyDomain, Domain, Frame, decimal};

/// Neighbours within the connectivity radius: those on a square or cubic grid with LagrangeBench's radius of 1.45
/// spacings, along one axis or diagonally along two.
const fn neighbours<const D: usize>() -> usize {
    2 * D + 2 * D * (D - 1)
}

/// LagrangeBench's connectivity radius (particle spacings).
const RADIUS: f64 = 1.45;

/// Particles whose neighbour distances are measured.
const SAMPLES: usize = 256;

/// Smaller standard deviations are written as 1, so that division by them is safe (as in LagrangeBench).
const SMALLEST_DEVIATION: f64 = 1e-7;

/// Contents for writing. Velocities and accelerations are differences between frames, without dt.
#[derive(Debug, Serialize)]
pub(super) struct Metadata {
    case: &'static str,
    solver: &'static str,
    dim: usize,
    /// Time between two frames (s).
    dt: f64,
    write_every: usize,
    /// `[axis][lower, upper]`.
    bounds: Vec<[f64; 2]>,
    periodic_boundary_conditions: Vec<bool>,
    /// Typical distance between neighbours in the first frame.
    dx: f64,
    default_connectivity_radius: f64,
    num_particles_max: usize,
    /// Number of predictable frames in the shortest trajectory: one less than its frames.
    sequence_length: usize,
    sequence_length_train: usize,
    num_trajs_train: usize,
    sequence_length_test: usize,
    num_trajs_test: usize,
    vel_mean: Vec<f64>,
    vel_std: Vec<f64>,
    acc_mean: Vec<f64>,
    acc_std: Vec<f64>,
}

/// Contents needed to read positions.
#[derive(Debug, PartialEq)]
pub(super) struct Scale {
    dt: f32,
    /// `[axis][lower, upper]`.
    bounds: Vec<[f32; 2]>,
    write_every: Option<f32>,
}

impl Metadata {
    /// Describes a data set of the streams `all` (at least one), with its parts `train` and `test`.
    pub(super) fn new<const D: usize>(
        all: &[&Track<D>],
        train: &[&Track<D>],
        test: &[&Track<D>],
        statistics: &Statistics<D>,
    ) -> Self {
        let shortest = |tracks: &[&Track<D>]| {
            tracks.iter().map(|track| track.frames - 1).min().unwrap_or_default()
        };
        let first = all[0];
        let Domain { lower, upper } = first.domain;
        let bound = |axis: usize| [decimal(lower[axis]), decimal(upper[axis])];
        let radius = statistics.radius;
        let (vel_mean, vel_std) = statistics.velocity.mean_and_deviation();
        let (acc_mean, acc_std) = statistics.acceleration.mean_and_deviation();
        Self {
            case: "MPM",
            solver: "MPM",
            dim: D,
            dt: decimal(first.dt),
            write_every: 1,
            bounds: (0..D).map(bound).collect(),
            periodic_boundary_conditions: vec![false; D],
            dx: radius / RADIUS,
            default_connectivity_radius: radius,
            num_particles_max: all.iter().map(|track| track.particles()).max().unwrap_or_default(),
            sequence_length: shortest(all),
            sequence_length_train: shortest(train),
            num_trajs_train: train.len(),
            sequence_length_test: shortest(test),
            num_trajs_test: test.len(),
            vel_mean: vel_mean.to_vec(),
            vel_std: vel_std.to_vec(),
            acc_mean: acc_mean.to_vec(),
            acc_std: acc_std.to_vec(),
        }
    }

    /// Writes `metadata.json` into the directory.
    pub(super) fn write(&self, directory: &Path) -> Result<(), ExchangeError> {
        let path = directory.join(FILE);
        let text = serde_json::to_string_pretty(self).expect("numbers and strings are JSON");
        fs::write(&path, text).map_err(ExchangeError::io(&path, "writing"))
    }
}

/// Name of the file.
const FILE: &str = "metadata.json";

impl Scale {
    /// Reads `metadata.json` of a directory, if it exists.
    pub(super) fn read(directory: &Path) -> Result<Option<Self>, ExchangeError> {
        let path = directory.join(FILE);
        if !path.exists() {
            return Ok(None);
        }
        let text = fs::read_to_string(&path).map_err(ExchangeError::io(&path, "reading"))?;
        Self::parse(&path, &text).map(Some)
    }

    /// Reads the text of `metadata.json`. GNS has one form for training and rollouts, or one for each; positions have one scale.
    fn parse(path: &Path, text: &str) -> Result<Self, ExchangeError> {
        let whole: Value = serde_json::from_str(text).map_err(|error| ExchangeError::File {
            path: path.into(),
            found: format!("no JSON ({error})"),
            expected: "an object with dt and bounds",
        })?;
        let fields = Fields { path, place: String::new(), fields: &whole };
        let parts = ["train", "rollout"].map(|part| fields.part(part));
        let is_flat = whole.get("dt").is_some() || parts.iter().all(Option::is_none);
        if is_flat {
            return fields.scale();
        }
        let scales = parts.iter().flatten().map(|part| Ok((part, part.scale()?)));
        let scales: Vec<_> = scales.collect::<Result<_, ExchangeError>>()?;
        if let [(_, train), (part, rollout)] = &scales[..]
            && train != rollout
        {
            let expected = format!("{train} as in train; --dt and --domain replace both");
            return Err(part.fault("dt, bounds", rollout.to_string(), &expected));
        }
        scales.into_iter().next().map_or_else(|| fields.scale(), |(_, scale)| Ok(scale))
    }

    /// Time between two frames (s).
    pub(super) fn interval(&self) -> f32 {
        self.dt * self.write_every.unwrap_or(1.0)
    }

    /// The domain, if it has two or three dimensions.
    pub(super) fn domain(&self) -> Option<AnyDomain> {
        let (lower, upper): (Vec<f32>, Vec<f32>) =
            self.bounds.iter().map(|&[lower, upper]| (lower, upper)).unzip();
        AnyDomain::of_corners(&lower, &upper)
    }
}

impl fmt::Display for Scale {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let sides = self.bounds.iter().map(|[lower, upper]| format!("{lower} to {upper}"));
        write!(f, "{} s, {}", self.interval(), sides.collect::<Vec<_>>().join(" x "))
    }
}

/// An object of `metadata.json`.
struct Fields<'a> {
    path: &'a Path,
    /// Where it is, with a point at the end.
    place: String,
    fields: &'a Value,
}

impl Fields<'_> {
    /// The object of this name in it.
    fn part(&self, name: &str) -> Option<Self> {
        let fields = self.fields.get(name).filter(|part| part.is_object())?;
        Some(Self { path: self.path, place: format!("{}{name}.", self.place), fields })
    }

    fn fault(&self, field: &str, found: impl Into<String>, expected: &str) -> ExchangeError {
        ExchangeError::Array {
            path: self.path.into(),
            array: format!("{}{field}", self.place),
            found: found.into(),
            expected: expected.into(),
        }
    }

    /// A positive number, if it is there.
    fn number(&self, field: &str) -> Result<Option<f32>, ExchangeError> {
        let Some(found) = self.fields.get(field).filter(|value| !value.is_null()) else {
            return Ok(None);
        };
        let number = found.as_f64().map(|number| number as f32);
        let number = number.filter(|number| number.is_finite() && *number > 0.0);
        number.map(Some).ok_or_else(|| self.fault(field, found.to_string(), "a positive number"))
    }

    fn scale(&self) -> Result<Scale, ExchangeError> {
        let dt = self.number("dt")?;
        let dt = dt.ok_or_else(|| self.fault("dt", "nothing", "the seconds between two frames"))?;
        let expected = "[[left, right], [bottom, top]], in space a third pair";
        let bounds = self.fields.get("bounds");
        let found = || bounds.map_or("nothing".to_owned(), Value::to_string);
        let axes = bounds.and_then(|bounds| <Vec<[f32; 2]>>::deserialize(bounds).ok());
        let axes = axes.filter(|axes| (2..=3).contains(&axes.len()));
        let bounds = axes.ok_or_else(|| self.fault("bounds", found(), expected))?;
        Ok(Scale { dt, bounds, write_every: self.number("write_every")? })
    }
}

/// Statistics of velocities and accelerations of the training part.
#[derive(Debug, Default)]
pub(super) struct Statistics<const D: usize> {
    velocity: Moments<D>,
    acceleration: Moments<D>,
    radius: f64,
    last: Option<Last<D>>,
}

/// The last frame of a trajectory.
#[derive(Debug)]
struct Last<const D: usize> {
    position: Vec<[f32; D]>,
    /// Differences from the previous frame; `None` for the first frame.
    velocity: Option<Vec<[f32; D]>>,
}

impl<const D: usize> Statistics<D> {
    /// Starts another trajectory.
    pub(super) fn begin_trajectory(&mut self) {
        self.last = None;
    }

    /// Adds the next frame of the trajectory.
    pub(super) fn add(&mut self, frame: &Frame<D>) {
        if self.radius == 0.0 {
            self.radius = connectivity_radius(&frame.position);
        }
        let position = frame.position.clone();
        let velocity = self.last.take().map(|last| {
            let velocity = differences(&last.position, &position);
            self.velocity.add(&velocity);
            if let Some(before) = last.velocity {
                self.acceleration.add(&differences(&before, &velocity));
            }
            velocity
        });
        self.last = Some(Last { position, velocity });
    }
}

fn differences<const D: usize>(before: &[[f32; D]], after: &[[f32; D]]) -> Vec<[f32; D]> {
    let pairs = before.iter().zip(after);
    pairs.map(|(a, b)| array::from_fn(|axis| b[axis] - a[axis])).collect()
}

#[derive(Debug)]
struct Moments<const D: usize> {
    count: f64,
    sum: [f64; D],
    squares: [f64; D],
}

impl<const D: usize> Default for Moments<D> {
    fn default() -> Self {
        Self { count: 0.0, sum: [0.0; D], squares: [0.0; D] }
    }
}

impl<const D: usize> Moments<D> {
    fn add(&mut self, vectors: &[[f32; D]]) {
        self.count += vectors.len() as f64;
        for vector in vectors {
            for (axis, &x) in vector.iter().enumerate() {
                self.sum[axis] += f64::from(x);
                self.squares[axis] += f64::from(x).powi(2);
            }
        }
    }

    fn mean_and_deviation(&self) -> ([f64; D], [f64; D]) {
        let mean = self.sum.map(|sum| sum / self.count.max(1.0));
        let deviation = |axis: usize| {
            let variance = self.squares[axis] / self.count.max(1.0) - mean[axis].powi(2);
            let deviation = variance.max(0.0).sqrt();
            if deviation < SMALLEST_DEVIATION { 1.0 } else { deviation }
        };
        (mean, array::from_fn(deviation))
    }
}

/// The median distance to the last of the [`neighbours`], rounded up to two significant digits.
fn connectivity_radius<const D: usize>(position: &[[f32; D]]) -> f64 {
    let step = position.len().div_ceil(SAMPLES);
    let mut radii: Vec<f64> = position
        .iter()
        .step_by(step)
        .map(|a| {
            let squared = |b: &[f32; D]| {
                f64::from((0..D).map(|axis| (b[axis] - a[axis]).powi(2)).sum::<f32>())
            };
            let mut distances: Vec<f64> = position.iter().map(squared).collect();
            // Rank 0 is the particle itself.
            let rank = neighbours::<D>().min(distances.len() - 1);
            distances.select_nth_unstable_by(rank, f64::total_cmp).1.sqrt()
        })
        .collect();
    let middle = radii.len() / 2;
    let median = *radii.select_nth_unstable_by(middle, f64::total_cmp).1;
    if median == 0.0 {
        return 0.0;
    }
    let digit = 10f64.powf(median.log10().floor() - 1.0);
    // To decimal digits: 0.023, not 0.023000000000000003.
    decimal(((median / digit).ceil() * digit) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scale(text: &str) -> Result<Scale, String> {
        Scale::parse("metadata.json".as_ref(), text).map_err(|error| error.to_string())
    }

    #[test]
    fn the_scale_stands_at_the_top_or_for_training_and_rollouts() {
        let one = r#"{"dt": 0.0025, "bounds": [[0.1, 0.9], [0.1, 0.8]], "sequence_length": 320}"#;
        let flat = scale(one).unwrap();
        assert_eq!(flat.interval(), 0.0025);
        let domain = Domain { lower: [0.1, 0.1], upper: [0.9, 0.8] };
        assert_eq!(flat.domain(), Some(domain.into()));
        for nested in [
            format!(r#"{{"train": {one}, "rollout": {one}}}"#),
            format!(r#"{{"train": {one}}}"#),
            format!(r#"{{"rollout": {one}}}"#),
        ] {
            assert_eq!(scale(&nested).unwrap(), flat, "{nested}");
        }
        let other = one.replace("0.0025", "0.005");
        let message = scale(&format!(r#"{{"train": {one}, "rollout": {other}}}"#)).unwrap_err();
        assert_eq!(
            message,
            "metadata.json: rollout.dt, bounds: found 0.005 s, 0.1 to 0.9 x 0.1 to 0.8, expected \
             0.0025 s, 0.1 to 0.9 x 0.1 to 0.8 as in train; --dt and --domain replace both"
        );
    }

    #[test]
    fn a_field_of_the_scale_that_cannot_be_used_is_named() {
        for (text, expected) in [
            ("{", "metadata.json: found no JSON ("),
            ("{}", "metadata.json: dt: found nothing, expected the seconds"),
            (r#"{"dt": [1]}"#, "metadata.json: dt: found [1], expected a positive number"),
            (r#"{"train": {"dt": -1}}"#, "metadata.json: train.dt: found -1, expected a positive"),
            (r#"{"dt": 1}"#, "metadata.json: bounds: found nothing, expected [[left,"),
            (
                r#"{"dt": 1, "bounds": [0, 1]}"#,
                "metadata.json: bounds: found [0,1], expected [[left",
            ),
            (
                r#"{"dt": 1, "bounds": [[0, 1]]}"#,
                "metadata.json: bounds: found [[0,1]], expected [[left",
            ),
        ] {
            let message = scale(text).unwrap_err();
            assert!(message.starts_with(expected), "{message}");
        }
    }

    #[test]
    fn the_radius_on_a_grid_is_that_of_lagrangebench() {
        let spacing = 0.01;
        let grid: Vec<[f32; 2]> =
            (0..900).map(|i| [(i % 30) as f32 * spacing, (i / 30) as f32 * spacing]).collect();
        assert_eq!(connectivity_radius(&grid), 0.015);
        assert_eq!(connectivity_radius(&[[0.5, 0.5]]), 0.0);
        let cubic: Vec<_> = (0..10)
            .flat_map(|z| grid.iter().map(move |&[x, y]| [x, y, z as f32 * spacing]))
            .collect();
        assert_eq!(connectivity_radius(&cubic), 0.015);
    }

    #[test]
    fn statistics_are_of_differences_between_frames() {
        let mut statistics = Statistics::<2>::default();
        // x = t^2 for one particle, at rest for the other: velocities 1, 3 and 0, 0.
        for t in 0..3u8 {
            let x = f32::from(t).powi(2);
            statistics.add(&Frame {
                stream: 0,
                sequence: t.into(),
                stamp: eddy_frames::Stamp(0),
                dt: 0.1,
                domain: Domain::UNIT,
                position: vec![[x, 0.0], [0.0, 0.0]],
                velocity: vec![[0.0; 2]; 2],
                material: vec![eddy_frames::Material::Snow; 2],
            });
        }
        let (mean, deviation) = statistics.velocity.mean_and_deviation();
        assert_eq!((mean, deviation), ([1.0, 0.0], [1.5f64.sqrt(), 1.0]));
        let (mean, deviation) = statistics.acceleration.mean_and_deviation();
        assert_eq!((mean, deviation), ([1.0, 0.0], [1.0, 1.0]));
    }
}
