//! Training on trajectories that can be written down.

mod bad_input;
mod data;
mod learning;
mod resume;
mod seeds;
mod start;

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
    sync::{
        Mutex,
        atomic::{AtomicUsize, Ordering},
    },
};

use eddy_bag::{BagWriter, Compression, WriterOptions};
use eddy_dataset::{Dataset, DatasetError, LoadOptions, Stream, Trajectory};
use eddy_frames::{
    Domain, Material, Stamp, State,
    progress::{Progress, Silent},
};
use eddy_inference::checkpoint::{Architecture, Core, Normalization};
use eddy_learning::{
    model::{DeviceKind, GpuOptions},
    train::{Machine, Outcome, Run, TrainConfig, TrainError, UnrollStage, train},
};
use eddy_messages::{FrameCdr, Message, ParticleFrame};

const DT: f32 = 0.016;
pub const FRAMES: usize = 40;
const PARTICLES: usize = 24;

/// Particles that fall through something thick: v' = (1 - drag) v + g dt, x' = x + v' dt, with more drag
/// for rope. No trivial predictor knows of the drag.
pub fn stream(id: u64) -> Stream {
    let place = |i: usize, step: f32| (0.37 * (i as f32 + 1.0) + step * id as f32).fract();
    let mut position: Vec<[f32; 2]> =
        (0..PARTICLES).map(|i| [0.2 + 0.6 * place(i, 0.11), 0.8 + 0.2 * place(i, 0.23)]).collect();
    let mut velocity: Vec<[f32; 2]> =
        (0..PARTICLES).map(|i| [place(i, 0.31) - 0.5, place(i, 0.43) - 0.5]).collect();
    let material: Vec<_> = (0..PARTICLES)
        .map(|i| if i % 2 == 0 { Material::Liquid } else { Material::Rope })
        .collect();
    let states = (0..FRAMES).map(|_| {
        let state = State { position: position.clone(), velocity: velocity.clone() };
        for i in 0..PARTICLES {
            let left = if material[i] == Material::Rope { 0.7 } else { 0.9 };
            velocity[i] = [left * velocity[i][0], left * velocity[i][1] - 9.8 * DT];
            position[i] =
                [position[i][0] + velocity[i][0] * DT, position[i][1] + velocity[i][1] * DT];
        }
        state
    });
    let states = states.collect();
    Stream {
        id,
        source: "analytic".into(),
        dt: DT,
        domain: Domain::UNIT,
        material,
        first_sequence: 0,
        first_stamp: Stamp(0),
        stiffness: None,
        tools: None,
        states,
    }
}

pub fn dataset() -> Dataset {
    Dataset {
        train: (0..6).map(stream).map(Trajectory::from).collect(),
        validation: vec![stream(6).into()],
        test: vec![stream(7).into()],
        normalization: Normalization {
            minimum: [0.0, 0.0, -1.0, -1.5],
            maximum: [1.0, 1.0, 1.0, 0.5],
            mean: [0.5, 0.5, 0.0, -0.7],
            standard_deviation: [0.2, 0.2, 0.2, 0.5],
        },
        spacing: 0.02,
        digest: "analytic".to_owned(),
        skipped: Vec::new(),
    }
}

/// A network and a run small enough for a test.
pub fn small(architecture: Architecture, core: Core) -> TrainConfig {
    let mut config = TrainConfig::defaults(architecture);
    config.core = core;
    config.epochs = 4;
    config.network.encoder = 16;
    config.network.hidden = 12;
    config.windows.batch = 8;
    config.windows.per_epoch = 256;
    config.optimizer.learning_rate = 5e-3;
    config.validation.horizon = 8;
    if architecture == Architecture::Particle {
        config.unroll = vec![UnrollStage { share: 1.0, frames: 4 }];
        // So wide that walls are near everywhere: of a body in free flight, no drag is believed.
        config.network.cell_width = 0.5;
        config.network.channels = vec![4, 4, 4];
        // A few hundred steps are too few to average, and too few to learn from noise.
        config.optimizer.average = 0.0;
        config.windows.noise.share = 0.0;
    }
    config
}

/// A run in `output` that nothing limits or stops.
pub fn settings<'a>(output: &'a Path, progress: &'a dyn Progress) -> Run<'a> {
    Run {
        gpu: GpuOptions::default(),
        device: DeviceKind::Flex,
        output,
        start: None,
        resume: false,
        machine: Machine::UNLIMITED,
        command: "a test".to_owned(),
        progress,
        on_epoch: &|_| (),
    }
}

/// Calls a function before every batch, which says whether to stop.
pub struct BeforeBatch<F>(pub F);

impl<F: Fn() -> bool + Sync> Progress for BeforeBatch<F> {
    fn cancelled(&self) -> bool {
        (self.0)()
    }
}

/// Collects messages.
#[derive(Default)]
pub struct Lines(Mutex<Vec<String>>);

impl Lines {
    pub fn into_inner(self) -> Vec<String> {
        self.0.into_inner().unwrap()
    }
}

impl Progress for Lines {
    fn message(&self, line: &str) {
        self.0.lock().unwrap().push(line.to_owned());
    }
}

/// A run from beginning to end.
pub fn run(config: &TrainConfig, dataset: &Dataset, output: &Path) -> Result<Outcome, TrainError> {
    train(config, dataset, &settings(output, &Silent))
}

/// A run that goes on.
pub fn resume(
    config: &TrainConfig,
    dataset: &Dataset,
    output: &Path,
) -> Result<Outcome, TrainError> {
    train(config, dataset, &Run { resume: true, ..settings(output, &Silent) })
}

/// A run that is interrupted after so many batches.
pub fn interrupted(
    config: &TrainConfig,
    dataset: &Dataset,
    output: &Path,
    batches: usize,
) -> Outcome {
    let done = AtomicUsize::new(0);
    let interrupted = BeforeBatch(|| done.fetch_add(1, Ordering::Relaxed) >= batches);
    train(config, dataset, &settings(output, &interrupted)).unwrap()
}

/// Every file beneath a folder, with its bytes.
pub fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut files = BTreeMap::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            files.extend(self::files(&path));
        } else {
            let bytes = fs::read(&path).unwrap();
            files.insert(path, bytes);
        }
    }
    files
}

/// Writes streams into one bag, frame by frame, all streams side by side. Frames are logged at their
/// stamps.
pub fn write_bag(path: &Path, streams: &[Stream]) {
    let mut bag = BagWriter::create(
        path,
        WriterOptions {
            compression: Compression::None,
            chunk_size: 1 << 14,
            ..WriterOptions::default()
        },
    )
    .unwrap();
    let topic = bag.topic("/particles", ParticleFrame::TYPE).unwrap();
    for index in 0..streams.iter().map(|stream| stream.states.len()).max().unwrap() {
        for stream in streams.iter().filter(|stream| index < stream.states.len()) {
            let frame = stream.frame(index);
            bag.write(topic, frame.stamp, frame.stamp, &frame.to_cdr()).unwrap();
        }
    }
    bag.finish().unwrap();
}

/// Loads bags; frames that take more than `memory` bytes stay on disk.
pub fn load(paths: &[PathBuf], memory: u64) -> Result<Dataset, DatasetError> {
    Dataset::load(paths, LoadOptions::within(memory), &mut |_, _| {})
}
