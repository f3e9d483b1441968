//! One scene judged: every predictor from the same frames.

use super::{
    Arena, ErrorSums, EvalError, Kind, Predictor, Rollout,
    measure::{BlowUps, Bulk, FlightSums, Flights, Physics, Rest, SHOWN, Window, most_energy},
    predictor::{Predicting, RolledOut},
    steps::{OnTheWay, StepSums},
};
use crate::dataset::Stream;
use eddy_frames::Material;
use eddy_mpm::Scene;

/// What one predictor came to in one scene, or in several.
#[derive(Clone, Debug)]
pub struct Tally {
    /// Errors of free rollouts.
    pub errors: ErrorSums,
    /// Errors of next frames, where they were predicted.
    pub steps: Option<StepSums>,
    /// What predictions of next frames did to bodies in free flight.
    pub flight: FlightSums,
    /// Physical measures at each of [`SHOWN`] within the horizon; none where they were not asked for.
    pub physics: Vec<Physics>,
    /// What all particles have together at each frame ahead; none where measures were not asked for.
    pub bulk: Vec<Bulk>,
    /// Rollouts.
    pub windows: usize,
    /// Rollouts that blew up.
    pub blow_ups: BlowUps,
    /// Why rollouts were lost, the first reason: they are among those that diverged.
    pub failure: Option<String>,
}

impl Tally {
    /// Nothing was predicted yet.
    pub fn new(arena: &Arena) -> Self {
        let shown = SHOWN.into_iter().filter(|&ahead| ahead <= arena.settings.horizon).count();
        let measured = |frames: usize| if arena.settings.measures { frames } else { 0 };
        Self {
            errors: ErrorSums::new(arena.settings.horizon, arena.units),
            steps: None,
            flight: FlightSums::default(),
            physics: vec![Physics::default(); measured(shown)],
            bulk: vec![Bulk::default(); measured(arena.settings.horizon)],
            windows: 0,
            blow_ups: BlowUps::default(),
            failure: None,
        }
    }

    /// Adds what the same predictor came to elsewhere.
    pub fn merge(&mut self, other: &Self) {
        self.errors.merge(&other.errors);
        match (&mut self.steps, &other.steps) {
            (Some(steps), Some(others)) => steps.merge(others),
            (steps @ None, others) => steps.clone_from(others),
            (Some(_), None) => {}
        }
        self.flight.merge(&other.flight);
        self.physics.iter_mut().zip(&other.physics).for_each(|(sum, other)| sum.merge(other));
        self.bulk.iter_mut().zip(&other.bulk).for_each(|(sum, other)| sum.merge(other));
        self.windows += other.windows;
        self.blow_ups.merge(&other.blow_ups);
        if self.failure.is_none() {
            self.failure.clone_from(&other.failure);
        }
    }
}

/// A judged scene.
#[derive(Clone, Debug)]
pub struct JudgedScene {
    /// The stream's number.
    pub id: u64,
    /// The bag that it was read from.
    pub name: String,
    /// The materials that occur.
    pub materials: Vec<Material>,
    /// The frames of the stream that rollouts start from, from 0.
    pub starts: Vec<usize>,
    /// What it is made of.
    pub kind: Kind,
    /// Rollouts of each predictor that have a true frame to be compared with, at each of [`SHOWN`] within
    /// the horizon.
    pub compared: Vec<usize>,
    /// What each predictor came to, in their order.
    pub tallies: Vec<Tally>,
}

impl JudgedScene {
    /// Rollouts of each predictor.
    pub fn windows(&self) -> usize {
        self.tallies.first().map_or(0, |tally| tally.windows)
    }
}

/// Lets every predictor roll out from the same frames of a stream. `scene` is what it was simulated
/// from, for rivals that need it. Without room for a window there is nothing but empty tallies.
///
/// # Errors
/// [`EvalError`] when a model cannot take the particles. The rollouts of a solver that fails have diverged.
pub fn judge_scene(
    arena: &Arena,
    predictors: &[Predictor<'_>],
    stream: &Stream,
    scene: Option<&Scene>,
) -> Result<JudgedScene, EvalError> {
    let (horizon, reach) = (arena.settings.horizon, arena.settings.reach);
    let starts = arena.starts(stream.states.len());
    let compared = |ahead: usize| {
        let last = stream.states.len().saturating_sub(1);
        starts.iter().filter(|&&start| start + ahead <= last).count()
    };
    let kind = Kind::of(&stream.material);
    let shown = SHOWN.into_iter().filter(|&ahead| ahead <= horizon);
    let compared: Vec<usize> = shown.map(compared).collect();
    let judged = |starts: Vec<usize>, tallies: Vec<Tally>| {
        let (id, name, materials) = (stream.id, stream.name(), stream.materials());
        JudgedScene { id, name, materials, starts, kind, compared, tallies }
    };
    if starts.is_empty() {
        return Ok(judged(starts, vec![Tally::new(arena); predictors.len()]));
    }
    let rest = arena.settings.measures.then(|| Rest::new(arena, stream));
    let most_energy = most_energy(arena, stream);
    let window = |&start: &usize| Window::new(arena, stream, start, rest.as_ref(), most_energy);
    let windows: Vec<Window> = starts.iter().map(window).collect();
    let flights = match rest {
        Some(_) => Flights::of(stream, &arena.ballistic, arena.spacing),
        None => Flights::default(),
    };
    let what = Predicting { stream, scene, starts: &starts, flights: &flights, horizon, reach };
    let judge = |predictor: &Predictor<'_>| {
        let mut tally = Tally::new(arena);
        let mut add = |number: usize, rollout: Rollout| {
            let window: &Window = &windows[number];
            tally.errors.add(&stream.material, &rollout.states, window.truth);
            if let Some(rest) = &rest {
                let sums = &mut tally.physics;
                window.measure(arena, &stream.material, rest, &rollout.states, sums);
                window.measure_bulk(arena, &rollout.states, &mut tally.bulk);
            }
            tally.windows += 1;
            window.count_blow_ups(&rollout, &mut tally.blow_ups);
        };
        let RolledOut { on_the_way, failure } = predictor.roll_out(arena, &what, &mut add)?;
        tally.failure = failure;
        if let Some(OnTheWay { steps, flight }) = on_the_way {
            (tally.steps, tally.flight) = (steps, flight);
        }
        Ok(tally)
    };
    let tallies = predictors.iter().map(judge).collect::<Result<_, EvalError>>()?;
    Ok(judged(starts, tallies))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        Baseline, Settings,
        dataset::{Bounds, State},
    };
    use eddy_frames::Stamp;
    use eddy_inference::{checkpoint::Checkpoint, kernels::spacing::spacing};
    use eddy_mpm::{self as mpm, Preset, Simulation};

    /// The first frames of a scene of liquid, as they are simulated.
    fn liquid(frames: usize) -> Stream {
        let scene = Scene::generate(Preset::Kinds, 5, 0);
        let mut simulation = Simulation::new(scene.clone(), &mpm::Settings::default()).unwrap();
        let frames: Vec<_> =
            (0..frames).map(|_| simulation.next_frame().unwrap().unwrap()).collect();
        Stream {
            id: scene.id,
            source: "test".into(),
            dt: scene.frames.interval,
            domain: frames[0].domain,
            material: frames[0].material.clone(),
            first_sequence: 0,
            first_stamp: Stamp(0),
            states: frames
                .into_iter()
                .map(|frame| State { position: frame.position, velocity: frame.velocity })
                .collect(),
        }
    }

    fn arena(stream: &Stream, settings: Settings) -> Arena {
        let description = Checkpoint::shipped().unwrap().description;
        let mut walls = Bounds::default();
        for x in stream.states.iter().flat_map(|state| &state.position) {
            walls.join(&Bounds { lower: *x, upper: *x });
        }
        let spacing = spacing(&stream.states[0].position);
        Arena::new(settings, &description, 1, stream.domain, walls, spacing)
    }

    #[test]
    fn a_stream_of_one_frame_has_nothing_to_judge() {
        let stream = liquid(1);
        let arena = arena(&stream, Settings::full(5, 3));
        let predictors = [Predictor::Baseline(Baseline::Ballistic), Predictor::Truth];
        let judged = judge_scene(&arena, &predictors, &stream, None).unwrap();
        assert_eq!((judged.windows(), judged.tallies.len()), (0, 2));
        assert_eq!(judged.compared, [0, 0]);
    }

    #[test]
    fn measures_find_nothing_wrong_with_the_truth_and_see_what_falls_through_the_floor() {
        let stream = liquid(120);
        let arena = arena(&stream, Settings::full(100, 4));
        let predictors = [Predictor::Truth, Predictor::Baseline(Baseline::ConstantVelocity)];
        let judged = judge_scene(&arena, &predictors, &stream, None).unwrap();
        assert_eq!(judged.windows(), 4);
        assert_eq!(judged.compared, [4, 4, 4, 4, 3, 1], "{:?}", arena.starts(120));
        let [truth, straight] = &judged.tallies[..] else { panic!() };

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
        // What keeps its velocity misses a whole g dt a frame.
        assert!((straight.flight.gain.value() - 1.0).abs() < 1e-3, "{:?}", straight.flight);
    }

    #[test]
    fn what_has_settled_is_found_and_the_way_of_who_leaves_it() {
        let mut stream = liquid(1);
        stream.states[0].velocity.fill([0.0, 0.1]);
        stream.states = vec![stream.states[0].clone(); 30];
        let arena = arena(&stream, Settings::full(20, 2));
        let predictors = [Predictor::Truth, Predictor::Baseline(Baseline::ConstantVelocity)];
        let judged = judge_scene(&arena, &predictors, &stream, None).unwrap();
        let at_ten = [0, 1].map(|number: usize| judged.tallies[number].physics[2].settled);
        assert_eq!(at_ten[0].weight, judged.compared[2] as f64);
        assert_eq!(at_ten[0].value(), 0.0);
        let way = f64::from(10.0 * 0.1 * arena.ballistic.dt);
        assert!((at_ten[1].value().sqrt() - way).abs() < 1e-5, "{at_ten:?}");
    }
}
