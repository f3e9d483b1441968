mod elastic;
mod knots;

use std::{collections::BTreeMap, fs, path::Path};

use super::*;
use eddy_frames::{Domain, Material};

/// A small particle model with arbitrary weights.
fn checkpoint() -> Checkpoint {
    let description = Description {
        format_version: FORMAT_VERSION,
        architecture: Architecture::Particle,
        core: Core::MinGru,
        form: Form::Plain,
        normalize_gates: true,
        stiffness: false,
        stiffness_knots: Vec::new(),
        assumed_stiffness: None,
        weights: WeightFormat::F32,
        dt: 0.016,
        warm_up: 5,
        gravity: [0.0, -9.8],
        materials: vec![Material::Liquid, Material::Rope],
        material_inputs: MATERIAL_INPUTS,
        data: "0123".to_owned(),
        sizes: Sizes { encoder: 3, hidden: 2, layers: 1, particles: None },
        frame: FrameOptions::default(),
        grid: Some(GridOptions { cell_width: 0.25, channels: vec![2, 3, 2], spacing: 0.1 }),
        rules: Rules::STANDARD,
        domain: Domain::UNIT,
        normalization: Normalization {
            minimum: [0.05, 0.05, -3.0, -3.0],
            maximum: [0.95, 0.95, 3.0, 3.0],
            mean: [0.5, 0.3, 0.0, -0.5],
            standard_deviation: [0.2, 0.2, 0.7, 0.9],
        },
        training: TrainingSummary {
            command: "eddy train --data \"bags/mm\"".to_owned(),
            seed: 1,
            epochs: 3,
            best_epoch: 2,
            training_loss: 0.75,
            validation_loss: 0.5,
            samples: 4096,
            start: Some("fedcba9876543210".to_owned()),
            seen: ["0123456789abcdef".to_owned()].into_iter().collect(),
            stiffness: None,
            linear_fit: Some([[0.5, -0.25, 0.125, 1.0, 2.0], [0.0, 0.1, 0.2, 0.3, -0.4]]),
        },
    };
    let mut next = 0.0;
    let mut number = || {
        next += 0.125;
        next
    };
    let tensors = tensor_shapes(&description).into_iter().map(|(name, shape)| {
        let values = (0..shape.iter().product()).map(|_| number()).collect();
        (name, Weights { shape, values })
    });
    let tensors: BTreeMap<_, _> = tensors.collect();
    Checkpoint::new(description, tensors)
}

/// Saves a checkpoint, changes a file, and returns the error message on loading.
fn rejection(change: impl FnOnce(&Path)) -> String {
    let folder = tempfile::tempdir().unwrap();
    checkpoint().save(folder.path()).unwrap();
    change(folder.path());
    let message = Checkpoint::load(folder.path()).unwrap_err().to_string();
    message.replace(&folder.path().display().to_string(), "x")
}

fn edit_description(from: &str, to: &str) -> impl FnOnce(&Path) {
    move |folder| {
        let file = folder.join(DESCRIPTION_FILE);
        let text = fs::read_to_string(&file).unwrap();
        assert!(text.contains(from), "{text}");
        fs::write(&file, text.replacen(from, to, 1)).unwrap();
    }
}

fn edit_weights(change: impl FnOnce(&mut BTreeMap<String, Weights>)) -> impl FnOnce(&Path) {
    move |folder| {
        let mut tensors = checkpoint().tensors;
        change(&mut tensors);
        fs::write(folder.join(WEIGHTS_FILE), render_weights(&tensors, WeightFormat::F32)).unwrap();
    }
}

#[test]
fn a_checkpoint_is_loaded_as_it_was_saved() {
    let folder = tempfile::tempdir().unwrap();
    let directory = folder.path().join("a/b");
    let saved = checkpoint();
    saved.save(&directory).unwrap();
    assert_eq!(Checkpoint::load(&directory).unwrap(), saved);
}

#[test]
fn a_checkpoint_conditioned_on_the_stiffness_has_a_key_and_an_input_more() {
    let (folder, plain) = (tempfile::tempdir().unwrap(), checkpoint());
    let mut conditioned = plain.clone();
    conditioned.description.stiffness = true;
    for layer in ["encoder.0", "context"] {
        let name = format!("{layer}.weight");
        let rows = plain.tensors[&name].shape[0];
        let weights = conditioned.tensors.get_mut(&name).unwrap();
        weights.shape[1] += 1;
        weights.values.extend(vec![0.5; rows]);
    }
    conditioned.save(folder.path()).unwrap();
    assert_eq!(Checkpoint::load(folder.path()).unwrap(), conditioned);
    let text = fs::read_to_string(folder.path().join(DESCRIPTION_FILE)).unwrap();
    assert!(text.contains("\nstiffness = true\n"), "{text}");

    let without = |folder: &Path| {
        plain.save(folder).unwrap();
        edit_description("dt = ", "stiffness = true\ndt = ")(folder);
    };
    let message = rejection(without);
    let expected = "context.weight: found shape [2, 25], expected [2, 26]";
    assert_eq!(message, format!("x/model.safetensors: {expected}"));
}

#[test]
fn weights_of_16_bits_are_rounded_once_and_take_half_the_space() {
    let folders = [(); 3].map(|()| tempfile::tempdir().unwrap());
    let mut exact = checkpoint();
    // 2^-12, 2^-11 and 2^-11 away from the nearest 16-bit numbers, relatively; the last one is beyond the largest.
    let name = "context.weight";
    exact.tensors.get_mut(name).unwrap().values[..4].copy_from_slice(&[0.1, 1.0004, 2049.0, -7e4]);
    let half = exact.with_weights(WeightFormat::F16);
    assert_eq!(half.tensors[name].values[..4], [0.099_975_586, 1.0, 2048.0, -65_504.0]);
    exact.save(folders[0].path()).unwrap();
    half.save(folders[1].path()).unwrap();
    let loaded = Checkpoint::load(folders[1].path()).unwrap();
    assert_eq!(loaded, half);
    assert_eq!(loaded.digest(), half.digest());
    let [exact_bytes, half_bytes] = [0, 1].map(|number: usize| {
        fs::metadata(folders[number].path().join(WEIGHTS_FILE)).unwrap().len() as usize
    });
    // But for the header, which names types and places.
    assert!(exact_bytes - half_bytes > 2 * exact.parameters() - 64);
    exact.description.weights = WeightFormat::F16;
    let error = exact.save(folders[2].path()).unwrap_err().to_string();
    let expected = "context.weight[0]: found 0.1, expected 0.099975586, its nearest 16-bit number";
    assert!(error.ends_with(expected), "{error}");
    assert!(!folders[2].path().join(WEIGHTS_FILE).exists());
}

#[test]
fn weights_of_another_type_than_described_are_named() {
    let as_half = |folder: &Path| edit_description("dt = ", "weights = \"f16\"\ndt = ")(folder);
    let first = "x/model.safetensors: context.bias";
    assert_eq!(rejection(as_half), format!("{first}: found numbers of type F32, expected F16"));
    let halved = |folder: &Path| {
        let tensors = checkpoint().tensors;
        fs::write(folder.join(WEIGHTS_FILE), render_weights(&tensors, WeightFormat::F16)).unwrap();
    };
    assert_eq!(rejection(halved), format!("{first}: found numbers of type F16, expected F32"));
}

#[test]
fn a_checkpoint_without_the_key_keeps_its_digest() {
    let checkpoint = golden(2);
    assert!(!checkpoint.description.stiffness);
    let files = [include_bytes!("golden/version_2/model.toml"), golden_weights()].concat();
    assert_eq!(checkpoint.digest(), format!("{:x}", Sha256::digest(files)));
}

#[test]
fn the_frame_model_is_not_conditioned_on_the_stiffness() {
    let sizes = Sizes { encoder: 2, hidden: 2, layers: 1, particles: Some(3) };
    let mut description = Description::untrained(Architecture::Frame, Core::Mlp, sizes);
    description.stiffness = true;
    let tensors = initial_weights(&description, 1);
    let message = Checkpoint::new(description, tensors).check(Path::new("x")).unwrap_err();
    let expected = "stiffness: found true, expected false for the frame model";
    assert_eq!(message.to_string(), format!("x/model.toml: {expected}"));
}

#[test]
fn all_weights_but_the_first_and_the_last_are_hidden() {
    for (architecture, particles) in
        [(Architecture::Frame, Some(3)), (Architecture::Particle, None)]
    {
        for core in Core::ALL {
            let sizes = Sizes { encoder: 2, hidden: 2, layers: 2, particles };
            let description = Description::untrained(architecture, core, sizes);
            let layers = plan::Plan::new(&description).layers;
            let hidden: Vec<_> =
                layers.iter().map(|layer| layout::is_hidden(&layer.weight)).collect();
            let [first, inner @ .., last] = hidden.as_slice() else { panic!("{hidden:?}") };
            assert!(!first && !last && inner.iter().all(|&hidden| hidden), "{hidden:?}");
        }
    }
}

#[test]
fn the_digest_is_the_hash_of_the_two_files() {
    let folder = tempfile::tempdir().unwrap();
    let checkpoint = checkpoint();
    checkpoint.save(folder.path()).unwrap();
    let mut hash = Sha256::new();
    hash.update(fs::read(folder.path().join(DESCRIPTION_FILE)).unwrap());
    hash.update(fs::read(folder.path().join(WEIGHTS_FILE)).unwrap());
    let expected: String = hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect();
    assert_eq!(checkpoint.digest(), expected);
    assert!(expected.starts_with(&checkpoint.short_digest()));
}

#[test]
fn a_later_version_is_rejected_before_its_keys_are_parsed() {
    let later = edit_description("format_version = 2", "format_version = 4\nfuture = true");
    assert_eq!(rejection(later), "x/model.toml: format_version: found 4, expected 1 to 3");
}

#[test]
fn a_network_with_more_inputs_for_materials_has_the_next_version() {
    let mut description = checkpoint().description;
    assert_eq!(description.format_version, 2);
    description.material_inputs = 5;
    description.format_version = Description::version(5);
    let wider = Checkpoint::new(description.clone(), initial_weights(&description, 1));
    let folder = tempfile::tempdir().unwrap();
    wider.save(folder.path()).unwrap();
    assert_eq!(Checkpoint::load(folder.path()).unwrap(), wider);
    let text = fs::read_to_string(folder.path().join(DESCRIPTION_FILE)).unwrap();
    assert!(text.starts_with("format_version = 3\n") && text.contains("material_inputs = 5\n"));
    let columns = |checkpoint: &Checkpoint| checkpoint.tensors["encoder.0.weight"].shape[1];
    assert_eq!(columns(&wider), columns(&checkpoint()) + 1);

    let message = rejection(edit_description("data = ", "material_inputs = 5\ndata = "));
    let expected = "material_inputs: found a key, expected nothing before format version 3";
    assert_eq!(message, format!("x/model.toml: {expected}"));
    description.material_inputs = 3;
    let narrow = Checkpoint::new(description.clone(), initial_weights(&description, 1));
    let message = narrow.check(Path::new("x")).unwrap_err().to_string();
    let expected = "materials: found [Liquid, Rope], expected the first 3 materials";
    assert_eq!(message, format!("x/model.toml: {expected}"));
}

#[test]
fn an_unknown_key_is_named() {
    let message = rejection(edit_description("hidden = 2", "hidden = 2\nhiden = 3"));
    assert!(message.starts_with("x/model.toml: "), "{message}");
    assert!(message.contains("unknown field `hiden`"), "{message}");
}

#[test]
fn sizes_out_of_range_are_rejected() {
    let message = rejection(edit_description("layers = 1", "layers = 0"));
    assert_eq!(message, "x/model.toml: sizes.layers: found 0, expected 1 to 65536");
    for channels in ["[]", "[2]", "[2, 3, 2, 3, 2]", "[2, 0, 2]", "[2, 3, 5000]"] {
        let message =
            rejection(edit_description("channels = [2, 3, 2]", &format!("channels = {channels}")));
        let expected = format!("found {channels}, expected two to four numbers, 1 to 4096 each");
        assert_eq!(message, format!("x/model.toml: surroundings.channels: {expected}"));
    }
    let message = rejection(edit_description("layers = 1", "layers = 1\nparticles = 7"));
    let expected = "expected nothing for the particle model";
    assert_eq!(message, format!("x/model.toml: sizes.particles: found 7, {expected}"));
}

#[test]
fn a_missing_tensor_is_named_with_its_shape() {
    let message = rejection(edit_weights(|tensors| drop(tensors.remove("core.0.gate.weight"))));
    let expected = "found nothing, expected a tensor of shape [2, 2]";
    assert_eq!(message, format!("x/model.safetensors: core.0.gate.weight: {expected}"));
}

#[test]
fn a_tensor_of_another_shape_is_named_with_both_shapes() {
    let message = rejection(edit_weights(|tensors| {
        let transposed = Weights { shape: vec![3, 2], values: vec![0.0; 6] };
        tensors.insert("encoder.1.weight".to_owned(), transposed);
    }));
    let expected = "found shape [3, 2], expected [2, 3]";
    assert_eq!(message, format!("x/model.safetensors: encoder.1.weight: {expected}"));
}

#[test]
fn an_unexpected_tensor_is_named() {
    let message = rejection(edit_weights(|tensors| {
        tensors.insert("pooling.weight".to_owned(), Weights { shape: vec![1], values: vec![0.0] });
    }));
    assert!(
        message.starts_with("x/model.safetensors: pooling.weight: found a tensor of shape [1]"),
        "{message}"
    );
}

#[test]
fn a_weight_that_is_nan_is_named() {
    let message = rejection(edit_weights(|tensors| {
        tensors.get_mut("mixer.bias").unwrap().values[1] = f32::NAN;
    }));
    let expected = "mixer.bias[1]: found NaN, expected a finite number";
    assert_eq!(message, format!("x/model.safetensors: {expected}"));
}

#[test]
fn truncated_weights_are_rejected() {
    let message = rejection(|folder| {
        let file = folder.join(WEIGHTS_FILE);
        let bytes = fs::read(&file).unwrap();
        fs::write(&file, &bytes[..bytes.len() - 3]).unwrap();
    });
    assert!(message.starts_with("x/model.safetensors: found "), "{message}");
    assert!(message.ends_with("expected a complete safetensors file"), "{message}");
}

#[test]
fn a_directory_without_a_checkpoint_is_named() {
    let message = rejection(|folder| fs::remove_file(folder.join(DESCRIPTION_FILE)).unwrap());
    assert_eq!(
        message,
        "x: found no model.toml, expected a checkpoint: a directory that has one, or particle-mingru, the shipped model"
    );
}

/// Another checkpoint of the same shapes.
fn second() -> Checkpoint {
    let mut second = checkpoint();
    second.description.training.best_epoch = 3;
    second.tensors.get_mut("decoder.bias").unwrap().values[0] = -1.0;
    second
}

#[test]
fn a_writer_killed_before_the_first_rename_leaves_the_old_checkpoint() {
    let folder = tempfile::tempdir().unwrap();
    checkpoint().save(folder.path()).unwrap();
    fs::write(folder.path().join("model.safetensors.new"), "half").unwrap();
    assert_eq!(Checkpoint::load(folder.path()).unwrap(), checkpoint());
    fs::write(folder.path().join("model.toml.new"), "half").unwrap();
    assert_eq!(Checkpoint::load(folder.path()).unwrap(), checkpoint());
}

#[test]
fn a_writer_killed_between_the_renames_leaves_the_new_checkpoint() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    second().save(folder.path()).unwrap();
    fs::rename(path(DESCRIPTION_FILE), path("model.toml.new")).unwrap();
    fs::write(path(DESCRIPTION_FILE), checkpoint().render_description()).unwrap();
    assert_eq!(Checkpoint::load(folder.path()).unwrap(), second());
    // The next writer completes the interrupted replacement first.
    checkpoint().save(folder.path()).unwrap();
    assert_eq!(Checkpoint::load(folder.path()).unwrap(), checkpoint());
}

#[test]
fn the_shipped_model_is_a_trained_particle_model() {
    let shipped = Checkpoint::shipped().unwrap();
    let error_model = shipped.error_model.as_ref().unwrap();
    assert_eq!(error_model.checkpoint, shipped.digest());
    assert!(
        error_model.seen.iter().all(|stream| !shipped.description.training.seen.contains(stream))
    );
    let training = &shipped.description.training;
    assert_eq!(shipped.description.architecture, Architecture::Particle);
    assert!(training.command.contains("eddy train "), "{}", training.command);
    assert!(training.best_epoch > 0 && training.samples > 0, "{training:?}");
}

/// The checkpoints that `golden/generate.sh` wrote.
fn golden(version: u32) -> Checkpoint {
    let (description, weights): (&str, &[u8]) = match version {
        1 => (
            include_str!("golden/version_1/model.toml"),
            include_bytes!("golden/version_1/model.safetensors"),
        ),
        _ => (
            include_str!("golden/version_2/model.toml"),
            include_bytes!("golden/version_2/model.safetensors"),
        ),
    };
    assert!(description.starts_with(&format!("format_version = {version}\n")));
    Checkpoint::parse(Path::new("golden"), description, weights).unwrap()
}

#[test]
fn a_particle_model_of_version_1_has_all_rules() {
    let area = AreaRule {
        cell_width: 2.0,
        fill_limit: 1.25,
        surface_fill: 0.5,
        sweeps: 20,
        relaxation: 1.7,
        longest_shift: 0.5,
        rate: 1.0,
    };
    let rules = Rules {
        area: Some(area),
        shape: Some(ShapeRule { strain_limit: 0.03, sweeps: 5 }),
        flight: Some(FlightRule { wall_distance: 1.5 }),
        rest: Some(RestRule { wall_distance: 1.5, asleep_below: 0.25, awake_from: 1.0 }),
        ..Rules::default()
    };
    assert_eq!(golden(1).description.rules, rules);
}

#[test]
fn a_checkpoint_of_version_1_equals_version_2_with_explicit_rules() {
    assert_eq!(golden(1), golden(2));
    assert_eq!(golden(1).digest(), golden(2).digest());
}

#[test]
fn a_checkpoint_of_version_2_has_only_the_rules_in_its_file() {
    let text = include_str!("golden/version_2/model.toml");
    let parse = |text: &str| Checkpoint::parse(Path::new("x"), text, golden_weights()).unwrap();
    let (before, _) = text.split_once("[rules.area]").unwrap();
    let (_, after) = text.split_once("[domain]").unwrap();
    let none = parse(&format!("{before}[domain]{after}"));
    assert_eq!(none.description.rules, Rules::default());
    let one =
        parse(&format!("{before}[rules.shape]\nstrain_limit = 0.1\nsweeps = 2\n[domain]{after}"));
    let shape = ShapeRule { strain_limit: 0.1, sweeps: 2 };
    assert_eq!(one.description.rules, Rules { shape: Some(shape), ..Rules::default() });
    assert_ne!(one.digest(), none.digest(), "the digest covers the rules");
}

fn golden_weights() -> &'static [u8] {
    include_bytes!("golden/version_2/model.safetensors")
}

#[test]
fn the_digest_changes_with_every_constant_of_a_rule() {
    let digest = |change: fn(&mut Rules)| {
        let mut checkpoint = checkpoint();
        change(&mut checkpoint.description.rules);
        checkpoint.digest()
    };
    let changes: [fn(&mut Rules); 17] = [
        |_| (),
        |rules| rules.elastic = Some(ElasticRule { modulus: 300.0, ..ElasticRule::default() }),
        |rules| rules.area = None,
        |rules| rules.area.as_mut().unwrap().cell_width = 3.0,
        |rules| rules.area.as_mut().unwrap().fill_limit = 1.2,
        |rules| rules.area.as_mut().unwrap().surface_fill = 0.4,
        |rules| rules.area.as_mut().unwrap().sweeps = 10,
        |rules| rules.area.as_mut().unwrap().relaxation = 1.6,
        |rules| rules.area.as_mut().unwrap().longest_shift = 0.25,
        |rules| rules.area.as_mut().unwrap().rate = 1.0,
        |rules| rules.shape.as_mut().unwrap().strain_limit = 0.02,
        |rules| rules.shape.as_mut().unwrap().sweeps = 4,
        |rules| rules.flight.as_mut().unwrap().wall_distance = 2.0,
        |rules| rules.rest.as_mut().unwrap().wall_distance = 2.0,
        |rules| rules.rest.as_mut().unwrap().asleep_below = 0.5,
        |rules| rules.rest.as_mut().unwrap().awake_from = 2.0,
        |rules| rules.rest = None,
    ];
    let mut digests: Vec<_> = changes.into_iter().map(digest).collect();
    digests.sort();
    digests.dedup();
    assert_eq!(digests.len(), changes.len());
}

#[test]
fn constants_of_rules_out_of_range_are_rejected() {
    for (from, to, expected) in [
        ("cell_width = 2.0", "cell_width = 0.1", "area.cell_width: found 0.1, expected 0.5 to 16"),
        (
            "fill_limit = 1.25",
            "fill_limit = 0.0",
            "area.fill_limit: found 0, expected a positive number",
        ),
        (
            "surface_fill = 0.5",
            "surface_fill = 1.5",
            "area.surface_fill: found 1.5, expected above 0, at most rules.area.fill_limit",
        ),
        ("sweeps = 20", "sweeps = 0", "area.sweeps: found 0, expected 1 to 1000"),
        (
            "relaxation = 1.7",
            "relaxation = 2.0",
            "area.relaxation: found 2, expected above 0 and below 2",
        ),
        (
            "longest_shift = 0.5",
            "longest_shift = inf",
            "area.longest_shift: found inf, expected a positive number",
        ),
        ("rate = 0.2", "rate = 1.5", "area.rate: found 1.5, expected above 0, at most 1"),
        (
            "strain_limit = 0.03",
            "strain_limit = 1.0",
            "shape.strain_limit: found 1, expected at least 0 and below 1",
        ),
        ("sweeps = 5", "sweeps = 1001", "shape.sweeps: found 1001, expected 1 to 1000"),
        (
            "wall_distance = 1.5",
            "wall_distance = nan",
            "flight.wall_distance: found NaN, expected 0 to 64",
        ),
        (
            "asleep_below = 0.02",
            "asleep_below = -1.0",
            "rest.asleep_below: found -1, expected at least 0",
        ),
        (
            "awake_from = 0.1",
            "awake_from = 0.01",
            "rest.awake_from: found 0.01, expected above rules.rest.asleep_below",
        ),
    ] {
        assert_eq!(
            rejection(edit_description(from, to)),
            format!("x/model.toml: rules.{expected}")
        );
    }
    let message = rejection(edit_description("strain_limit = 0.03", "strain = 0.03"));
    assert!(message.contains("unknown field `strain`"), "{message}");
    assert!(message.ends_with("did you mean strain_limit?"), "{message}");
    let message = rejection(edit_description("format_version = 2", "format_version = 1"));
    assert_eq!(message, "x/model.toml: rules: found a table, expected nothing in format version 1");
}
