//! Reads bags into trajectories: in memory if they fit, else as an index of blocks on disk.

use std::{
    collections::{BTreeMap, BTreeSet},
    path::PathBuf,
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
};

use rayon::prelude::*;

use xxhash_rust::xxh3::Xxh3;

use super::{
    DatasetError, FrameStore, LoadOptions, Loaded, Stream, TRUTH_TOPIC, Trajectory,
    frame_store::{self, BLOCK, Block, StreamLocation},
    quantities::Quantities,
    statistics::Bounds,
};
use eddy_bag::{BagError, BagReader, find_bags};
use eddy_frames::{Domain, Frame, Stamp, State, same_setup};
use eddy_messages::UnusableFrame;

/// A stream while its bag is read.
struct PartialStream {
    /// Its states are kept only as long as all bags fit into memory.
    stream: Stream,
    frames: usize,
    /// Stamp of the last frame.
    stamp: Stamp,
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
        let stamp = frame.stamp;
        let stream = Stream::begin(bag.path(), frame);
        let (bounds, checksum) = (Bounds::default(), Xxh3::new());
        let (frames, rest) = (0, Vec::new());
        let mut partial = Self { stream, frames, stamp, bounds, rest, location, checksum };
        let first = partial.stream.states.pop();
        if let Some(first) = first {
            partial.rest.clone_from(&first.position);
            partial.push(first, log, before, true);
        }
        partial
    }

    /// Whether `frame` directly follows the last one.
    fn is_continued_by(&self, frame: &Frame) -> bool {
        self.stream.is_continued_by(frame, self.frames)
            && !self.stamp.restarts_at(frame.stamp, frame.dt)
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

/// What a bag holds.
struct Contents {
    streams: Vec<PartialStream>,
    /// The first unusable frame of each other stream. If they are refused, there is at most one, and reading has ended there.
    unusable: BTreeMap<u64, UnusableFrame>,
}

/// Every stream of the topic `/particles` of the bags at `paths`, ordered by id and bag. Their frames are in memory if
/// they take at most `options.memory` bytes, else on disk.
///
/// `progress` is called after every frame with the numbers of frames read and in total.
pub(super) fn load(
    paths: &[PathBuf],
    options: LoadOptions,
    progress: &mut (dyn FnMut(u64, u64) + Send),
) -> Result<Loaded, DatasetError> {
    let LoadOptions { memory, skip_streams } = options;
    let bags = find_bags(paths)?;
    let bags = bags.iter().map(|path| BagReader::open(path)).collect::<Result<Vec<_>, _>>()?;
    let mut quantities = Quantities::of_bags(&bags)?;
    let budget = Budget { bytes: AtomicU64::new(0), limit: memory };
    let (mut partials, mut skipped) = (Vec::new(), Vec::new());
    for Contents { streams, unusable } in read_all(&bags, skip_streams, &budget, progress)? {
        partials.extend(streams);
        skipped.extend(unusable.into_values());
    }
    partials.sort_by(|PartialStream { stream: a, .. }, PartialStream { stream: b, .. }| {
        (a.id, &a.source, a.first_sequence).cmp(&(b.id, &b.source, b.first_sequence))
    });
    skip_unusable(&mut partials, &mut skipped, skip_streams)?;
    let tools = bags.iter().map(|bag| bag.tools(TRUTH_TOPIC));
    let mut tools = tools.collect::<Result<Vec<_>, _>>()?;
    let mut gravity = Vec::with_capacity(partials.len());
    for PartialStream { stream, location, .. } in &mut partials {
        let stated = quantities.of(location.bag, &stream.source, stream.id);
        stream.stiffness = stated.stiffness;
        gravity.push(stated.gravity);
        stream.tools = tools[location.bag].remove(&stream.id).map(Arc::new);
    }
    let with_gravity = |(mut stream, gravity): (Trajectory, _)| {
        stream.gravity = gravity;
        stream
    };
    if budget.holds() {
        let streams = partials.into_iter().map(|partial| Trajectory::from(partial.stream));
        let streams = streams.zip(gravity).map(with_gravity).collect();
        return Ok(Loaded { streams, skipped });
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
    let streams = streams.into_iter().enumerate().map(stored).zip(gravity).map(with_gravity);
    Ok(Loaded { streams: streams.collect(), skipped })
}

/// Reads all bags in parallel. `progress` is that of [`load`].
fn read_all(
    bags: &[BagReader],
    skip_streams: bool,
    budget: &Budget,
    progress: &mut (dyn FnMut(u64, u64) + Send),
) -> Result<Vec<Contents>, DatasetError> {
    let topics = bags.iter().flat_map(BagReader::topics).filter(|topic| topic.name == TRUTH_TOPIC);
    let all = topics.map(|topic| topic.message_count).sum();
    let progress = Mutex::new((0, progress));
    let frame_done = || {
        let mut progress = progress.lock().unwrap_or_else(PoisonError::into_inner);
        let (done, show) = &mut *progress;
        *done += 1;
        show(*done, all);
    };
    bags.par_iter()
        .enumerate()
        .map(|(number, bag)| read(bag, number, skip_streams, budget, &frame_done))
        .collect()
}

/// Moves the streams that cannot be used with the others to `skipped`. They are refused without `skip_streams`, or if none is
/// left.
fn skip_unusable(
    streams: &mut Vec<PartialStream>,
    skipped: &mut Vec<UnusableFrame>,
    skip_streams: bool,
) -> Result<(), DatasetError> {
    let setup = usual_setup(streams);
    skipped.extend(streams.iter().filter_map(|partial| of_other_setup(&partial.stream, setup?)));
    let Some(first) = skipped.first() else { return Ok(()) };
    let is_skipped = |Stream { source, id, .. }: &Stream| {
        skipped.iter().any(|other| other.stream == *id && other.path == *source)
    };
    streams.retain(|partial| !is_skipped(&partial.stream));
    if !skip_streams || streams.is_empty() {
        return Err(DatasetError::Unusable(Box::new(first.clone())));
    }
    Ok(())
}

/// The interval and the domain of most streams; of the first among equals.
fn usual_setup(streams: &[PartialStream]) -> Option<(f32, Domain)> {
    let mut counts: Vec<((f32, Domain), usize)> = Vec::new();
    for PartialStream { stream, .. } in streams {
        let setup = (stream.dt, stream.domain);
        match counts.iter_mut().find(|(other, _)| *other == setup) {
            Some((_, count)) => *count += 1,
            None => counts.push((setup, 1)),
        }
    }
    counts.into_iter().rev().max_by_key(|(_, count)| *count).map(|(setup, _)| setup)
}

/// The first frame of a stream, if it cannot be used with those of this interval and domain.
fn of_other_setup(stream: &Stream, setup: (f32, Domain)) -> Option<UnusableFrame> {
    let Stream { source, id, dt, domain, first_sequence, .. } = stream;
    same_setup((*dt, *domain), setup).err().map(|reason| UnusableFrame {
        path: source.clone(),
        stream: *id,
        sequence: *first_sequence,
        reason: reason.into(),
    })
}

/// The streams of one bag, split wherever a frame is missing, the particles change or the stream restarts. Their states are kept
/// only if all bags have fitted into memory until the end of this one.
fn read(
    bag: &BagReader,
    number: usize,
    skip_streams: bool,
    budget: &Budget,
    frame_done: &(dyn Fn() + Sync),
) -> Result<Contents, DatasetError> {
    let mut ended: Vec<PartialStream> = Vec::new();
    let mut held = true;
    let mut open: BTreeMap<u64, PartialStream> = BTreeMap::new();
    let mut unusable = BTreeMap::new();
    // By id: the last log time, and the number of frames logged at that time.
    let mut last: BTreeMap<u64, (Stamp, usize)> = BTreeMap::new();
    let mut frames = bag.frames(TRUTH_TOPIC)?;
    while let Some(frame) = frames.next() {
        frame_done();
        let (frame, log) = (usable(bag, frame)?, frames.log_time());
        let frame = match frame {
            Ok(frame) if unusable.contains_key(&frame.stream) => continue,
            Ok(frame) => frame,
            Err(finding) => {
                let id = finding.stream;
                open.remove(&id);
                ended.retain(|partial| partial.stream.id != id);
                unusable.entry(id).or_insert(finding);
                if skip_streams {
                    continue;
                }
                break;
            }
        };
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
            Some(partial) if partial.is_continued_by(&frame) => {
                let Frame { stamp, position, velocity, .. } = frame;
                partial.stamp = stamp;
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
    }
    ended.extend(open.into_values());
    Ok(Contents { streams: ended, unusable })
}

/// The streams of a topic.
#[derive(Debug, Default)]
pub struct StreamsFound {
    /// Those of which every frame can be used.
    pub usable: BTreeSet<u64>,
    /// The first unusable frame of each other one.
    pub unusable: BTreeMap<u64, UnusableFrame>,
}

/// Reads a topic of frames up to any damage of the bag, or until `stop`, and says which streams a model can predict from.
///
/// # Errors
/// As [`BagReader::frames`].
pub fn survey_streams(
    bag: &BagReader,
    topic: &str,
    stop: &dyn Fn() -> bool,
) -> Result<StreamsFound, BagError> {
    let mut found = StreamsFound::default();
    for frame in bag.frames(topic)? {
        if stop() {
            break;
        }
        match usable(bag, frame) {
            Ok(Ok(frame)) => {
                found.usable.insert(frame.stream);
            }
            Ok(Err(first)) => {
                found.unusable.entry(first.stream).or_insert(first);
            }
            // No frame at all: it belongs to no stream.
            Err(BagError::Frame { .. }) => {}
            Err(_) => break,
        }
    }
    found.usable.retain(|stream| !found.unusable.contains_key(stream));
    Ok(found)
}

/// A frame that a model can be trained on, or why it cannot be used; other errors of the bag are errors.
fn usable(
    bag: &BagReader,
    frame: Result<Frame, BagError>,
) -> Result<Result<Frame, UnusableFrame>, BagError> {
    let (stream, sequence, reason) = match frame {
        Ok(frame) => match frame.check_plausible() {
            Ok(()) => return Ok(Ok(frame)),
            Err(reason) => (frame.stream, frame.sequence, reason.into()),
        },
        Err(BagError::Frame { place: Some((stream, sequence)), reason, .. }) => {
            (stream, sequence, *reason)
        }
        Err(error) => return Err(error),
    };
    Ok(Err(UnusableFrame { path: bag.path().to_owned(), stream, sequence, reason }))
}
