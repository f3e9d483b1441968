use std::{collections::BTreeMap, fs};

use tempfile::TempDir;

use super::*;
use eddy_dataset::test_streams::simulated;
use eddy_frames::progress::Silent;
use eddy_inference::checkpoint::{Architecture, Core, Description, Sizes, initial_weights};
use eddy_mpm::{Extent, Preset};

/// Two streams of 13 frames.
fn truth() -> (TempDir, Vec<Trajectory>) {
    simulated(Extent::usual(Preset::Kinds), 2).unwrap()
}

/// A small network with random weights, which may be conditioned on the stiffness.
fn network(conditioned: bool) -> Checkpoint {
    let sizes = Sizes { encoder: 4, hidden: 4, layers: 1, particles: None };
    let mut description = Description::untrained(Architecture::Particle, Core::Mlp, sizes);
    description.stiffness = conditioned;
    description.normalization.minimum[2..].fill(-9.0);
    description.normalization.maximum[2..].fill(9.0);
    let mut tensors = initial_weights(&description, 1);
    tensors.get_mut("decoder.weight").unwrap().values.fill(0.1);
    Checkpoint::new(description, tensors)
}

#[test]
fn a_conditioned_checkpoint_takes_the_stiffness_of_each_scene_or_the_one_that_is_given() {
    let extent = Extent::usual(Preset::Kinds).with_stiffness([300.0, 3e5]).unwrap();
    let (_folder, mut streams) = simulated(extent, 2).unwrap();
    let request = |streams: &[Trajectory], stiffness| EvaluationRequest {
        checkpoints: vec![
            ("conditioned".to_owned(), network(true)),
            ("plain".to_owned(), network(false)),
        ],
        settings: Settings::errors_only(4, 2),
        join_late: true,
        stiffness,
        ..request(streams)
    };
    let skills = |request| {
        let report = evaluate(request).unwrap();
        let skills = report.predictors.into_iter().map(|one| (one.name, one.skill));
        skills.collect::<BTreeMap<_, _>>()
    };
    let own = skills(request(&streams, None));
    let given = skills(request(&streams, Some(1e4)));
    for (name, skill) in &own {
        // Also when it joins late.
        assert_eq!(*skill != given[name], name.starts_with("conditioned"), "{name}");
    }
    let both = [streams[0].stiffness.unwrap(), streams[1].stiffness.unwrap()];
    assert!(both[0] != both[1] && both.iter().all(|e| (300.0..=3e5).contains(e)), "{both:?}");
    streams.iter_mut().for_each(|stream| stream.stiffness = Some(1e4));
    assert_eq!(skills(request(&streams, None)), given);

    let rejection = |request| evaluate(request).unwrap_err().to_string();
    let message = rejection(request(&streams, Some(-1.0)));
    assert_eq!(message, "stiffness: found -1, expected a positive number");
    let plain = EvaluationRequest {
        checkpoints: vec![("plain".to_owned(), network(false))],
        stiffness: Some(1e4),
        ..self::request(&streams)
    };
    let expected = "stiffness: found 10000, expected nothing: no checkpoint is conditioned on it";
    assert_eq!(rejection(plain), expected);
    streams[1].stiffness = None;
    let message = rejection(request(&streams, None));
    assert!(message.contains("scene_0001: stream 1: stiffness: found nothing"), "{message}");
    assert!(
        message.ends_with("with this scene beside the bag, or `stiffness` given for all streams"),
        "{message}"
    );
}

fn request(streams: &[Trajectory]) -> EvaluationRequest {
    EvaluationRequest {
        checkpoints: vec![("models/shipped".to_owned(), Checkpoint::shipped().unwrap())],
        recorded: Vec::new(),
        streams: streams.to_vec(),
        stiffness: None,
        settings: Settings::errors_only(3, 2),
        references: Vec::new(),
        join_late: false,
        threads: NonZeroUsize::new(1),
    }
}

fn evaluate(request: EvaluationRequest) -> Result<Report, EvaluationError> {
    Evaluation::new(request, &Silent)?.run(&Silent)
}

/// The report without date and times.
fn content(mut report: Report) -> serde_json::Value {
    report.made = Provenance::default();
    let mut value = serde_json::to_value(report).unwrap();
    for kind in ["predictors", "groups"] {
        for entry in value[kind].as_array_mut().unwrap() {
            entry.as_object_mut().unwrap().retain(|key, _| key != "cost" && key != "ms");
        }
    }
    value
}

#[test]
fn the_report_does_not_depend_on_the_number_of_threads() {
    let (_folder, streams) = truth();
    let on = |threads| {
        let threads = NonZeroUsize::new(threads);
        content(evaluate(EvaluationRequest { threads, ..request(&streams) }).unwrap())
    };
    let one = on(1);
    assert_eq!((&one["streams"], &one["windows"]), (&2.into(), &4.into()));
    assert_eq!(one["predictors"][0]["name"], "shipped");
    assert!(one == on(2));
    // Reference solvers do not change the model's errors.
    let references = vec![Reference::Restart, Reference::Chaos];
    let with = evaluate(EvaluationRequest { references, ..request(&streams) }).unwrap();
    let names: Vec<_> = with.predictors.iter().map(|entry| entry.name.clone()).collect();
    assert!(names.iter().any(|name| name == chaos::NAME), "{names:?}");
    assert_eq!(content(with)["predictors"][0]["errors"], one["predictors"][0]["errors"]);
}

#[test]
fn streams_that_a_checkpoint_was_trained_on_are_excluded_with_a_remark() {
    let (_folder, streams) = truth();
    let mut seen = request(&streams);
    let known = &mut seen.checkpoints[0].1.description.training.seen;
    *known = [streams[0].fingerprint().unwrap()].into_iter().collect();
    let evaluation = Evaluation::new(seen.clone(), &Silent).unwrap();
    let remark = "a checkpoint was trained on 1 of the 2 streams: they are excluded";
    assert!(evaluation.remarks().iter().any(|said| said == remark));
    assert_eq!(evaluation.run(&Silent).unwrap().streams, 1);
    let both = streams.iter().map(|stream| stream.fingerprint().unwrap());
    seen.checkpoints[0].1.description.training.seen = both.collect();
    let error = evaluate(seen).unwrap_err();
    assert!(matches!(error, EvaluationError::Seen), "{error}");
}

#[test]
fn incompatible_requests_are_rejected_by_name() {
    let (_folder, streams) = truth();
    let usual = || request(&streams);
    let mut slower = usual();
    slower.checkpoints[0].1.description.dt = 0.02;
    for (request, words) in [
        (
            EvaluationRequest { settings: Settings::errors_only(0, 1), ..usual() },
            "horizon: found 0, expected at least 1 frame",
        ),
        (
            EvaluationRequest { settings: Settings::errors_only(1, 0), ..usual() },
            "starts: found 0, expected at least 1 per stream",
        ),
        (
            EvaluationRequest { threads: NonZeroUsize::new(1025), ..usual() },
            "threads: found 1025, expected 1 to 1024",
        ),
        (
            EvaluationRequest { checkpoints: Vec::new(), ..usual() },
            "checkpoints: found 0, expected at least 1",
        ),
        (
            EvaluationRequest { settings: Settings::errors_only(40, 1), ..usual() },
            "streams: the longest has 13 frames, expected at least 43",
        ),
        (slower, "scene_0000: stream 0: dt: found 0.016 s, expected 0.02 s"),
    ] {
        let error = evaluate(request).unwrap_err();
        assert!(error.to_string().contains(words), "{words}: {error}");
    }
}

#[test]
fn without_its_scene_a_stream_is_evaluated_without_solvers() {
    let (folder, streams) = truth();
    fs::remove_file(folder.path().join("manifest.json")).unwrap();
    let references = vec![Reference::Restart];
    let report = evaluate(EvaluationRequest { references, ..request(&streams) }).unwrap();
    assert!(report.notes[0].starts_with("no reference solvers: "), "{:?}", report.notes);
    assert!(report.predictors.iter().all(|entry| entry.role != Role::Solver));
}

/// The names of the predictors and the notes, after a change of the first scene's first body in the manifest.
fn with_references_and(change: impl FnOnce(&mut serde_json::Value)) -> (Vec<String>, Vec<String>) {
    let (folder, streams) = truth();
    let manifest = folder.path().join("manifest.json");
    let mut content: serde_json::Value =
        serde_json::from_slice(&fs::read(&manifest).unwrap()).unwrap();
    change(&mut content["scenes"][0]["scene"]["bodies"][0]);
    fs::write(&manifest, content.to_string()).unwrap();
    let references = vec![Reference::Restart, Reference::Chaos];
    let report = evaluate(EvaluationRequest { references, ..request(&streams) }).unwrap();
    (report.predictors.into_iter().map(|entry| entry.name).collect(), report.notes)
}

#[test]
fn streams_that_only_rounding_separates_from_their_scenes_have_restarted_solvers() {
    let scaled = |body: &mut serde_json::Value| {
        let speed = body["velocity"][1].as_f64().unwrap();
        body["velocity"][1] = (speed * (1.0 + 1e-5)).into();
    };
    let (names, notes) = with_references_and(scaled);
    assert!(names.iter().any(|name| name == "MPM restarted"), "{names:?}");
    assert!(!names.iter().any(|name| name == chaos::NAME), "{names:?}");
    let words = "scene_0000: simulating its scene gives other bits";
    assert!(
        notes.iter().any(|note| note.starts_with("no truth") && note.contains(words)),
        "{notes:?}"
    );

    let moved = |body: &mut serde_json::Value| body["position"][0] = 0.5.into();
    let (names, notes) = with_references_and(moved);
    assert!(!names.iter().any(|name| name.starts_with("MPM")), "{names:?}");
    let words = "no reference solvers: ";
    assert!(notes.iter().any(|note| note.starts_with(words)), "{notes:?}");
}

#[test]
fn a_cancelled_evaluation_has_no_report() {
    struct Cancelled;
    impl Progress for Cancelled {
        fn cancelled(&self) -> bool {
            true
        }
    }
    let (_folder, streams) = truth();
    let error = Evaluation::new(request(&streams), &Cancelled).map(|_| ()).unwrap_err();
    assert!(matches!(error, EvaluationError::Cancelled), "{error}");
    let evaluation = Evaluation::new(request(&streams), &Silent).unwrap();
    let error = evaluation.run(&Cancelled).unwrap_err();
    assert!(matches!(error, EvaluationError::Cancelled), "{error}");
}
