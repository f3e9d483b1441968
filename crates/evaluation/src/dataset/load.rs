//! Bags to trajectories: in memory while they fit, else only where each block of them is.

use std::{
    collections::BTreeMap,
    path::PathBuf,
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
};

use rayon::prelude::*;

use xxhash_rust::xxh3::Xxh3;

use super::{
    DatasetError, Shelf, State, Stream, TRUTH_TOPIC, Trajectory, alike,
    shelf::{self, BLOCK, Block, Place},
    statistics::Bounds,
};
use eddy_bag::{BagReader, find_bags};
use eddy_frames::{Frame, Stamp};

/// A stream while its bag is read.
struct Reading {
    /// What is known of it; its states are there only as long as all fit into memory.
    stream: Stream,
    frames: usize,
    bounds: Bounds,
    rest: Vec<[f32; 2]>,
    place: Place,
    checksum: Xxh3,
}

/// How much is in memory, and how much may be. All bags that are read at the same time share it.
struct Budget {
    bytes: AtomicU64,
    limit: u64,
}

impl Budget {
    /// Whether everything has fitted so far.
    fn holds(&self) -> bool {
        self.bytes.load(Ordering::Relaxed) <= self.limit
    }
}

impl Reading {
    fn begin(bag: &BagReader, number: usize, frame: Frame, log: Stamp, before: usize) -> Self {
        let place = Place { bag: number, id: frame.stream, blocks: Vec::new() };
        let stream = Stream::begin(bag.path(), frame);
        let (bounds, checksum) = (Bounds::default(), Xxh3::new());
        let mut reading = Self { stream, frames: 0, bounds, rest: Vec::new(), place, checksum };
        let first = reading.stream.states.pop();
        if let Some(first) = first {
            reading.rest.clone_from(&first.position);
            reading.push(first, log, before, true);
        }
        reading
    }

    /// Adds the next state, logged at `log` after `before` others of the same id and log time.
    fn push(&mut self, state: State, log: Stamp, before: usize, keep: bool) {
        self.bounds.widen(&state);
        if self.frames.is_multiple_of(BLOCK) {
            self.checksum.reset();
            let block = Block { from: log, until: log, before, frames: 0, checksum: 0 };
            self.place.blocks.push(block);
        }
        shelf::add(&mut self.checksum, &state);
        if let Some(block) = self.place.blocks.last_mut() {
            block.until = log;
            block.frames += 1;
            block.checksum = self.checksum.digest();
        }
        self.frames += 1;
        if keep {
            self.stream.states.push(state);
        }
    }
}

/// Every stream of the topic `/particles` of the bags at `paths`, in the order of id and bag. Their
/// frames are in memory if they take at most `memory` bytes there, else on disk.
///
/// `progress` is called after every frame with how many were read and how many there are.
pub(super) fn load(
    paths: &[PathBuf],
    memory: u64,
    progress: &mut (dyn FnMut(u64, u64) + Send),
) -> Result<Vec<Trajectory>, DatasetError> {
    let bags = find_bags(paths)?;
    let bags = bags.iter().map(|path| BagReader::open(path)).collect::<Result<Vec<_>, _>>()?;
    let topics = bags.iter().flat_map(BagReader::topics).filter(|topic| topic.name == TRUTH_TOPIC);
    let all = topics.map(|topic| topic.message_count).sum();
    let progress = Mutex::new((0, progress));
    let frame_done = || {
        // Who waits for a thread that panicked has nothing to show any more.
        let mut progress = progress.lock().unwrap_or_else(PoisonError::into_inner);
        let (done, show) = &mut *progress;
        *done += 1;
        show(*done, all);
    };
    let budget = Budget { bytes: AtomicU64::new(0), limit: memory };
    let readings: Vec<Vec<Reading>> = bags
        .par_iter()
        .enumerate()
        .map(|(number, bag)| read(bag, number, &budget, &frame_done))
        .collect::<Result<_, _>>()?;
    let mut readings: Vec<Reading> = readings.into_iter().flatten().collect();
    readings.sort_by(|Reading { stream: a, .. }, Reading { stream: b, .. }| {
        (a.id, &a.source, a.first_sequence).cmp(&(b.id, &b.source, b.first_sequence))
    });
    if let Some(first) = readings.first() {
        for reading in &readings {
            alike(&first.stream, &reading.stream)?;
        }
    }
    if budget.holds() {
        return Ok(readings.into_iter().map(|reading| Trajectory::from(reading.stream)).collect());
    }
    // A quarter is for the windows that are cut ahead.
    let limit = memory / 4 * 3;
    let mut places = Vec::new();
    let mut known = Vec::new();
    for Reading { stream, frames, bounds, rest, place, .. } in readings {
        places.push(place);
        known.push((stream, frames, bounds, rest));
    }
    let shelf = Arc::new(Shelf::new(bags, places, limit));
    let on_shelf = |(number, (stream, frames, bounds, rest))| {
        Trajectory::on_shelf(stream, frames, bounds, rest, &shelf, number)
    };
    Ok(known.into_iter().enumerate().map(on_shelf).collect())
}

/// The streams of one bag, cut in two wherever a frame is missing or the particles change. Their
/// states are there only if all bags' have fitted into memory until the end of this one.
fn read(
    bag: &BagReader,
    number: usize,
    budget: &Budget,
    frame_done: &(dyn Fn() + Sync),
) -> Result<Vec<Reading>, DatasetError> {
    let mut ended: Vec<Reading> = Vec::new();
    let mut held = true;
    let mut open: BTreeMap<u64, Reading> = BTreeMap::new();
    // By id: the last log time, and how many frames were logged then.
    let mut last: BTreeMap<u64, (Stamp, usize)> = BTreeMap::new();
    let mut frames = bag.frames(TRUTH_TOPIC)?;
    while let Some(frame) = frames.next() {
        let (frame, log) = (frame?, frames.log_time());
        let (time, count) = last.entry(frame.stream).or_insert((log, 0));
        if *time != log {
            (*time, *count) = (log, 0);
        }
        let before = std::mem::replace(count, *count + 1);
        budget.bytes.fetch_add(shelf::frame_bytes(frame.len()), Ordering::Relaxed);
        if held && !budget.holds() {
            held = false;
            for reading in ended.iter_mut().chain(open.values_mut()) {
                reading.stream.states = Vec::new();
            }
        }
        match open.get_mut(&frame.stream) {
            Some(reading) if reading.stream.is_continued_by(&frame, reading.frames) => {
                let Frame { position, velocity, .. } = frame;
                reading.push(State { position, velocity }, log, before, held);
            }
            _ => {
                let id = frame.stream;
                let mut reading = Reading::begin(bag, number, frame, log, before);
                if !held {
                    reading.stream.states = Vec::new();
                }
                ended.extend(open.insert(id, reading));
            }
        }
        frame_done();
    }
    ended.extend(open.into_values());
    Ok(ended)
}
