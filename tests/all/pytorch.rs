//! Checkpoints that PyTorch wrote, `tests/golden/torch/checkpoints`; `generate.py` beside them made
//! them. The other way, ours into PyTorch, is `tests/peers/torch_exchange.py`, which needs PyTorch.

use std::{collections::BTreeMap, fs, path::Path};

use eddy_bag::{BagReader, BagWriter, WriterOptions};
use eddy_frames::{Domain, Frame, Material, Stamp};
use eddy_inference::checkpoint::{Checkpoint, Core};
use eddy_messages::{FrameCdr, Message, ParticleFrame};
use safetensors::SafeTensors;

use crate::support::succeed;

/// Of the largest number in a frame.
const NEAR: f32 = 1e-5;

/// What PyTorch's network was shown, and what it predicted after each frame.
struct Golden {
    material: Vec<Material>,
    /// `input.position`, `prediction.velocity` and so on, `[T, N, 2]`.
    tensors: BTreeMap<String, Vec<[f32; 2]>>,
}

impl Golden {
    fn read(file: &Path) -> Self {
        let bytes = fs::read(file).unwrap();
        let data = SafeTensors::deserialize(&bytes).unwrap();
        let material = data.tensor("input.material").unwrap();
        let material = material.data().iter().map(|&kind| Material::try_from(kind).unwrap());
        let floats = data.iter().filter(|(name, _)| *name != "input.material");
        let tensors = floats.map(|(name, tensor)| {
            let (bytes, _) = tensor.data().as_chunks::<4>();
            let numbers: Vec<f32> = bytes.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
            (name.to_owned(), numbers.as_chunks::<2>().0.to_vec())
        });
        let tensors = tensors.collect();
        Self { material: material.collect(), tensors }
    }

    fn frames(&self) -> usize {
        self.tensors["input.position"].len() / self.material.len()
    }

    /// A tensor at one instant.
    fn at(&self, name: &str, frame: usize) -> &[[f32; 2]] {
        let particles = self.material.len();
        &self.tensors[name][frame * particles..(frame + 1) * particles]
    }

    /// Writes the input as a bag.
    fn write_bag(&self, path: &Path, dt: f32) {
        let mut bag = BagWriter::create(path, WriterOptions::default()).unwrap();
        let topic = bag.topic("/particles", ParticleFrame::TYPE).unwrap();
        for number in 0..self.frames() {
            let frame = Frame {
                stream: 0,
                sequence: number as u64,
                stamp: Stamp(0).advance(dt, number as u32),
                dt,
                domain: Domain::UNIT,
                position: self.at("input.position", number).to_vec(),
                velocity: self.at("input.velocity", number).to_vec(),
                material: self.material.clone(),
            };
            bag.write(topic, frame.stamp, frame.stamp, &frame.to_cdr()).unwrap();
        }
        bag.finish().unwrap();
    }
}

fn compare(found: &[[f32; 2]], expected: &[[f32; 2]], what: &str) {
    let (found, expected) = (found.as_flattened(), expected.as_flattened());
    assert_eq!(found.len(), expected.len());
    let largest = expected.iter().fold(0.0, |largest: f32, b| largest.max(b.abs()));
    let difference = found.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(difference <= NEAR * largest, "{what}: {difference:.2e} of {largest:.2e}");
}

#[test]
fn a_checkpoint_written_by_pytorch_predicts_what_pytorch_predicts() {
    let checkpoints = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden/torch/checkpoints");
    for name in Core::ALL.map(|core| core.name()).into_iter().chain(["mingru_f16"]) {
        let checkpoint = checkpoints.join(name);
        let golden = Golden::read(&checkpoint.join("frames.safetensors"));
        let description = Checkpoint::load(&checkpoint).unwrap().description;
        let folder = tempfile::tempdir().unwrap();
        let [input, output] = ["input", "output"].map(|name| folder.path().join(name));
        golden.write_bag(&input, description.dt);
        let [model, from, to] =
            [&checkpoint, &input, &output].map(|path| path.to_str().unwrap().to_owned());
        succeed(["predict", "--checkpoint", &model, "--input", &from, "--output", &to]);

        let predictions = BagReader::open(&output).unwrap().frames("/prediction").unwrap();
        let predictions: Vec<Frame> = predictions.map(Result::unwrap).collect();
        let unseen = description.warm_up as usize - 1; // the first frame that counts, from 0
        assert_eq!(predictions.len(), golden.frames() - unseen);
        for (frame, prediction) in (unseen..).zip(&predictions) {
            let what = |part| format!("{name}, {part} after frame {frame}");
            assert_eq!(prediction.sequence, frame as u64 + 1);
            compare(
                &prediction.position,
                golden.at("prediction.position", frame),
                &what("position"),
            );
            compare(
                &prediction.velocity,
                golden.at("prediction.velocity", frame),
                &what("velocity"),
            );
        }
    }
}
