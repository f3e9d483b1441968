//! `eddy eval`: what is judged, what is refused, what is said.

use std::{fs, path::Path};

use eddy_dataset::{LoadOptions, Trajectory};
use eddy_evaluation::Report;
use eddy_inference::checkpoint::{
    Architecture, Checkpoint, Core, Description, Rules, Sizes, initial_weights,
};
use eddy_pages::Provenance;
use serde_json::Value;
use tempfile::TempDir;

use crate::support::{fail, is_a_page_of_its_own, simulate, succeed};

const SHIPPED: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/checkpoints/particle-mingru");

fn path(folder: &TempDir, name: &str) -> String {
    folder.path().join(name).to_str().unwrap().to_owned()
}

fn report(folder: &TempDir) -> Value {
    let text = fs::read_to_string(folder.path().join("report/report.json")).unwrap();
    serde_json::from_str(&text).unwrap()
}

fn names(report: &Value) -> Vec<&str> {
    let predictors = report["predictors"].as_array().unwrap();
    predictors.iter().map(|predictor| predictor["name"].as_str().unwrap()).collect()
}

/// The shipped checkpoint, changed, under another name.
fn changed(folder: &TempDir, name: &str, change: impl FnOnce(&mut Description)) -> String {
    let mut checkpoint = Checkpoint::load(Path::new(SHIPPED)).unwrap();
    change(&mut checkpoint.description);
    checkpoint.save(&folder.path().join(name)).unwrap();
    path(folder, name)
}

#[test]
#[expect(clippy::too_many_lines, reason = "one story: an evaluation and its report")]
fn seeds_and_rivals_are_judged_side_by_side_on_the_same_frames() {
    let folder = tempfile::tempdir().unwrap();
    let (data, output) = (path(&folder, "truth"), path(&folder, "report"));
    simulate(&folder.path().join("truth"), 1, 0.2);
    let seed = changed(&folder, "another", |description| description.training.seed = 77);

    let mut arguments = vec!["eval", "--checkpoint", SHIPPED, &seed, "--data", &data];
    arguments.extend(["--output", &output, "--horizon", "5", "--starts", "2", "--threads", "2"]);
    arguments.extend(["--references", "mpm,chaos", "--join-late"]);
    let printed = succeed(arguments);
    assert!(printed.contains("particle mingru, mean of 2 seeds"), "{printed}");

    let report = report(&folder);
    let expected = [
        "particle-mingru",
        "another",
        "particle-mingru, joined late",
        "another, joined late",
        "persistence",
        "constant velocity",
        "ballistic with walls",
        "mean of the training",
        "linear fit",
        "MPM restarted",
        "MPM restarted, half the substeps",
        "MPM restarted, half the grid",
        "MPM restarted, a quarter of the grid",
        "truth displaced by 1e-4",
        "truth",
    ];
    assert_eq!(names(&report), expected);
    assert_eq!((&report["windows"], &report["reach"]), (&Value::from(2), &Value::from(200)));
    let number = |name: &str| expected.iter().position(|&other| other == name).unwrap();
    let (baseline, truth) = (number("mean of the training"), number("truth"));
    let (restarted, displaced) = (number("MPM restarted"), number("truth displaced by 1e-4"));
    let skill = |number: usize| report["predictors"][number]["skill"][4].as_f64().unwrap();
    assert_eq!(skill(0), skill(1), "the same weights");
    assert!(skill(restarted) > 0.5, "it knows the law: {}", skill(restarted));
    assert!(skill(displaced) > 0.99, "forgiven for five frames: {}", skill(displaced));
    assert_eq!(skill(truth), 1.0, "the truth makes no error");
    for number in [0, restarted, displaced] {
        let cost = report["predictors"][number]["cost"]["p50"].as_f64().unwrap();
        assert!(cost > 0.0, "{number}");
    }
    let group = &report["groups"][0];
    assert_eq!(group["members"].as_array().unwrap().len(), 2);
    assert_eq!(group["spread"][4], 0.0);
    assert_eq!(group["kinds"][0][1]["spread"][4], 0.0);
    assert!(group["skill_intervals"].is_null(), "one scene says nothing about others");
    assert!(group["ms"].as_f64().unwrap() > 0.0);
    assert_eq!(report["compared"], serde_json::json!([2, 1]));
    // The verdict says in words what the numbers say.
    let said = printed.split_whitespace().collect::<Vec<_>>().join(" ");
    let at = |ahead: usize| report["predictors"][0]["skill"][ahead - 1].as_f64().unwrap();
    assert!(at(1) > 0.0 && at(5) > 0.0, "the shipped model is better than trivial");
    let of_solver = |ahead: usize| &report["predictors"][restarted]["skill"][ahead - 1];
    let is_behind = |&ahead: &usize| of_solver(ahead).as_f64().unwrap() > at(ahead);
    let behind: Vec<String> = [1, 5].into_iter().filter(is_behind).map(|k| k.to_string()).collect();
    let solver = format!("MPM restarted at frame {}", behind.join(", "));
    for words in [
        format!("skill {:+.2} at frame 1, {:+.2} at frame 5.", at(1), at(5)).as_str(),
        "None of 2 rollouts blows up",
        "Best of 2: ",
        "Too few scenes for an interval",
        if behind.is_empty() { "" } else { &solver },
    ] {
        assert!(said.contains(words), "no {words} in {printed}");
    }
    let cost = &report["predictors"][restarted]["cost"];
    assert_eq!(cost["kinds"][0]["p50"], cost["p50"], "one kind");
    let plot = fs::read(folder.path().join("report/cost_error.png")).unwrap();
    assert!(plot.starts_with(b"\x89PNG"));

    let scene = &report["scenes"][0];
    assert_eq!(
        (&scene["id"], &scene["errors"].as_array().unwrap().len()),
        (&0.into(), &expected.len())
    );
    let of = |what: &str, number: usize| -> f64 {
        report["predictors"][number][what][4].as_f64().unwrap()
    };
    // The only scene is all there is.
    assert_eq!(scene["errors"][2]["zscore_mse"][4], report["predictors"][2]["zscore_mse"][4]);
    assert_eq!(of("kinetic_energy", 0), of("kinetic_energy", 1));
    assert_eq!(of("centre_rmse", truth), 0.0);
    assert!(of("kinetic_energy", truth) > 0.0 && of("zscore_mse", baseline) > 0.0);

    let html = fs::read_to_string(folder.path().join("report/report.html")).unwrap();
    is_a_page_of_its_own(&html);
    for words in [
        "Scene by scene",
        "MinMax MSE, mean of frames 1 to 5",
        "One-step, accumulated and free-rollout error",
        "Physical consistency",
        "Kinetic energy per mass",
        "Truth and prediction",
        "Inference time",
        "Reproduce",
        "--references mpm,chaos --join-late",
        report["data_digest"].as_str().unwrap(),
        report["predictors"][1]["digest"].as_str().unwrap(),
    ] {
        assert!(html.contains(words) || html.contains(&words.replace("&#39;", "'")), "no {words}");
    }
    // Truth, two models and a solver, one and five frames ahead.
    assert_eq!(html.matches("<img src=\"data:image/png;base64,").count(), 4 * 2);

    let csv = fs::read_to_string(folder.path().join("report/curves.csv")).unwrap();
    let header = csv.lines().next().unwrap().split(',').count();
    for row in csv.lines().skip(1) {
        // Names may have commas.
        let (_, rest) = row.rsplit_once('"').unwrap();
        assert_eq!(rest.split(',').count(), header, "{row}");
    }
    // One kind and all of them, five frames each.
    assert_eq!(csv.lines().count(), 1 + expected.len() * 2 * 5);
}

#[test]
fn a_checkpoint_without_some_rules_has_another_name_digest_and_error() {
    let folder = tempfile::tempdir().unwrap();
    let data = path(&folder, "truth");
    simulate(&folder.path().join("truth"), 1, 0.3);
    let bare = changed(&folder, "bare", |description| description.rules = Rules::default());
    let arguments = |checkpoint: &str, output: &str, more: &[&str]| {
        let all = ["eval", "--checkpoint", checkpoint, "--data", &data, "--output", output];
        let all = all.iter().chain(&["--horizon", "5", "--starts", "2"]).chain(more);
        all.map(|word| (*word).to_owned()).collect::<Vec<_>>()
    };
    let output = path(&folder, "report");
    let entry = |checkpoint: &str, more: &[&str]| {
        if Path::new(&output).exists() {
            fs::remove_dir_all(&output).unwrap();
        }
        succeed(arguments(checkpoint, &output, more));
        report(&folder)["predictors"][0].clone()
    };
    let whole = entry(SHIPPED, &[]);
    let off = entry(SHIPPED, &["--without-rules", "rest", "area"]);
    assert_eq!(whole["name"], "particle-mingru");
    assert_eq!(off["name"], "particle-mingru without area, rest", "in the order in which they run");
    assert_ne!(off["digest"], whole["digest"]);
    let all = ["--without-rules", "elastic,area,shape,flight,rest"];
    let (none, never) = (entry(SHIPPED, &all), entry(&bare, &[]));
    assert_eq!(none["digest"], never["digest"], "switched off is as never there");
    assert_eq!(none["skill"], never["skill"]);
    assert_ne!(none["skill"], whole["skill"]);

    let output = path(&folder, "refused");
    let message = fail(1, arguments(&bare, &output, &["--without-rules", "area"]));
    assert!(
        message.contains("--without-rules: none of the checkpoints has the rule area"),
        "{message}"
    );
    let message = fail(2, arguments(SHIPPED, &output, &["--without-rules", "aera"]));
    assert!(message.contains("a similar value exists: 'area'"), "{message}");
}

#[test]
fn scenes_in_a_wider_domain_than_the_checkpoints_are_judged_in_their_own() {
    let folder = tempfile::tempdir().unwrap();
    let (data, output) = (path(&folder, "truth"), path(&folder, "report"));
    let scenes = ["simulate", "--preset", "kinds", "--particles", "10000", "--output", &data];
    succeed([scenes.as_slice(), &["--duration", "0.2"]].concat());
    let mut arguments = vec!["eval", "--checkpoint", SHIPPED, "--data", &data, "--output", &output];
    arguments.extend(["--horizon", "2", "--starts", "1", "--references", "mpm"]);
    succeed(arguments);
    let report = report(&folder);
    let predictors = report["predictors"].as_array().unwrap();
    for name in ["ballistic with walls", "MPM restarted", "truth"] {
        let number = names(&report).iter().position(|found| *found == name).unwrap();
        // Three quarters of the particles are outside the domain of the checkpoint.
        assert_eq!(predictors[number]["blow_ups"]["any"], 0, "{name}");
    }
    assert!(report["walls"][1][0].as_f64().unwrap() > 3.0, "{}", report["walls"]);
}

#[test]
fn without_a_manifest_there_are_no_rivals_and_that_is_said() {
    let folder = tempfile::tempdir().unwrap();
    let (data, output) = (path(&folder, "truth"), path(&folder, "report"));
    simulate(&folder.path().join("truth"), 1, 0.2);
    fs::remove_file(folder.path().join("truth/manifest.json")).unwrap();

    let mut arguments = vec!["eval", "--checkpoint", SHIPPED, "--data", &data, "--output", &output];
    arguments.extend(["--horizon", "2", "--starts", "1", "--references", "mpm,chaos"]);
    let printed = succeed(arguments);
    for words in ["no reference solvers", "scene_0000", "manifest.json"] {
        assert!(printed.contains(words), "`{words}` is not in: {printed}");
    }
    assert_eq!(names(&report(&folder)).len(), 7);
}

#[test]
fn a_grid_that_cannot_be_halved_leaves_out_that_rival_only() {
    let folder = tempfile::tempdir().unwrap();
    let (data, output) = (path(&folder, "truth"), path(&folder, "report"));
    let scene = path(&folder, "odd.toml");
    let words = r#"
        domain = [1.015625, 1.0]
        [[bodies]]
        material = "liquid"
        shape.rectangle.size = [0.2, 0.2]
        position = [0.5, 0.3]
    "#;
    fs::write(&scene, words).unwrap();
    succeed(["simulate", "--scene", &scene, "--output", &data, "--duration", "0.2"]);
    let mut arguments = vec!["eval", "--checkpoint", SHIPPED, "--data", &data, "--output", &output];
    arguments.extend(["--horizon", "2", "--starts", "1", "--references", "mpm"]);
    let printed = succeed(arguments.clone());
    let note = "no MPM restarted, half the grid";
    assert!(printed.contains(note) && printed.contains("[65, 64] cells"), "{printed}");
    let report = report(&folder);
    assert!(report["notes"][0].as_str().unwrap().starts_with(note), "{}", report["notes"]);
    let found = names(&report);
    assert!(found.contains(&"MPM restarted, half the substeps"), "{found:?}");
    assert!(!found.contains(&"MPM restarted, half the grid"), "{found:?}");
    assert!(!found.contains(&"MPM restarted, a quarter of the grid"), "{found:?}");

    // 66 cells can be halved once.
    fs::write(&scene, words.replace("1.015625", "1.03125")).unwrap();
    succeed(["simulate", "--scene", &scene, "--output", &data, "--duration", "0.2", "--force"]);
    arguments.push("--force");
    let printed = succeed(arguments);
    assert!(printed.contains("numbers of cells divisible by 4"), "{printed}");
    let report = self::report(&folder);
    let found = names(&report);
    assert!(found.contains(&"MPM restarted, half the grid"), "{found:?}");
    assert!(!found.contains(&"MPM restarted, a quarter of the grid"), "{found:?}");
}

/// The streams of a bag or a directory of bags.
fn streams(data: &str) -> Vec<Trajectory> {
    let options = LoadOptions::within(u64::MAX);
    eddy_dataset::load_trajectories(&[data.into()], options, &mut |_, _| ()).unwrap().streams
}

#[test]
fn data_without_a_scene_that_the_checkpoint_has_not_seen_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let (data, output) = (path(&folder, "truth"), path(&folder, "report"));
    simulate(&folder.path().join("truth"), 1, 0.2);
    let digest = eddy_dataset::digest(&streams(&data), |_| ()).unwrap();
    let seen = changed(&folder, "seen", |description| description.data = digest);
    let message = fail(1, ["eval", "--checkpoint", &seen, "--data", &data, "--output", &output]);
    assert!(message.contains("every stream was used to train a checkpoint"), "{message}");
}

#[test]
fn a_stream_that_a_checkpoint_has_learned_from_is_left_out_wherever_it_is_found() {
    let folder = tempfile::tempdir().unwrap();
    let (data, output) = (path(&folder, "truth"), path(&folder, "report"));
    simulate(&folder.path().join("truth"), 2, 0.2);
    let known = streams(&data)[1].fingerprint().unwrap();
    let seen = changed(&folder, "seen", |description| {
        description.training.seen = [known].into_iter().collect()
    });
    let judge = |data: &str| {
        let arguments = ["eval", "--checkpoint", &seen, "--data", data, "--output", &output];
        let arguments = arguments.into_iter().chain(["--horizon", "2", "--starts", "1"]);
        arguments.map(str::to_owned).collect::<Vec<_>>()
    };
    let printed = succeed(judge(&data));
    let words = "a checkpoint was trained on 1 of the 2 streams: they are excluded";
    assert!(printed.contains(words), "{printed}");
    assert!(printed.contains("1 free rollout over 1 stream, compared for 2 frames"), "{printed}");
    assert!(printed.contains("report.html") && !printed.contains("MinMax"), "{printed}");
    assert!(printed.lines().all(|line| line.chars().count() <= 80), "{printed}");
    // An existing report is only replaced if asked for.
    let message = fail(1, judge(&data));
    assert!(message.contains("report: already exists; choose another --output"), "{message}");
    let again = judge(&data).into_iter().chain(["--force".to_owned(), "--tables".to_owned()]);
    let printed = succeed(again);
    assert!(printed.contains("MinMax MSE"), "{printed}");
    assert!(printed.lines().all(|line| line.chars().count() <= 80), "{printed}");
    fs::remove_dir_all(&output).unwrap();
    let message = fail(1, judge(&format!("{data}/scene_0001")));
    assert!(message.contains("every stream was used to train a checkpoint"), "{message}");
}

#[test]
fn data_that_a_checkpoint_was_not_made_for_is_refused_before_anything_is_predicted() {
    let folder = tempfile::tempdir().unwrap();
    let (data, output) = (path(&folder, "truth"), path(&folder, "report"));
    simulate(&folder.path().join("truth"), 1, 0.2);
    let slower = changed(&folder, "slower", |description| description.dt = 0.02);
    let wider = changed(&folder, "wider", |description| description.domain.upper = [2.0; 2]);
    let barren = changed(&folder, "barren", |description| description.materials.truncate(1));
    let sizes = Sizes { encoder: 8, hidden: 16, layers: 1, particles: Some(10) };
    let few = Description::untrained(Architecture::Frame, Core::Mlp, sizes);
    let few = Checkpoint::new(few.clone(), initial_weights(&few, 1));
    few.save(&folder.path().join("few")).unwrap();
    let few = path(&folder, "few");

    for (checkpoint, words) in [
        (&slower, ["slower", "scene_0000", "dt: found 0.016 s, expected 0.02 s"]),
        (&wider, ["wider", "scene_0000", "lower, upper: found 0 to 1 x 0 to 1"]),
        (&barren, ["barren", "scene_0000", "expected one of liquid"]),
        (&few, ["few", "scene_0000", "particles: found 2500, expected 10"]),
    ] {
        let mut arguments = vec!["eval", "--checkpoint", SHIPPED, checkpoint, "--data", &data];
        arguments.extend(["--output", &output, "--horizon", "2"]);
        let message = fail(1, arguments);
        for word in words {
            assert!(message.contains(word), "`{word}` is not in: {message}");
        }
        assert!(!Path::new(&output).exists());
    }
}

#[test]
fn streams_shorter_than_the_horizon_are_named_with_what_is_needed() {
    let folder = tempfile::tempdir().unwrap();
    let (data, output) = (path(&folder, "truth"), path(&folder, "report"));
    simulate(&folder.path().join("truth"), 1, 0.1);
    let message = fail(1, ["eval", "--checkpoint", SHIPPED, "--data", &data, "--output", &output]);
    assert!(message.contains("the longest has 6 frames, expected at least"), "{message}");
}

/// Judges the shipped checkpoint, quickly.
fn judge(data: &str, output: &str, horizon: &str) {
    let arguments = ["eval", "--checkpoint", SHIPPED, "--data", data, "--output", output];
    succeed(arguments.into_iter().chain(["--horizon", horizon, "--starts", "1"]));
}

#[test]
fn the_gain_of_a_model_over_the_first_has_an_interval_over_scenes() {
    let folder = tempfile::tempdir().unwrap();
    let (data, output) = (path(&folder, "truth"), path(&folder, "report"));
    let scenes = ["--preset", "fluid", "--scenes", "5", "--duration", "0.2", "--output", &data];
    succeed(["simulate"].iter().chain(&scenes));
    // Another network, with random weights.
    let sizes = Sizes { encoder: 4, hidden: 4, layers: 1, particles: None };
    let mut description = Description::untrained(Architecture::Particle, Core::Mlp, sizes);
    description.normalization.minimum[2..].fill(-9.0);
    description.normalization.maximum[2..].fill(9.0);
    let weights = initial_weights(&description, 1);
    let other = path(&folder, "other");
    Checkpoint::new(description, weights).save(Path::new(&other)).unwrap();
    let mut arguments = vec!["eval", "--checkpoint", SHIPPED, &other, "--data", &data];
    arguments.extend(["--output", &output, "--horizon", "5", "--starts", "2", "--threads", "2"]);
    let printed = succeed(arguments);
    assert!(printed.contains("gain over the first model"), "{printed}");

    let report = report(&folder);
    let [first, second] = [0, 1].map(|number| &report["groups"][number]);
    assert!(first["gain"].is_null(), "{first}");
    let number = |value: &Value| value.as_f64().unwrap();
    let gain = &second["gain"];
    let expected = number(&second["skill"][4]) - number(&first["skill"][4]);
    assert!((number(&gain["gain"][4]) - expected).abs() < 1e-6, "{expected}: {gain}");
    let interval = &gain["gain_intervals"][1];
    let [lower, upper] = ["lower", "upper"].map(|end| number(&interval[end]));
    assert!(lower < expected && expected < upper, "{lower} to {upper}: {expected}");
}

#[test]
fn reports_of_the_same_data_are_compared_and_what_differs_is_said() {
    let folder = tempfile::tempdir().unwrap();
    let [data, other, a, b, c, html] =
        ["truth", "other", "a", "b", "c", "compared.html"].map(|name| path(&folder, name));
    simulate(&folder.path().join("truth"), 1, 0.2);
    succeed(["simulate", "--scenes", "1", "--seed", "9", "--duration", "0.2", "--output", &other]);
    judge(&data, &a, "5");
    judge(&data, &b, "3");
    let file = path(&folder, "b/report.json");
    let printed = succeed(["eval", "--compare", &a, &file, "--output", &html, "--tables"]);
    for words in [
        "Horizons differ, comparing up to the shortest: 5 frames in a, 3 frames in b",
        "particle-mingru (a)",
        "particle-mingru (b)",
        "Position RMSE relative to particle-mingru (a)",
        "1.000",
    ] {
        assert!(printed.contains(words), "`{words}` is not in: {printed}");
    }
    assert!(!printed.contains("frame 5"), "{printed}");
    assert!(printed.lines().all(|line| line.chars().count() <= 80), "{printed}");
    let page = fs::read_to_string(&html).unwrap();
    is_a_page_of_its_own(&page);
    assert!(page.contains("Horizons differ") && page.contains("eval --compare"), "{page}");

    judge(&other, &c, "3");
    let message = fail(1, ["eval", "--compare", &a, &c]);
    assert!(
        message.contains("data_digest: found ") && message.contains("expected the same"),
        "{message}"
    );
    assert!(message.len() < 200, "digests are cut: {message}");
}

#[test]
fn what_is_no_report_is_named_with_what_was_expected() {
    let folder = tempfile::tempdir().unwrap();
    let [data, a] = ["truth", "a"].map(|name| path(&folder, name));
    simulate(&folder.path().join("truth"), 1, 0.2);
    judge(&data, &a, "2");
    let whole = fs::read_to_string(path(&folder, "a/report.json")).unwrap();
    let file = path(&folder, "broken.json");
    let mut value: Value = serde_json::from_str(&whole).unwrap();
    value.as_object_mut().unwrap().remove("horizon");
    let of_old = whole.replacen("\"format\": 2", "\"format\": 1", 1);
    // Cut at the end of a line: a number cut behind its point would be another error.
    let (cut, _) = whole[..whole.len() / 2].rsplit_once('\n').unwrap();
    for (text, words) in [
        (cut.to_owned(), "EOF while parsing"),
        (value.to_string(), "missing field `horizon`"),
        (of_old, "format: found 1, expected 2"),
        ("{}".to_owned(), "format: found 1, expected 2"),
        ("7".to_owned(), "expected the report.json of `eddy eval`"),
    ] {
        fs::write(&file, text).unwrap();
        let message = fail(1, ["eval", "--compare", &a, &file]);
        assert!(message.contains("broken.json") && message.contains(words), "{message}");
    }
    let message = fail(1, ["eval", "--compare", &a, &path(&folder, "nowhere")]);
    assert!(message.contains("nowhere"), "{message}");
    let message = fail(2, ["eval", "--compare", &a]);
    assert!(message.contains("--compare"), "{message}");
    let message = fail(2, ["eval", "--compare", &a, &a, "--horizon", "3"]);
    assert!(message.contains("--horizon"), "{message}");
}

#[test]
fn the_same_judgement_is_the_same_report_but_for_its_date_and_times() {
    let folder = tempfile::tempdir().unwrap();
    let [data, first, second] = ["truth", "first", "second"].map(|name| path(&folder, name));
    simulate(&folder.path().join("truth"), 1, 0.2);
    let read = |output: &str| {
        judge(&data, output, "3");
        let text = fs::read_to_string(Path::new(output).join("report.json")).unwrap();
        let mut report: Value = serde_json::from_str(&text).unwrap();
        let report_made = report["made"].take();
        assert!(report_made["machine"]["cores"].as_u64().unwrap() > 0, "{report_made}");
        for kind in ["predictors", "groups"] {
            for entry in report[kind].as_array_mut().unwrap() {
                for time in ["cost", "ms"] {
                    if let Some(value) = entry.get_mut(time) {
                        value.take();
                    }
                }
            }
        }
        (report.to_string(), fs::read_to_string(Path::new(output).join("curves.csv")).unwrap())
    };
    assert!(read(&first) == read(&second));

    let load = || Report::load(Path::new(&first)).unwrap();
    let page = |report: &Report| report.page().unwrap().html();
    let (same, mut other) = (page(&load()), load());
    assert!(page(&load()) == same);
    other.made = Provenance::default();
    let other = page(&other);
    let before = |html: &str| html.split_once("Reproduce</h2>").unwrap().0.to_owned();
    assert!(before(&other) == before(&same) && other != same);
}
