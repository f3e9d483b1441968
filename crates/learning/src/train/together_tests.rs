//! Whole runs on devices in the emulator: of one process, and of two that find each other over TCP. Here processes are threads;
//! what they share otherwise is what GPUs exchange.

use std::{
    fs,
    net::TcpListener,
    panic::{AssertUnwindSafe, catch_unwind},
    path::Path,
    sync::{
        Arc, Mutex,
        atomic::{AtomicU32, Ordering},
    },
    thread,
    time::Duration,
};

use super::{
    Dependencies, Epoch, Machine, Outcome, Run, Schedule, TrainConfig, TrainError, cuda,
    cuda_tests::{self, relative_error, streams},
    steps::Learner,
    train_with,
};
use crate::{
    model::{Core, DeviceKind, GpuOptions},
    ranks::{Group, Process, ProcessOptions, Timing},
};
use eddy_cuda::{device::Device, frame::Place, kernels::Constants};
use eddy_cuda_emulator::Emulator;
use eddy_evaluation::dataset::Dataset;
use eddy_frames::progress::{Progress, Silent};
use eddy_inference::checkpoint::Description;

/// Epochs of two batches of four windows.
fn config() -> TrainConfig {
    let mut config = cuda_tests::config(Core::MinGru);
    config.epochs = 3;
    config.patience = 100;
    config.windows.batch = 4;
    config.windows.per_epoch = 8;
    config.validation.horizon = 2;
    config.validation.starts = 1;
    config
}

fn dataset() -> Dataset {
    Dataset {
        train: streams(),
        validation: streams(),
        test: Vec::new(),
        normalization: cuda_tests::description(&config()).normalization,
        spacing: 0.1,
        digest: "streams of a test".to_owned(),
        skipped: Vec::new(),
    }
}

/// What tests vary in a run.
struct Options<'a> {
    resume: bool,
    progress: &'a dyn Progress,
    on_epoch: &'a (dyn Fn(&Epoch) + Sync),
    clock: &'a dyn Fn() -> Duration,
}

impl Default for Options<'_> {
    fn default() -> Self {
        Self { resume: false, progress: &Silent, on_epoch: &|_| (), clock: &|| Duration::ZERO }
    }
}

fn run(
    config: &TrainConfig,
    output: &Path,
    device: Arc<dyn Device>,
    process: Option<ProcessOptions<'_>>,
    options: &Options<'_>,
) -> Result<Outcome, TrainError> {
    let dataset = dataset();
    let run = Run {
        device: DeviceKind::Cuda(0),
        gpu: GpuOptions { process, ..GpuOptions::default() },
        output,
        start: None,
        resume: options.resume,
        machine: Machine::UNLIMITED,
        command: "a test".to_owned(),
        progress: options.progress,
        on_epoch: options.on_epoch,
    };
    let learner = |description: &Description, group: Option<&Group>| {
        let devices = [(device.clone(), Place::Device)];
        let learner = cuda::Learner::on(devices, group, description, &dataset.train)?;
        Ok(Learner::Cuda(Box::new(learner)))
    };
    train_with(config, &dataset, &run, &Dependencies { learner: &learner, clock: options.clock })
}

fn constants(config: &TrainConfig) -> Constants {
    Constants::of(&cuda_tests::description(config)).unwrap()
}

/// A run of one process.
fn alone(config: &TrainConfig, output: &Path, options: &Options<'_>) -> Outcome {
    let device = Arc::new(Emulator::new(&constants(config)).unwrap());
    run(config, output, device, None, options).unwrap()
}

fn never(sentence: &str) {
    panic!("abandoned: {sentence}");
}

/// A run of two processes with the settings and options of each. An outcome is missing where a process was lost.
fn both(
    configs: [&TrainConfig; 2],
    outputs: [&Path; 2],
    options: [&(dyn Fn() -> Options<'static> + Sync); 2],
) -> [Option<Result<Outcome, TrainError>>; 2] {
    let port = TcpListener::bind(("127.0.0.1", 0)).unwrap().local_addr().unwrap().port();
    let timing = Timing { deadline: Duration::from_secs(20), ..Timing::default() };
    let devices = Emulator::group(&constants(configs[0]), 2).unwrap();
    thread::scope(|scope| {
        let mut devices = devices.into_iter();
        let threads = [0, 1].map(|rank| {
            let process = Process {
                rank,
                count: 2,
                local_rank: rank,
                address: "127.0.0.1".to_owned(),
                port,
                count_variable: "WORLD_SIZE",
            };
            let device = Arc::new(devices.next().unwrap());
            let (config, output, options) = (configs[rank], outputs[rank], options[rank]);
            scope.spawn(move || {
                let process = ProcessOptions { process: &process, timing, abandon: &never };
                // A process that is killed drops its connections, as one that panics does.
                let run = || run(config, output, device, Some(process), &options());
                catch_unwind(AssertUnwindSafe(run)).ok()
            })
        });
        threads.map(|thread| thread.join().unwrap())
    })
}

/// A run of two processes with the same settings and options, which both come to its end.
fn together(
    config: &TrainConfig,
    output: &Path,
    options: &(dyn Fn() -> Options<'static> + Sync),
) -> [Outcome; 2] {
    both([config; 2], [output; 2], [options; 2]).map(|outcome| outcome.unwrap().unwrap())
}

/// Two processes continue a run, and end with the same epochs and bits as one that was never interrupted.
fn resume_as(expected: &Outcome, config: &TrainConfig, output: &Path) {
    let resuming = || Options { resume: true, ..Options::default() };
    let [found, _] = together(config, output, &resuming);
    assert_eq!(found.epochs, expected.epochs);
    assert_eq!(distance(&found, expected), 0.0, "the same bits");
}

/// Largest relative error of a tensor of the best checkpoints.
fn distance(found: &Outcome, expected: &Outcome) -> f64 {
    let [found, expected] =
        [found, expected].map(|outcome| &outcome.best.as_ref().unwrap().tensors);
    let of = |(name, expected): (&String, &eddy_inference::checkpoint::Weights)| {
        relative_error(&found[name].values, &expected.values)
    };
    expected.iter().map(of).fold(0.0, f64::max)
}

/// The number of epochs in the record of the last epoch.
fn epochs_saved(output: &Path) -> usize {
    let record = fs::read_to_string(output.join("last/resume.toml")).unwrap();
    record.matches("[[epochs]]").count()
}

#[test]
fn two_processes_end_with_the_weights_of_one_that_has_the_batch_of_both() {
    let folder = tempfile::tempdir().unwrap();
    let [one, two, none] = ["one", "two", "none"].map(|name| folder.path().join(name));
    let config = config();
    let expected = alone(&config, &one, &Options::default());
    let [lead, follow] = both([&config; 2], [&two, &none], [&Options::default, &Options::default])
        .map(|outcome| outcome.unwrap().unwrap());
    let distance = distance(&lead, &expected);
    assert!(distance < 1e-5, "relative error {distance:.1e}");
    assert_eq!(lead.epochs.len(), 3);
    assert_eq!(lead.epochs, follow.epochs, "all know the results of each epoch");
    assert_eq!((lead.samples, follow.samples), (expected.samples, expected.samples));
    assert!(follow.best.is_none() && !none.exists(), "only rank 0 writes");
}

#[test]
fn two_processes_resume_with_the_same_bits() {
    let folder = tempfile::tempdir().unwrap();
    let [whole, parts] = ["whole", "parts"].map(|name| folder.path().join(name));
    let mut config = config();
    // Another number of epochs would change the schedule.
    config.optimizer.schedule = Schedule::Constant;
    let [expected, _] = together(&config, &whole, &Options::default);
    let first = TrainConfig { epochs: 1, ..config.clone() };
    together(&first, &parts, &Options::default);
    resume_as(&expected, &config, &parts);
}

#[test]
fn a_process_that_is_asked_to_stop_stops_both() {
    /// Asked in the second epoch.
    struct AfterOneEpoch(AtomicU32);
    impl Progress for AfterOneEpoch {
        fn cancelled(&self) -> bool {
            self.0.fetch_add(1, Ordering::Relaxed) > 0
        }
    }
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("run");
    let config = TrainConfig { epochs: 1000, ..config() };
    let stopping = || Options {
        progress: Box::leak(Box::new(AfterOneEpoch(AtomicU32::new(0)))),
        ..Options::default()
    };
    let [lead, follow] = both([&config; 2], [&output; 2], [&Options::default, &stopping])
        .map(|outcome| outcome.unwrap().unwrap());
    assert!(lead.interrupted && follow.interrupted);
    assert_eq!(lead.epochs, follow.epochs);
    assert_eq!(epochs_saved(&output), lead.epochs.len(), "the last epoch is saved");
}

#[test]
fn processes_with_other_settings_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("run");
    let mut other = config();
    other.optimizer.learning_rate = 0.5;
    let outcomes = both([&config(), &other], [&output; 2], [&Options::default, &Options::default]);
    let [lead, follow] = outcomes.map(|outcome| outcome.unwrap().unwrap_err().to_string());
    let expected = "optimizer.learning_rate: found 0.5, expected 0.001 as in rank 0";
    assert!(lead.starts_with("rank 1 (") && lead.ends_with(expected), "{lead}");
    assert_eq!(follow, format!("rank 0 ended the rendezvous: {lead}"));
}

#[test]
fn a_lost_process_ends_the_other_and_the_last_epoch_is_kept() {
    let folder = tempfile::tempdir().unwrap();
    let [whole, parts] = ["whole", "parts"].map(|name| folder.path().join(name));
    let config = config();
    let [expected, _] = together(&config, &whole, &Options::default);

    // The clock stands still: without the loss, the second epoch would not be saved.
    let lost = || Options {
        on_epoch: &|epoch| assert!(epoch.epoch < 2, "this process is lost"),
        ..Options::default()
    };
    let [lead, follow] = both([&config; 2], [&parts; 2], [&Options::default, &lost]);
    assert!(follow.is_none(), "it was lost");
    let message = lead.unwrap().unwrap_err().to_string();
    assert!(message.starts_with("epoch 3: rank 1 ("), "{message}");
    let last = parts.join("last");
    let end = format!(") was lost; epoch 2 is kept in {}, continue with --resume", last.display());
    assert!(message.ends_with(&end), "{message}");
    assert_eq!(epochs_saved(&parts), 2);

    resume_as(&expected, &config, &parts);
}

#[test]
fn without_rank_0_the_others_say_so() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("run");
    let config = config();
    let lost = || Options {
        on_epoch: &|epoch| assert!(epoch.epoch < 2, "this process is lost"),
        ..Options::default()
    };
    let [lead, follow] = both([&config; 2], [&output; 2], [&lost, &Options::default]);
    assert!(lead.is_none(), "it was lost");
    let message = follow.unwrap().unwrap_err().to_string();
    assert!(message.contains(": rank 0 (") && message.contains(") was lost; "), "{message}");
    assert!(message.contains("the last epoch that it saved is kept in"), "{message}");
}

#[test]
fn a_process_that_fails_says_why_to_the_others() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("run");
    let config = config();
    // Rank 0 cannot write the next epoch.
    let place = output.clone();
    let blocked: &'static (dyn Fn(&Epoch) + Sync) = Box::leak(Box::new(move |_: &Epoch| {
        let _ = fs::remove_dir_all(place.join("last"));
        let _ = fs::remove_file(place.join("model.toml"));
        let _ = fs::create_dir(place.join("model.toml"));
    }));
    let failing = || Options { on_epoch: blocked, ..Options::default() };
    let [lead, follow] = both([&config; 2], [&output; 2], [&failing, &Options::default]);
    let lead = lead.unwrap().unwrap_err().to_string();
    let follow = follow.unwrap().unwrap_err().to_string();
    assert!(lead.contains("model.toml"), "{lead}");
    assert!(follow.contains("rank 0 (") && follow.contains(&format!("ended: {lead}")), "{follow}");
}

#[test]
fn a_run_on_a_gpu_is_saved_at_most_every_ten_seconds_and_at_its_end() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("run");
    let config = TrainConfig { epochs: 10, ..config() };
    // An epoch takes four seconds.
    let done = AtomicU32::new(0);
    let saved = Mutex::new(Vec::new());
    let on_epoch = |epoch: &Epoch| {
        done.store(epoch.epoch, Ordering::Relaxed);
        saved.lock().unwrap().push(epochs_saved(&output));
    };
    let clock = || Duration::from_secs(4) * done.load(Ordering::Relaxed);
    let options = Options { on_epoch: &on_epoch, clock: &clock, ..Options::default() };
    alone(&config, &output, &options);
    // A save ends when its epoch is reported: the first one at 4 s, so that the next one is due at 14 s, which epoch 5 is
    // the first to end after.
    assert_eq!(*saved.lock().unwrap(), [1, 1, 1, 1, 5, 5, 5, 5, 9, 10]);
}

#[test]
fn a_run_through_burn_is_saved_after_every_epoch() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("run");
    let (config, dataset, saved) = (config(), dataset(), Mutex::new(Vec::new()));
    let on_epoch = |_: &Epoch| saved.lock().unwrap().push(epochs_saved(&output));
    let run = Run {
        device: DeviceKind::Flex,
        gpu: GpuOptions::default(),
        output: &output,
        start: None,
        resume: false,
        machine: Machine::UNLIMITED,
        command: "a test".to_owned(),
        progress: &Silent,
        on_epoch: &on_epoch,
    };
    let dependencies =
        Dependencies { learner: &|_, _| Ok(Learner::Burn), clock: &|| Duration::ZERO };
    train_with(&config, &dataset, &run, &dependencies).unwrap();
    assert_eq!(*saved.lock().unwrap(), [1, 2, 3]);
}
