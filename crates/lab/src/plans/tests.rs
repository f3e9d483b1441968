use std::{collections::BTreeMap, fs, num::NonZeroUsize, path::Path};

use eddy_frames::progress::Silent;
use eddy_plan::{OpenPlan, PlanError};

use super::*;
use crate::study::{Comparison, StudyConfig, run, tests};

/// The small study of `eddy-lab study`'s tests, with one seed.
fn request(comparison: Comparison, output: &Path) -> StudyRequest {
    let mut request = tests::request(comparison, output);
    request.study.seeds = StudyConfig::quick().seeds;
    request
}

/// The files of a study that do not hold times, with the folder's name taken out of them.
fn results(root: &Path) -> BTreeMap<String, Vec<u8>> {
    fn add(root: &Path, folder: &Path, found: &mut BTreeMap<String, Vec<u8>>) {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            let name = path.strip_prefix(root).unwrap().to_str().unwrap().to_owned();
            let is_result = name.starts_with("data/")
                || name.starts_with("curves/")
                || name.ends_with("model.safetensors")
                || name.ends_with("curves.csv");
            if path.is_dir() {
                add(root, &path, found);
            } else if is_result {
                let bytes = fs::read(&path).unwrap();
                let text = String::from_utf8(bytes)
                    .map(|text| text.replace(root.to_str().unwrap(), "ROOT").into_bytes());
                found.insert(name, text.unwrap_or_else(|error| error.into_bytes()));
            }
        }
    }
    let mut found = BTreeMap::new();
    add(root, root, &mut found);
    found
}

fn planned(folder: &Path, comparison: Comparison) -> OpenPlan<LongJob> {
    let file = folder.join("plan.json");
    let plan = LongJob::study(request(comparison, &folder.join("planned")), 2).unwrap();
    plan.save(&file).unwrap();
    OpenPlan::read(&file).unwrap()
}

#[test]
fn the_tasks_of_a_study_give_the_results_of_the_study() {
    for (comparison, files) in [(Comparison::Loss, 10), (Comparison::Activations, 9)] {
        let folder = tempfile::tempdir().unwrap();
        let whole = folder.path().join("whole");
        run(&request(comparison, &whole), &Silent).unwrap();
        let plan = planned(folder.path(), comparison);
        // Each by a run of its own, as an engine does.
        for number in 0..plan.tasks().len() {
            plan.run_task(number, &Silent).unwrap();
        }
        let (whole, parts) = (results(&whole), results(&folder.path().join("planned")));
        assert_eq!(whole.keys().collect::<Vec<_>>(), parts.keys().collect::<Vec<_>>());
        for (name, bytes) in &whole {
            assert!(parts[name] == *bytes, "{name} differs");
        }
        assert!(whole.len() >= files, "{:?}", whole.keys());
        // The study finds everything done.
        let before =
            fs::metadata(folder.path().join("planned/data/fluid-3/manifest.json")).unwrap();
        run(&request(comparison, &folder.path().join("planned")), &Silent).unwrap();
        let after = fs::metadata(folder.path().join("planned/data/fluid-3/manifest.json")).unwrap();
        assert_eq!(before.modified().unwrap(), after.modified().unwrap());
    }
}

#[test]
fn a_study_that_has_begun_is_finished_by_its_tasks() {
    let folder = tempfile::tempdir().unwrap();
    let plan = planned(folder.path(), Comparison::Loss);
    run(&request(Comparison::Loss, &folder.path().join("planned")), &Silent).unwrap();
    let network = plan.tasks().iter().position(|task| task.name.ends_with("seed-2")).unwrap();
    let before = results(&folder.path().join("planned"));
    plan.run_all(NonZeroUsize::MIN, &Silent).unwrap();
    assert_eq!(results(&folder.path().join("planned")), before);
    // A network that was removed is trained again, with the same bits.
    fs::remove_dir_all(plan.tasks()[network].outputs[0].parent().unwrap()).unwrap();
    plan.run_task(network, &Silent).unwrap();
    assert_eq!(results(&folder.path().join("planned")), before);
}

#[test]
fn tasks_of_a_study_wait_for_what_they_read() {
    let folder = tempfile::tempdir().unwrap();
    let plan = planned(folder.path(), Comparison::Cores);
    let names: Vec<&str> = plan.tasks().iter().map(|task| task.name.as_str()).collect();
    let expected = [
        "fluid-3/scenes-0000-0001",
        "fluid-3/scene-0002",
        "fluid-3/manifest",
        "fluid-3/mingru/seed-1",
        "fluid-3/mingru/seed-2",
        "cores/fluid-3",
        "cores/step-times",
        "cores/report",
    ];
    assert_eq!(names, expected);
    let before: Vec<&[usize]> = (0..names.len()).map(|number| plan.before(number)).collect();
    assert_eq!(before, [&[][..], &[], &[0, 1], &[2], &[2], &[2, 3, 4], &[5], &[5, 6]]);
    let error = plan.run_task(3, &Silent).unwrap_err();
    assert!(matches!(error, PlanError::Inputs { .. }), "{error}");
    assert!(plan.tasks().iter().all(|task| task.cost.seconds > 0.0 && task.cost.gpus == 0));
}
