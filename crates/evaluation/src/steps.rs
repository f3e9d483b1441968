//! Errors of one-step predictions, each made from the true frame before it.

use super::{
    errors::{difference, square},
    measure::{FlightSums, Flights},
};
use eddy_dataset::Stream;

/// Squared position errors of one-step predictions over the windows of the rollouts, for comparison with these: one
/// entry per frame ahead.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StepSums {
    /// Particles summed over.
    pub count: Vec<f64>,
    /// Sum of |r_k|^2, where r_k is the error of the frame k ahead of the start, predicted from the true
    /// frame before it (domain lengths squared).
    pub single: Vec<f64>,
    /// Sum of |r_1 + ... + r_k|^2: accumulated errors, as if the predicted steps were concatenated (domain lengths
    /// squared).
    pub cumulated: Vec<f64>,
}

impl StepSums {
    /// Zero sums for `horizon` frames ahead.
    pub fn new(horizon: usize) -> Self {
        let zero = || vec![0.0; horizon];
        Self { count: zero(), single: zero(), cumulated: zero() }
    }

    /// Adds the sums of other windows.
    pub fn merge(&mut self, other: &Self) {
        for (sums, others) in [
            (&mut self.count, &other.count),
            (&mut self.single, &other.single),
            (&mut self.cumulated, &other.cumulated),
        ] {
            sums.iter_mut().zip(others).for_each(|(sum, other)| *sum += other);
        }
    }

    /// Root mean square of |r_k| (domain lengths), one entry per frame ahead.
    pub fn single_rmse(&self) -> Vec<f64> {
        self.rmse(&self.single)
    }

    /// Root mean square of |r_1 + ... + r_k| (domain lengths), one entry per frame ahead.
    pub fn cumulated_rmse(&self) -> Vec<f64> {
        self.rmse(&self.cumulated)
    }

    fn rmse(&self, sums: &[f64]) -> Vec<f64> {
        sums.iter().zip(&self.count).map(|(sum, count)| (sum / count).sqrt()).collect()
    }
}

/// Errors of one-step predictions.
#[derive(Clone, Debug, PartialEq)]
pub struct StepResults {
    /// Position errors; `None` for predictors that only predict bodies in flight.
    pub steps: Option<StepSums>,
    /// Errors of bodies in free flight.
    pub flight: FlightSums,
}

/// Accumulates the errors of one-step predictions along a stream, for every open window and for bodies in free
/// flight.
pub(super) struct StepObserver<'a> {
    stream: &'a Stream,
    starts: &'a [usize],
    flights: &'a Flights,
    /// r_1 + ... + r_k of each window, `[N, 2]` once it is open.
    sums: Vec<Vec<[f64; 2]>>,
    steps: StepSums,
    flight: FlightSums,
}

impl<'a> StepObserver<'a> {
    /// Windows open after the frames `starts`.
    pub(super) fn new(
        stream: &'a Stream,
        starts: &'a [usize],
        flights: &'a Flights,
        horizon: usize,
    ) -> Self {
        let (sums, steps) = (vec![Vec::new(); starts.len()], StepSums::new(horizon));
        Self { stream, starts, flights, sums, steps, flight: FlightSums::default() }
    }

    /// The last frame of any window or flight that has a successor.
    pub(super) fn end(&self) -> usize {
        let horizon = self.steps.count.len();
        let window = self.starts.last().map_or(0, |start| start + horizon - 1);
        let flight = self.flights.frames().last().unwrap_or(0);
        window.max(flight).min(self.stream.states.len().saturating_sub(2))
    }

    /// Adds the prediction made from the true frame `index`, `[N, 2]` each. A position that is not finite counts as
    /// the position in frame `index`.
    pub(super) fn add(&mut self, index: usize, position: &[[f32; 2]], velocity: &[[f32; 2]]) {
        self.flights.add(index, position, velocity, &mut self.flight);
        let (last, truth) = (&self.stream.states[index], &self.stream.states[index + 1]);
        let horizon = self.steps.count.len();
        let error = |particle: usize| {
            let whole = position[particle].iter().all(|x| x.is_finite());
            let position = if whole { position[particle] } else { last.position[particle] };
            difference(position, truth.position[particle])
        };
        for (&start, sums) in self.starts.iter().zip(&mut self.sums) {
            let Some(ahead) = index.checked_sub(start).filter(|&ahead| ahead < horizon) else {
                continue;
            };
            sums.resize(truth.position.len(), [0.0; 2]);
            for (particle, sum) in sums.iter_mut().enumerate() {
                let [x, y] = error(particle);
                *sum = [sum[0] + x, sum[1] + y];
                self.steps.count[ahead] += 1.0;
                self.steps.single[ahead] += square([x, y]);
                self.steps.cumulated[ahead] += square(*sum);
            }
        }
    }

    /// The accumulated errors.
    pub(super) fn finish(self) -> StepResults {
        StepResults { steps: Some(self.steps), flight: self.flight }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use eddy_frames::{Domain, Material, Stamp, State};

    /// One particle with one position per frame.
    fn stream(places: &[f32]) -> Stream {
        let state = |&x: &f32| State { position: vec![[x, 0.0]], velocity: vec![[0.0; 2]] };
        Stream {
            id: 0,
            source: "test".into(),
            dt: 0.01,
            domain: Domain::UNIT,
            material: vec![Material::Jelly],
            first_sequence: 0,
            first_stamp: Stamp(0),
            stiffness: None,
            tools: None,
            states: places.iter().map(state).collect(),
        }
    }

    fn steps(stream: &Stream, starts: &[usize], predicted: f32, horizon: usize) -> StepSums {
        let flights = Flights::default();
        let mut observer = StepObserver::new(stream, starts, &flights, horizon);
        for index in 0..=observer.end() {
            observer.add(index, &[[predicted, 0.0]], &[[0.0; 2]]);
        }
        observer.finish().steps.unwrap()
    }

    #[test]
    fn a_constant_one_step_error_accumulates() {
        let sums = steps(&stream(&[0.25; 5]), &[0, 2], 0.5, 3);
        assert_eq!(sums.count, [2.0, 2.0, 1.0]);
        assert_eq!(sums.single_rmse(), [0.25; 3]);
        assert_eq!(sums.cumulated_rmse(), [0.25, 0.5, 0.75]);
    }

    #[test]
    fn a_prediction_of_nan_counts_as_no_movement() {
        assert_eq!(steps(&stream(&[1.0, 0.5]), &[0], f32::NAN, 1).single_rmse(), [0.5]);
    }
}
