//! Write and read rates of bags at full speed, and message loss of live recording at a given rate.

use std::{
    fs::{self, File},
    io::{self, Write},
    path::{Path, PathBuf},
    sync::Arc,
    thread,
    time::Duration,
};

use serde::Serialize;

use eddy_bag::{BagError, BagReader, BagWriter, Compression, WriterOptions};
use eddy_frames::{
    Domain, Frame, Material, Stamp,
    clock::{self, Clock},
};
use eddy_messages::{FrameCdr, Message, ParticleFrame};
use eddy_node::Recorder;
use eddy_transport::{
    Link, Payload, Queue, Reliability, TransportError, TransportOptions, Transports,
};

/// Number of distinct frames, prepared in advance and repeated.
const DISTINCT_FRAMES: u64 = 8;
/// Memory for frames waiting to be written live (bytes), as in `eddy record`.
const CACHE: usize = 100 << 20;
const TOPIC: &str = "/particles";
/// Timeout of a wait, after which the end of the measurement is checked.
const POLL_TIMEOUT: Duration = Duration::from_millis(100);

/// Parameters of the benchmark.
#[derive(Clone, Debug)]
pub struct Plan {
    /// Particles of a frame.
    pub particles: usize,
    /// Frame rate of the live recording (Hz).
    pub hertz: f64,
    /// Approximate duration of each measurement (s).
    pub seconds: f64,
    /// An empty directory on the measured disk.
    pub directory: PathBuf,
}

/// Why a measurement failed.
#[derive(Debug, thiserror::Error)]
pub enum BenchError {
    /// A bag could not be written or read.
    #[error(transparent)]
    Bag(#[from] BagError),
    /// A transport failed.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// An I/O error on the measured disk.
    #[error("{path}: {reason}", path = .path.display())]
    Disk {
        /// The file.
        path: PathBuf,
        /// The cause.
        reason: io::Error,
    },
}

/// Rates of one compression, in bytes of uncompressed messages.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Timing {
    /// The compression.
    pub compression: &'static str,
    /// Write rate, including the sync to disk (bytes/s).
    pub write: f64,
    /// Read rate from the page cache (bytes/s).
    pub read: f64,
    /// File size relative to the size of the messages.
    pub size: f64,
    /// Frames published live at the plan's rate.
    pub published: u64,
    /// Frames in the bag.
    pub recorded: u64,
}

/// Rate at which a plain file of `bytes` is written and synced to disk (bytes/s).
///
/// # Errors
/// [`BenchError::Disk`].
pub fn disk(directory: &Path, bytes: u64) -> Result<f64, BenchError> {
    let path = directory.join("plain");
    let block = block();
    let write = || -> io::Result<f64> {
        let clock = Clock::start();
        let mut file = File::create_new(&path)?;
        let mut written = 0;
        while written < bytes {
            file.write_all(&block)?;
            written += block.len() as u64;
        }
        file.sync_all()?;
        let rate = written as f64 / clock.now().as_secs_f64();
        fs::remove_file(&path)?;
        Ok(rate)
    };
    write().map_err(|reason| BenchError::Disk { path: path.clone(), reason })
}

/// A mebibyte of incompressible data.
fn block() -> Vec<u8> {
    let mut state = 1u64;
    let mut next = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        (state >> 56) as u8
    };
    (0..1 << 20).map(|_| next()).collect()
}

/// Measures one compression.
///
/// # Errors
/// [`BenchError`].
pub fn time(plan: &Plan, compression: Compression) -> Result<Timing, BenchError> {
    let frames: Vec<Frame> =
        (0..DISTINCT_FRAMES).map(|number| frame(plan.particles, number)).collect();
    let path = plan.directory.join("fast");
    let (write, messages, size) = write(plan, &frames, compression, &path)?;
    let clock = Clock::start();
    let mut read = 0;
    for message in BagReader::open(&path)?.messages() {
        read += message?.data.len();
    }
    let read = read as f64 / clock.now().as_secs_f64();
    remove(&path)?;
    let (published, recorded) = live(plan, frames, compression)?;
    let compression = match compression {
        Compression::None => "none",
        Compression::Lz4 => "lz4",
        Compression::Zstd => "zstd",
    };
    Ok(Timing { compression, write, read, size: size / messages, published, recorded })
}

/// Moving particles; all frames differ.
fn frame(particles: usize, number: u64) -> Frame {
    let wave = |i: usize, speed: f32| 0.5 + 0.4 * (i as f32 * speed + number as f32 * 0.01).sin();
    Frame {
        stream: 0,
        sequence: number,
        stamp: Stamp(0).advance(0.01, number as u32),
        dt: 0.01,
        domain: Domain::UNIT,
        position: (0..particles).map(|i| [wave(i, 0.7), wave(i, 1.3)]).collect(),
        velocity: (0..particles).map(|i| [wave(i, 2.1), wave(i, 3.7)]).collect(),
        material: vec![Material::Snow; particles],
    }
}

fn options(compression: Compression) -> WriterOptions {
    WriterOptions { compression, ..WriterOptions::default() }
}

/// Write rate (bytes/s), size of the messages and size of the file (bytes).
fn write(
    plan: &Plan,
    frames: &[Frame],
    compression: Compression,
    path: &Path,
) -> Result<(f64, f64, f64), BenchError> {
    let messages: Vec<Vec<u8>> = frames.iter().map(Frame::to_cdr).collect();
    let clock = Clock::start();
    let mut bag = BagWriter::create(path, options(compression))?;
    let topic = bag.topic(TOPIC, ParticleFrame::TYPE)?;
    let mut written = 0;
    for (number, message) in (0..).zip(messages.iter().cycle()) {
        if clock.now().as_secs_f64() >= plan.seconds {
            break;
        }
        bag.write(topic, Stamp(number), Stamp(number), message)?;
        written += message.len();
    }
    let bag = bag.finish()?;
    let size: u64 = bag.files.iter().map(|file| file.size).sum();
    Ok((written as f64 / clock.now().as_secs_f64(), written as f64, size as f64))
}

/// Records frames published at the plan's rate, as `eddy record` does: one thread receives, one writes. Returns the
/// numbers of published and recorded frames.
fn live(
    plan: &Plan,
    frames: Vec<Frame>,
    compression: Compression,
) -> Result<(u64, u64), BenchError> {
    let transports = Transports::new(TransportOptions::new("eddy_bench"));
    let link = Link::memory(TOPIC);
    let mut subscriber = transports.subscriber(&link, ParticleFrame::TYPE)?;
    // The publisher drops frames that the recorder cannot take, instead of slowing down.
    let mut publisher = transports.publisher(&link, ParticleFrame::TYPE, Reliability::Drop)?;
    let path = plan.directory.join("live");
    let mut recorder =
        Recorder::new(BagWriter::create(&path, options(compression))?, clock::wall());
    let topic = recorder.topic(TOPIC, ParticleFrame::TYPE)?;
    let count = (plan.seconds * plan.hertz).ceil() as u64;
    let hertz = plan.hertz;
    let queue = Arc::new(Queue::with_cost(usize::MAX, CACHE, |(payload, _): &(Payload, Stamp)| {
        payload.size()
    }));
    let producer = queue.producer();
    let outcome = thread::scope(|scope| -> Result<(), BenchError> {
        let publishing = scope.spawn(move || -> Result<(), TransportError> {
            let clock = Clock::start();
            for (number, frame) in (0..count).zip(frames.iter().cycle()) {
                let due = Duration::from_secs_f64(number as f64 / hertz);
                thread::sleep(due.saturating_sub(clock.now()));
                publisher.publish_frame(frame)?;
            }
            Ok(())
        });
        let receiving = scope.spawn(move || -> Result<(), TransportError> {
            loop {
                let over = publishing.is_finished();
                match subscriber.receive(POLL_TIMEOUT)? {
                    Some(payload) => {
                        // Dropped when the queue is full, which the counts show.
                        let _ = producer.push_or_wait((payload, clock::wall()), Duration::ZERO);
                    }
                    None if over => break,
                    None => {}
                }
            }
            publishing.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
        });
        let written = write_live(&mut recorder, topic, &queue);
        queue.close();
        receiving.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))?;
        Ok(written?)
    });
    outcome?;
    let recorded = recorder.finish()?.messages;
    remove(&path)?;
    Ok((count, recorded))
}

fn write_live(
    recorder: &mut Recorder,
    topic: eddy_bag::TopicId,
    queue: &Queue<(Payload, Stamp)>,
) -> Result<(), BagError> {
    loop {
        match queue.pop(POLL_TIMEOUT) {
            Some((payload, arrived)) => recorder.on_message(topic, payload, arrived)?,
            None if queue.is_ended() => return Ok(()),
            None => {}
        }
        recorder.on_tick(clock::wall())?;
    }
}

fn remove(path: &Path) -> Result<(), BenchError> {
    fs::remove_dir_all(path).map_err(|reason| BenchError::Disk { path: path.into(), reason })
}
