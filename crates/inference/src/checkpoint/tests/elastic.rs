//! The table `[elastic]`.

use super::*;

#[test]
fn elastic_constants_out_of_range_are_rejected_and_others_are_part_of_the_digest() {
    let with = |change: &dyn Fn(&mut Description)| {
        let mut all = checkpoint();
        all.description.elastic = Some(ElasticOptions::new(300.0, 0.1, 0.016));
        change(&mut all.description);
        all
    };
    let set = |change: fn(&mut ElasticOptions)| {
        with(&|description| change(description.elastic.as_mut().unwrap()))
    };
    let plain = with(&|_| ());
    assert_eq!(
        ElasticOptions::new(300.0, 1.0 / 128.0, 0.016).steps,
        25,
        "a wave crosses 11 elements"
    );
    let folder = tempfile::tempdir().unwrap();
    plain.save(folder.path()).unwrap();
    assert_eq!(Checkpoint::load(folder.path()).unwrap(), plain);
    let changed = [
        set(|options| options.modulus = 301.0),
        set(|options| options.poisson_ratio = 0.25),
        set(|options| options.cell_width = 5.0),
        set(|options| options.steps = 5),
        set(|options| options.viscosity = 0.1),
        set(|options| options.wall_distance = 2.0),
        set(|options| options.wall_stiffness = 2.0),
        set(|options| options.rebound = 1.0),
        set(|options| options.contact_distance = 3.0),
        set(|options| options.contact_stiffness = 0.1),
        set(|options| options.contact_viscosity = 2.0),
        checkpoint(),
    ];
    for other in changed {
        assert_ne!(other.digest(), plain.digest(), "{:?}", other.description.elastic);
    }
    for (broken, message) in [
        (
            set(|options| options.modulus = 0.0),
            "elastic.modulus: found 0, expected a positive number",
        ),
        (set(|options| options.modulus = f32::NAN), "elastic.modulus: found NaN"),
        (
            set(|options| options.poisson_ratio = 0.5),
            "elastic.poisson_ratio: found 0.5, expected at least 0, below 0.5",
        ),
        (
            set(|options| options.cell_width = 1.0),
            "elastic.cell_width: found 1, expected 2 to 1024",
        ),
        (set(|options| options.steps = 0), "elastic.steps: found 0, expected 1 to 256"),
        (set(|options| options.viscosity = 0.6), "elastic.viscosity: found 0.6, expected 0 to 0.5"),
        (
            set(|options| options.wall_stiffness = 5.0),
            "elastic.wall_stiffness: found 5, expected 0 to 4",
        ),
        (set(|options| options.rebound = 1.5), "elastic.rebound: found 1.5, expected 0 to 1"),
        (
            set(|options| options.modulus = 1e6),
            "expected at least one step in the time that a pressure wave",
        ),
        (
            set(|options| options.wall_distance = -1.0),
            "elastic.wall_distance: found -1, expected 0 to 16",
        ),
        (
            set(|options| options.contact_viscosity = 4.5),
            "elastic.contact_viscosity: found 4.5, expected 0 to 4",
        ),
    ] {
        let error = broken.check(Path::new("a")).unwrap_err().to_string();
        assert!(error.contains(message), "{error}");
    }
}

/// Any modulus from rubber to rock: elements stay as wide as they must be for steps that are accurate, and both grow together.
#[test]
fn stiffer_jelly_has_wider_elements_and_more_steps() {
    let (spacing, dt) = (1.0 / 128.0, 0.016);
    let mut last = ElasticOptions::new(30.0, spacing, dt);
    assert_eq!((last.cell_width, last.steps), (3.5, 25));
    for modulus in [300.0, 3e3, 3e4, 3e6] {
        let options = ElasticOptions::new(modulus, spacing, dt);
        assert!(options.is_stable(spacing, dt), "{options:?}");
        assert!(options.cell_width >= last.cell_width && options.steps >= last.steps);
        last = options;
    }
    assert!(last.cell_width > 40.0 && last.steps < ElasticOptions::MOST_STEPS, "{last:?}");
    // A network that is conditioned on the stiffness has a share of it, whatever it is.
    let mut conditioned = checkpoint().description;
    conditioned.stiffness = true;
    conditioned.elastic = Some(ElasticOptions { steps: 1, modulus: 10.0, ..Default::default() });
    assert!(!conditioned.elastic.unwrap().is_stable(0.001, dt));
    let tensors = initial_weights(&conditioned, 1);
    Checkpoint::new(conditioned, tensors).check(Path::new("a")).unwrap();
}
