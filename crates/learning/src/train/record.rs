//! `resume.toml`: the state of a run except its tensors.

use std::{fs, path::Path};

use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use toml::{Table, Value};

use super::{
    Epoch, LossKind, Run, TrainConfig, TrainError,
    loss_weights::{self, TrivialErrors},
};
use eddy_inference::checkpoint::Description;

/// Version of the format. It increases when older records would be misread.
pub(super) const RECORD_VERSION: u32 = 2;

/// What a run starts from, in messages.
pub(super) fn start_name(digest: &Option<String>) -> String {
    digest.clone().unwrap_or_else(|| "random weights".to_owned())
}

/// Settings that may differ from those of the run to resume.
const MAY_DIFFER: [&str; 2] = ["epochs", "patience"];

/// `resume.toml`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Record {
    /// [`RECORD_VERSION`].
    pub(super) format_version: u32,
    /// Digest of the data.
    pub(super) data: String,
    /// Digest of the checkpoint that the run started from.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) start: Option<String>,
    /// Compute device.
    pub(super) device: String,
    /// Checksum of the checkpoint in the same folder.
    pub(super) weights: String,
    /// Checksum of the moments in the same folder.
    pub(super) moments: String,
    /// Number of steps of the optimizer.
    pub(super) steps: u32,
    pub(super) samples: u64,
    pub(super) since_best: u32,
    pub(super) unroll: usize,
    /// Training time (s).
    pub(super) seconds: f64,
    pub(super) common: TrivialErrors,
    pub(super) order: GeneratorState,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) dropout: Option<GeneratorState>,
    pub(super) config: TrainConfig,
    pub(super) epochs: Vec<Epoch>,
}

/// The state of a random generator.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct GeneratorState {
    /// Its key, hexadecimal.
    key: String,
    /// Number of 32-bit words generated.
    position: String,
}

impl GeneratorState {
    pub(super) fn of(random: &ChaCha8Rng) -> Self {
        let key = random.get_seed().iter().map(|byte| format!("{byte:02x}")).collect();
        Self { key, position: random.get_word_pos().to_string() }
    }

    /// The generator; none if the fields are invalid.
    pub(super) fn generator(&self) -> Option<ChaCha8Rng> {
        let mut key = [0; 32];
        if self.key.len() != 64 || !self.key.is_ascii() {
            return None;
        }
        for (byte, digits) in key.iter_mut().zip(self.key.as_bytes().chunks(2)) {
            *byte = u8::from_str_radix(std::str::from_utf8(digits).ok()?, 16).ok()?;
        }
        let mut random = ChaCha8Rng::from_seed(key);
        random.set_word_pos(self.position.parse().ok()?);
        Some(random)
    }
}

impl Record {
    /// The text of the file.
    pub(super) fn render(&self) -> String {
        toml::to_string(self).expect("numbers, words and tables of them are all TOML")
    }
}

/// Reads the record. The version is checked first, so that a record of a later format is rejected for its version.
pub(super) fn read(file: &Path) -> Result<Record, TrainError> {
    let text = fs::read_to_string(file)
        .map_err(|reason| TrainError::File { file: file.to_owned(), reason })?;
    let syntax = |error: toml::de::Error| {
        let found = error.to_string().trim_end().replace('\n', " ");
        damaged(file, "record", found, "the record of a run")
    };
    let table: Table = text.parse().map_err(syntax)?;
    let version = table.get("format_version");
    if version.and_then(Value::as_integer) != Some(i64::from(RECORD_VERSION)) {
        let found = version.map_or("nothing".to_owned(), ToString::to_string);
        return Err(damaged(file, "format_version", found, RECORD_VERSION));
    }
    let record: Record = toml::from_str(&text).map_err(syntax)?;
    if record.epochs.is_empty() {
        return Err(damaged(file, "epochs", "none", "at least one"));
    }
    let expected = match record.config.loss.kind {
        LossKind::Mse => 0,
        LossKind::Relative => {
            record.unroll * loss_weights::parts_of_common(record.config.network.stiffness)
        }
    };
    if record.common.len() != expected {
        let expected = format!("{expected} frames, as this version of eddy writes them");
        return Err(damaged(file, "common", format!("{} frames", record.common.len()), expected));
    }
    Ok(record)
}

/// Rejects other data or settings than those of the run to resume; warns about another device.
pub(super) fn same_run(
    file: &Path,
    config: &TrainConfig,
    description: &Description,
    run: &Run,
    record: &Record,
) -> Result<(), TrainError> {
    let differs = |field: &str, found: String, expected: String| {
        let (file, field) = (file.to_owned(), field.to_owned());
        Err(TrainError::OtherRun { file, field, found, expected })
    };
    if record.data != description.data {
        return differs("data", description.data.clone(), record.data.clone());
    }
    let start = &description.training.start;
    if record.start != *start {
        return differs("--from", start_name(start), start_name(&record.start));
    }
    if let Some((field, found, expected)) = different_setting(config, &record.config) {
        return differs(&field, found, expected);
    }
    let device = run.device_name();
    if record.device != device {
        tracing::warn!(
            "the run started on {}, resuming on {device}: the results differ by rounding",
            record.device
        );
    }
    let done = record.epochs.len();
    if (config.epochs as usize) < done {
        return differs("epochs", config.epochs.to_string(), format!("at least {done}"));
    }
    Ok(())
}

/// The first setting in which two runs differ, with both values.
pub(super) fn different_setting(
    a: &TrainConfig,
    b: &TrainConfig,
) -> Option<(String, String, String)> {
    let [a, b] = [a, b]
        .map(|config| Value::try_from(config).expect("settings are tables of TOML's own types"));
    difference("", &a, &b)
}

/// The first key at which two tables differ, with both values.
fn difference(path: &str, a: &Value, b: &Value) -> Option<(String, String, String)> {
    match (a, b) {
        (Value::Table(a), Value::Table(b)) => a.iter().find_map(|(key, a)| {
            let path = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
            if MAY_DIFFER.contains(&path.as_str()) {
                return None;
            }
            match b.get(key) {
                Some(b) => difference(&path, a, b),
                None => Some((path, a.to_string(), "nothing".to_owned())),
            }
        }),
        _ if a == b => None,
        _ => Some((path.to_owned(), a.to_string(), b.to_string())),
    }
}

/// The error that a `field` of a file is invalid.
pub(super) fn damaged(
    file: &Path,
    field: &str,
    found: impl ToString,
    expected: impl ToString,
) -> TrainError {
    TrainError::Record {
        file: file.to_owned(),
        field: field.to_owned(),
        found: found.to_string(),
        expected: expected.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use eddy_inference::checkpoint::Architecture;

    /// Any number but NaN, which is not equal to itself.
    fn number() -> impl Strategy<Value = f64> {
        any::<f64>().prop_filter("a number", |number| !number.is_nan())
    }

    fn epoch() -> impl Strategy<Value = Epoch> {
        let counts = (any::<u32>(), 0..u64::MAX / 2, 0..1000usize, any::<bool>());
        (counts, prop::array::uniform7(number())).prop_map(
            |(
                (epoch, samples, unroll, best),
                [
                    training_loss,
                    validation_loss,
                    first_skill,
                    last_skill,
                    learning_rate,
                    weight_distance,
                    epsilon_share,
                ],
            )| {
                Epoch {
                    epoch,
                    samples,
                    unroll,
                    training_loss,
                    validation_loss,
                    first_skill,
                    last_skill,
                    learning_rate,
                    weight_distance,
                    epsilon_share,
                    best,
                }
            },
        )
    }

    proptest! {
        #[test]
        fn a_restored_generator_continues_with_the_same_numbers(seed: u64, drawn in 0..5000usize) {
            let mut random = ChaCha8Rng::seed_from_u64(seed);
            (0..drawn).for_each(|_| {
                random.next_u32();
            });
            let mut read = GeneratorState::of(&random).generator().unwrap();
            for _ in 0..40 {
                prop_assert_eq!(read.next_u64(), random.next_u64());
            }
        }

        #[test]
        fn a_record_is_read_as_it_was_written(
            epochs in prop::collection::vec(epoch(), 1..4),
            common in prop::collection::vec(prop::array::uniform5(prop::array::uniform2(number())), 0..4),
            seconds in number(),
            seed: u64,
            drops: bool,
        ) {
            let generator = GeneratorState::of(&ChaCha8Rng::seed_from_u64(seed));
            let mut config = TrainConfig::defaults(Architecture::Frame);
            config.optimizer.clip = f32::INFINITY;
            config.loss.kind = LossKind::Relative;
            let record = Record {
                format_version: RECORD_VERSION,
                data: "0123".to_owned(),
                start: drops.then(|| "4321".to_owned()),
                device: "flex".to_owned(),
                weights: "4567".to_owned(),
                moments: "89ab".to_owned(),
                steps: 7,
                samples: 8,
                since_best: 9,
                unroll: common.len(),
                seconds,
                common,
                order: generator.clone(),
                dropout: drops.then_some(generator),
                config,
                epochs,
            };
            let folder = tempfile::tempdir().unwrap();
            let file = folder.path().join("resume.toml");
            fs::write(&file, record.render()).unwrap();
            prop_assert_eq!(read(&file).unwrap(), record);
        }
    }
}
