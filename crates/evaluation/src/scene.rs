//! Evaluation of one scene: every predictor from the same frames.

use super::{
    Context, ErrorSums, EvalError, Kind, Outcome, Predictor, Rollout,
    measure::{
        BlowUps, Bulk, FlightSums, Flights, Physics, RestGeometry, SHOWN_FRAMES, Settled,
        TruthWindow, energy_limit,
    },
    predictor::RolloutOutcome,
    steps::{StepResults, StepSums},
    task::RolloutTask,
};
use eddy_dataset::Stream;
use eddy_frames::Material;
use eddy_mpm::Scene;

/// Accumulated errors and measures of one predictor, over one or several scenes.
#[derive(Clone, Debug)]
pub struct Accumulator {
    /// Errors of free rollouts.
    pub errors: ErrorSums,
    /// Errors of one-step predictions, for predictors that make them.
    pub steps: Option<StepSums>,
    /// Errors of one-step predictions of bodies in free flight.
    pub flight: FlightSums,
    /// Estimates of the errors of the rollouts, for models that make them.
    pub estimates: Vec<Outcome>,
    /// Physical measures at each of [`SHOWN_FRAMES`] within the horizon; empty if not requested.
    pub physics: Vec<Physics>,
    /// Bulk quantities at each frame ahead; empty if not requested.
    pub bulk: Vec<Bulk>,
    /// Number of rollouts.
    pub windows: usize,
    /// Rollouts that blew up.
    pub blow_ups: BlowUps,
    /// The first reason why rollouts failed; these count as diverged.
    pub failure: Option<String>,
}

impl Accumulator {
    /// Empty sums.
    pub fn new(context: &Context) -> Self {
        let shown =
            SHOWN_FRAMES.into_iter().filter(|&ahead| ahead <= context.settings.horizon).count();
        let measured = |frames: usize| if context.settings.measures { frames } else { 0 };
        Self {
            errors: ErrorSums::new(context.settings.horizon, context.units),
            steps: None,
            flight: FlightSums::default(),
            estimates: Vec::new(),
            physics: vec![Physics::default(); measured(shown)],
            bulk: vec![Bulk::default(); measured(context.settings.horizon)],
            windows: 0,
            blow_ups: BlowUps::default(),
            failure: None,
        }
    }

    /// Adds the sums of the same predictor over other scenes.
    pub fn merge(&mut self, other: &Self) {
        self.errors.merge(&other.errors);
        match (&mut self.steps, &other.steps) {
            (Some(steps), Some(others)) => steps.merge(others),
            (steps @ None, others) => steps.clone_from(others),
            (Some(_), None) => {}
        }
        self.flight.merge(&other.flight);
        self.estimates.extend(&other.estimates);
        self.physics.iter_mut().zip(&other.physics).for_each(|(sum, other)| sum.merge(other));
        self.bulk.iter_mut().zip(&other.bulk).for_each(|(sum, other)| sum.merge(other));
        self.windows += other.windows;
        self.blow_ups.merge(&other.blow_ups);
        if self.failure.is_none() {
            self.failure.clone_from(&other.failure);
        }
    }
}

/// Results of one scene.
#[derive(Clone, Debug)]
pub struct SceneResult {
    /// The stream's number.
    pub id: u64,
    /// Name of its bag.
    pub name: String,
    /// The materials that occur.
    pub materials: Vec<Material>,
    /// The frames of the stream that rollouts start from, from 0.
    pub starts: Vec<usize>,
    /// The kind of the scene.
    pub kind: Kind,
    /// Rollouts of each predictor with a true frame at each of [`SHOWN_FRAMES`] within the horizon.
    pub compared: Vec<usize>,
    /// Frames ahead up to which every rollout has a true frame.
    pub complete: usize,
    /// One per predictor.
    pub accumulators: Vec<Accumulator>,
    /// What becomes of the stream in a long rollout of each predictor; empty if it is too short or measures are not requested.
    pub settled: Vec<Option<Settled>>,
}

impl SceneResult {
    /// Rollouts of each predictor.
    pub fn windows(&self) -> usize {
        self.accumulators.first().map_or(0, |accumulator| accumulator.windows)
    }
}

/// Lets every predictor roll out from the same frames of a stream. `scene` is the scene that it was simulated from,
/// which reference solvers need. For a stream without room for a rollout, the accumulators are empty.
///
/// # Errors
/// [`EvalError`] when a model does not support the particles. Rollouts of a solver that fails count as diverged.
pub fn evaluate_scene(
    context: &Context,
    predictors: &[Predictor<'_>],
    stream: &Stream,
    scene: Option<&Scene>,
) -> Result<SceneResult, EvalError> {
    let (horizon, reach) = (context.settings.horizon, context.settings.reach);
    let starts = context.starts(stream.states.len());
    let compared = |ahead: usize| {
        let last = stream.states.len().saturating_sub(1);
        starts.iter().filter(|&&start| start + ahead <= last).count()
    };
    let kind = Kind::of(&stream.material);
    let shown = SHOWN_FRAMES.into_iter().filter(|&ahead| ahead <= horizon);
    let compared: Vec<usize> = shown.map(compared).collect();
    let after_last = stream.states.len().saturating_sub(1 + starts.iter().max().unwrap_or(&0));
    let complete = after_last.min(horizon);
    let result = |starts: Vec<usize>, accumulators: Vec<Accumulator>, settled| {
        let (id, name, materials) = (stream.id, stream.name(), stream.materials());
        SceneResult { id, name, materials, starts, kind, compared, complete, accumulators, settled }
    };
    if starts.is_empty() {
        let empty = vec![Accumulator::new(context); predictors.len()];
        return Ok(result(starts, empty, Vec::new()));
    }
    let rest = context.settings.measures.then(|| RestGeometry::new(context, stream));
    let energy_limit = energy_limit(context, stream);
    let window =
        |&start: &usize| TruthWindow::new(context, stream, start, rest.as_ref(), energy_limit);
    let windows: Vec<TruthWindow> = starts.iter().map(window).collect();
    let flights = match rest {
        Some(_) => Flights::of(stream, &context.ballistic, context.spacing),
        None => Flights::default(),
    };
    let task = RolloutTask { stream, scene, starts: &starts, flights: &flights, horizon, reach };
    let evaluate = |predictor: &Predictor<'_>| {
        let mut accumulator = Accumulator::new(context);
        let mut add = |number: usize, rollout: Rollout| {
            let window: &TruthWindow = &windows[number];
            accumulator.errors.add(&stream.material, &rollout.states, window.truth);
            if let Some(rest) = &rest {
                let sums = &mut accumulator.physics;
                window.measure(context, &stream.material, rest, &rollout.states, sums);
                window.measure_bulk(context, &rollout.states, &mut accumulator.bulk);
            }
            accumulator.windows += 1;
            window.count_blow_ups(&rollout, &mut accumulator.blow_ups);
        };
        let RolloutOutcome { step_results, estimates, failure } =
            predictor.roll_out(context, &task, &mut add)?;
        (accumulator.estimates, accumulator.failure) = (estimates, failure);
        if let Some(StepResults { steps, flight }) = step_results {
            (accumulator.steps, accumulator.flight) = (steps, flight);
        }
        Ok(accumulator)
    };
    let accumulators = predictors.iter().map(evaluate).collect::<Result<_, EvalError>>()?;
    let settled = match context.settings.measures && Settled::has_room(stream) {
        true => {
            let measure = |predictor| Settled::measure(context, predictor, stream);
            predictors.iter().map(measure).collect::<Result<_, EvalError>>()?
        }
        false => Vec::new(),
    };
    Ok(result(starts, accumulators, settled))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        Settings,
        test_streams::{context, first_frames},
    };
    use eddy_inference::engine::Baseline;
    use eddy_mpm::Preset;

    /// The first frames of a scene of liquid, as they are simulated.
    fn liquid(frames: usize) -> Stream {
        first_frames(&Scene::generate(Preset::Kinds, 5, 0), frames)
    }

    #[test]
    fn a_stream_of_one_frame_has_no_rollouts() {
        let stream = liquid(1);
        let context = context(&stream, Settings::full(5, 3));
        let predictors = [Predictor::Baseline(Baseline::Ballistic), Predictor::Truth];
        let result = evaluate_scene(&context, &predictors, &stream, None).unwrap();
        assert_eq!((result.windows(), result.accumulators.len()), (0, 2));
        assert_eq!(result.compared, [0, 0]);
    }

    #[test]
    fn measures_are_perfect_for_the_truth_and_detect_a_fall_through_the_floor() {
        let stream = liquid(120);
        let context = context(&stream, Settings::full(100, 4));
        let predictors = [Predictor::Truth, Predictor::Baseline(Baseline::ConstantVelocity)];
        let result = evaluate_scene(&context, &predictors, &stream, None).unwrap();
        assert_eq!(result.windows(), 4);
        assert_eq!(result.compared, [4, 4, 4, 4, 3, 1], "{:?}", context.starts(120));
        let last_start = context.starts(120).into_iter().max().unwrap();
        assert_eq!(result.complete, 119 - last_start);
        let [truth, straight] = &result.accumulators[..] else { panic!() };

        assert_eq!(truth.blow_ups, BlowUps::default());
        for physics in &truth.physics {
            assert_eq!(physics.misplaced.value(), 0.0);
            assert_eq!(physics.kinetic_energy.value(), 0.0);
            assert_eq!(physics.centre.value(), 0.0);
            assert_eq!(physics.liquid_area.value(), 1.0);
            assert_eq!(physics.liquid_area_off.value(), 0.0);
        }
        assert!(truth.flight.gain.weight > 0.0 && truth.flight.worst_gain < 1e-3, "{truth:?}");

        assert!(straight.blow_ups.far_off > 0, "{:?}", straight.blow_ups);
        assert_eq!(straight.blow_ups.diverged, 0);
        let last = straight.physics.last().unwrap();
        assert!(last.misplaced.value() > 0.5 && last.outside.value() > 0.5, "{last:?}");
        // A constant velocity misses g dt per frame.
        assert!((straight.flight.gain.value() - 1.0).abs() < 1e-3, "{:?}", straight.flight);
    }

    #[test]
    fn settled_windows_are_found_with_the_displacement_of_a_predictor() {
        let mut stream = liquid(1);
        stream.states[0].velocity.fill([0.0, 0.1]);
        stream.states = vec![stream.states[0].clone(); 30];
        let context = context(&stream, Settings::full(20, 2));
        let predictors = [Predictor::Truth, Predictor::Baseline(Baseline::ConstantVelocity)];
        let result = evaluate_scene(&context, &predictors, &stream, None).unwrap();
        let at_ten = [0, 1].map(|number: usize| result.accumulators[number].physics[2].settled);
        assert_eq!(at_ten[0].weight, result.compared[2] as f64);
        assert_eq!(at_ten[0].value(), 0.0);
        let displacement = f64::from(10.0 * 0.1 * context.ballistic.dt);
        assert!((at_ten[1].value().sqrt() - displacement).abs() < 1e-5, "{at_ten:?}");
    }
}
