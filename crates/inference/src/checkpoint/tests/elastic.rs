//! The table `[rules.elastic]`.

use super::*;

#[test]
#[expect(clippy::too_many_lines, reason = "a table of cases")]
fn elastic_constants_out_of_range_are_rejected_and_others_are_part_of_the_digest() {
    let with = |change: &dyn Fn(&mut Description)| {
        let mut all = checkpoint();
        all.description.rules.elastic = Some(ElasticRule::new(300.0, 0.1, 0.016));
        change(&mut all.description);
        all
    };
    let set = |change: fn(&mut ElasticRule)| {
        with(&|description| change(description.rules.elastic.as_mut().unwrap()))
    };
    let plain = with(&|_| ());
    assert_eq!(ElasticRule::new(300.0, 1.0 / 128.0, 0.016).steps, 25, "a wave crosses 11 elements");
    let folder = tempfile::tempdir().unwrap();
    plain.save(folder.path()).unwrap();
    assert_eq!(Checkpoint::load(folder.path()).unwrap(), plain);
    let changed = [
        set(|rule| rule.modulus = 301.0),
        set(|rule| rule.poisson_ratio = 0.25),
        set(|rule| rule.cell_width = 5.0),
        set(|rule| rule.steps = 5),
        set(|rule| rule.viscosity = 0.1),
        set(|rule| rule.wall_distance = 2.0),
        set(|rule| rule.wall_stiffness = 2.0),
        set(|rule| rule.rebound = 1.0),
        set(|rule| rule.clear_distance = 3.0),
        set(|rule| rule.most_stretch = 1.2),
        set(|rule| rule.most_error = Some(0.2)),
        set(|rule| rule.most_error = None),
        set(|rule| rule.small_error = 0.1),
        set(|rule| rule.small_error = 0.0),
        checkpoint(),
    ];
    for other in changed {
        assert_ne!(other.digest(), plain.digest(), "{:?}", other.description.rules.elastic);
    }
    for (broken, message) in [
        (
            set(|rule| rule.modulus = 0.0),
            "rules.elastic.modulus: found 0, expected a positive number",
        ),
        (set(|rule| rule.modulus = f32::NAN), "rules.elastic.modulus: found NaN"),
        (
            set(|rule| rule.poisson_ratio = 0.5),
            "rules.elastic.poisson_ratio: found 0.5, expected at least 0, below 0.5",
        ),
        (
            set(|rule| rule.cell_width = 1.0),
            "rules.elastic.cell_width: found 1, expected 2 to 1024",
        ),
        (set(|rule| rule.steps = 0), "rules.elastic.steps: found 0, expected 1 to 256"),
        (set(|rule| rule.viscosity = 0.6), "rules.elastic.viscosity: found 0.6, expected 0 to 0.5"),
        (
            set(|rule| rule.wall_stiffness = 5.0),
            "rules.elastic.wall_stiffness: found 5, expected 0 to 4",
        ),
        (set(|rule| rule.rebound = 1.5), "rules.elastic.rebound: found 1.5, expected 0 to 1"),
        (
            set(|rule| rule.modulus = 1e6),
            "expected at least one step in the time that a pressure wave",
        ),
        (
            set(|rule| rule.wall_distance = -1.0),
            "rules.elastic.wall_distance: found -1, expected 0 to 16",
        ),
        (
            set(|rule| rule.most_stretch = 0.9),
            "rules.elastic.most_stretch: found 0.9, expected 1 to 4",
        ),
        (
            set(|rule| rule.most_error = Some(-0.1)),
            "rules.elastic.most_error: found -0.1, expected a number of at least 0",
        ),
        (
            set(|rule| rule.small_error = f32::NAN),
            "rules.elastic.small_error: found NaN, expected a number of at least 0",
        ),
        (
            set(|rule| rule.clear_distance = 65.0),
            "rules.elastic.clear_distance: found 65, expected 0 to 64",
        ),
    ] {
        let error = broken.check(Path::new("a")).unwrap_err().to_string();
        assert!(error.contains(message), "{error}");
    }
}

/// Any modulus from rubber to rock: elements stay as wide as they must be for steps that are accurate, and both grow together. The elastic
/// energy of a body that is about to count as torn stays the same.
#[test]
fn stiffer_jelly_has_wider_elements_more_steps_and_less_strain() {
    let (spacing, dt) = (1.0 / 128.0, 0.016);
    let mut last = ElasticRule::new(30.0, spacing, dt);
    assert_eq!((last.cell_width, last.steps, last.most_stretch), (3.5, 25, 1.25));
    let energy = |rule: &ElasticRule| rule.modulus * (rule.most_stretch - 1.0).powi(2);
    let most_energy = energy(&ElasticRule::new(300.0, spacing, dt));
    for modulus in [300.0, 3e3, 3e4, 3e6] {
        let rule = ElasticRule::new(modulus, spacing, dt);
        assert!(rule.is_stable(spacing, dt), "{rule:?}");
        assert!(rule.cell_width >= last.cell_width && rule.steps >= last.steps);
        assert!((energy(&rule) / most_energy - 1.0).abs() < 0.01, "{rule:?}");
        assert_eq!(rule.most_stretch, ElasticRule::new(modulus, spacing, 4.0 * dt).most_stretch);
        last = rule;
    }
    assert!(last.cell_width > 40.0 && last.steps < ElasticRule::MOST_STEPS, "{last:?}");
    // A network that is conditioned on the stiffness has a share of it, whatever it is.
    let mut conditioned = checkpoint().description;
    conditioned.stiffness = true;
    conditioned.rules.elastic = Some(ElasticRule { steps: 1, modulus: 10.0, ..Default::default() });
    assert!(!conditioned.rules.elastic.unwrap().is_stable(0.001, dt));
    let tensors = initial_weights(&conditioned, 1);
    Checkpoint::new(conditioned, tensors).check(Path::new("a")).unwrap();
}
