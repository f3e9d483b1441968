//! Reads bags into trajectories: in memory if they fit, else as an index of blocks on disk.

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
    DatasetError, FrameStore, State, Stream, TRUTH_TOPIC, Trajectory, check_same_setup,
    frame_store::{self, BLOCK, Block, StreamLocation},
    quantities::Stiffnesses,
    statistics::Bounds,
};
use eddy_bag::{BagReader, find_bags};
use eddy_frames::{Frame, Stamp};

/// A stream while its bag is read.
struct PartialStream {
    /// Its states are kept only as long as all bags fit into memory.
    stream: Stream,
    frames: usize,
    bounds: Bounds,
    rest: Vec<[f32; 2]>,
    location: StreamLocation,
    checksum: Xxh3,
}

/// Memory used by frames, and its limit, shared by all bags that are read in parallel.
struct Budget {
    bytes: AtomicU64,
    limit: u64,
}

impl Budget {
    /// Whether all frames have fitted so far.
    fn holds(&self) -> bool {
        self.bytes.load(Ordering::Relaxed) <= self.limit
    }
}

impl PartialStream {
    fn begin(bag: &BagReader, number: usize, frame: Frame, log: Stamp, before: usize) -> Self {
        let location = StreamLocation { bag: number, id: frame.stream, blocks: Vec::new() };
        let stream = Stream::begin(bag.path(), frame);
        let (bounds, checksum) = (Bounds::default(), Xxh3::new());
        let mut partial = Self { stream, frames: 0, bounds, rest: Vec::new(), location, checksum };
        let first = partial.stream.states.pop();
        if let Some(first) = first {
            partial.rest.clone_from(&first.position);
            partial.push(first, log, before, true);
        }
        partial
    }

    /// Adds the next state, logged at `log` after `before` other frames with the same id and log time.
    fn push(&mut self, state: State, log: Stamp, before: usize, keep: bool) {
        self.bounds.widen(&state);
        if self.frames.is_multiple_of(BLOCK) {
            self.checksum.reset();
            let block = Block { from: log, until: log, before, frames: 0, checksum: 0 };
            self.location.blocks.push(block);
        }
        frame_store::add(&mut self.checksum, &state);
        if let Some(block) = self.location.blocks.last_mut() {
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

/// Every stream of the topic `/particles` of the bags at `paths`, ordered by id and bag. Their frames are in memory if
/// they take at most `memory` bytes, else on disk.
///
/// `progress` is called after every frame with the numbers of frames read and in total.
pub(super) fn load(
    paths: &[PathBuf],
    memory: u64,
    progress: &mut (dyn FnMut(u64, u64) + Send),
) -> Result<Vec<Trajectory>, DatasetError> {
    let bags = find_bags(paths)?;
    let bags = bags.iter().map(|path| BagReader::open(path)).collect::<Result<Vec<_>, _>>()?;
    let mut stiffnesses = Stiffnesses::of_bags(&bags)?;
    let topics = bags.iter().flat_map(BagReader::topics).filter(|topic| topic.name == TRUTH_TOPIC);
    let all = topics.map(|topic| topic.message_count).sum();
    let progress = Mutex::new((0, progress));
    let frame_done = || {
        let mut progress = progress.lock().unwrap_or_else(PoisonError::into_inner);
        let (done, show) = &mut *progress;
        *done += 1;
        show(*done, all);
    };
    let budget = Budget { bytes: AtomicU64::new(0), limit: memory };
    let partials: Vec<Vec<PartialStream>> = bags
        .par_iter()
        .enumerate()
        .map(|(number, bag)| read(bag, number, &budget, &frame_done))
        .collect::<Result<_, _>>()?;
    let mut partials: Vec<PartialStream> = partials.into_iter().flatten().collect();
    partials.sort_by(|PartialStream { stream: a, .. }, PartialStream { stream: b, .. }| {
        (a.id, &a.source, a.first_sequence).cmp(&(b.id, &b.source, b.first_sequence))
    });
    for PartialStream { stream, location, .. } in &mut partials {
        stream.stiffness = stiffnesses.of(location.bag, &stream.source, stream.id);
    }
    if let Some(first) = partials.first() {
        for partial in &partials {
            check_same_setup(&first.stream, &partial.stream)?;
        }
    }
    if budget.holds() {
        return Ok(partials.into_iter().map(|partial| Trajectory::from(partial.stream)).collect());
    }
    // A quarter is left for windows that training cuts ahead.
    let limit = memory / 4 * 3;
    let (mut locations, mut streams) = (Vec::new(), Vec::new());
    for PartialStream { stream, frames, bounds, rest, location, .. } in partials {
        locations.push(location);
        streams.push((stream, frames, bounds, rest));
    }
    let store = Arc::new(FrameStore::new(bags, locations, limit));
    let stored = |(number, (stream, frames, bounds, rest))| {
        Trajectory::stored(stream, frames, bounds, rest, &store, number)
    };
    Ok(streams.into_iter().enumerate().map(stored).collect())
}

/// The streams of one bag, split wherever a frame is missing or the particles change. Their states are kept only if
/// all bags have fitted into memory until the end of this one.
fn read(
    bag: &BagReader,
    number: usize,
    budget: &Budget,
    frame_done: &(dyn Fn() + Sync),
) -> Result<Vec<PartialStream>, DatasetError> {
    let mut ended: Vec<PartialStream> = Vec::new();
    let mut held = true;
    let mut open: BTreeMap<u64, PartialStream> = BTreeMap::new();
    // By id: the last log time, and the number of frames logged at that time.
    let mut last: BTreeMap<u64, (Stamp, usize)> = BTreeMap::new();
    let mut frames = bag.frames(TRUTH_TOPIC)?;
    while let Some(frame) = frames.next() {
        let (frame, log) = (frame?, frames.log_time());
        let (time, count) = last.entry(frame.stream).or_insert((log, 0));
        if *time != log {
            (*time, *count) = (log, 0);
        }
        let before = std::mem::replace(count, *count + 1);
        budget.bytes.fetch_add(frame_store::frame_bytes(frame.len()), Ordering::Relaxed);
        if held && !budget.holds() {
            held = false;
            for partial in ended.iter_mut().chain(open.values_mut()) {
                partial.stream.states = Vec::new();
            }
        }
        match open.get_mut(&frame.stream) {
            Some(partial) if partial.stream.is_continued_by(&frame, partial.frames) => {
                let Frame { position, velocity, .. } = frame;
                partial.push(State { position, velocity }, log, before, held);
            }
            _ => {
                let id = frame.stream;
                let mut partial = PartialStream::begin(bag, number, frame, log, before);
                if !held {
                    partial.stream.states = Vec::new();
                }
                ended.extend(open.insert(id, partial));
            }
        }
        frame_done();
    }
    ended.extend(open.into_values());
    Ok(ended)
}
