//! Frames that stay on disk, read block by block through a bounded least-recently-used cache.

use std::{
    collections::HashMap,
    ops::Range,
    path::PathBuf,
    sync::{Arc, Mutex, PoisonError},
};

use xxhash_rust::xxh3::Xxh3;

use super::{DatasetError, TRUTH_TOPIC};
use eddy_bag::{BagError, BagReader};
use eddy_frames::{Frame, Stamp, State};

/// Frames per block. A chunk of a bag holds about 25 frames of 2,500 particles, so a block wastes little of the first
/// and the last chunk that it is read from.
pub(super) const BLOCK: usize = 64;

/// The bags of a data set, an index of the blocks of their streams, and a cache of blocks.
#[derive(Debug)]
pub struct FrameStore {
    bags: Vec<BagReader>,
    streams: Vec<StreamLocation>,
    cache: Mutex<Cache>,
}

/// Location of a stream.
#[derive(Debug)]
pub(super) struct StreamLocation {
    /// Index of its bag.
    pub(super) bag: usize,
    /// The stream's id in the bag.
    pub(super) id: u64,
    pub(super) blocks: Vec<Block>,
}

/// Location of [`BLOCK`] frames of a stream (fewer in its last block).
#[derive(Clone, Debug)]
pub(super) struct Block {
    /// Log time of its first frame.
    pub(super) from: Stamp,
    /// Log time of its last frame.
    pub(super) until: Stamp,
    /// Frames with the same id and log time `from` that precede its first frame.
    pub(super) before: usize,
    pub(super) frames: usize,
    /// XXH3 of its positions and velocities.
    pub(super) checksum: u64,
}

/// Memory use of the cache.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CacheUsage {
    /// Cached frames.
    pub frames: usize,
    /// Their size (bytes).
    pub bytes: u64,
    /// Maximum size so far (bytes).
    pub most_bytes: u64,
    /// Blocks read from disk so far.
    pub reads: u64,
}

/// Cached blocks; the least recently used one is evicted first.
#[derive(Debug)]
struct Cache {
    /// Maximum size (bytes), unless a single block is larger.
    limit: u64,
    blocks: HashMap<(usize, usize), CachedBlock>,
    /// Lookups so far.
    uses: u64,
    usage: CacheUsage,
}

#[derive(Debug)]
struct CachedBlock {
    last_use: u64,
    states: Arc<Vec<State>>,
}

/// Size of a frame in memory (bytes).
pub(super) fn frame_bytes(particles: usize) -> u64 {
    (size_of::<State>() + particles * size_of::<[f32; 4]>()) as u64
}

/// Adds a state to the checksum of its block.
pub(super) fn add(checksum: &mut Xxh3, state: &State) {
    for number in state.position.iter().chain(&state.velocity).flatten() {
        checksum.update(&number.to_le_bytes());
    }
}

impl FrameStore {
    /// A store of the streams in `bags` that caches at most `limit` bytes, but always one block.
    pub(super) fn new(bags: Vec<BagReader>, streams: Vec<StreamLocation>, limit: u64) -> Self {
        let (blocks, usage) = (HashMap::new(), CacheUsage::default());
        let cache = Mutex::new(Cache { limit, blocks, uses: 0, usage });
        Self { bags, streams, cache }
    }

    /// Maximum size of the cache (bytes), unless a single block is larger.
    pub fn limit(&self) -> u64 {
        self.cache.lock().unwrap_or_else(PoisonError::into_inner).limit
    }

    /// Memory use of the cache.
    pub fn cache_usage(&self) -> CacheUsage {
        self.cache.lock().unwrap_or_else(PoisonError::into_inner).usage
    }

    /// Calls `look` with a range of a stream's frames, in order.
    pub(super) fn visit(
        &self,
        stream: usize,
        frames: Range<usize>,
        look: &mut impl FnMut(&State),
    ) -> Result<(), DatasetError> {
        let mut next = frames.start;
        while next < frames.end {
            let number = next / BLOCK;
            let states = self.block(stream, number)?;
            let until = (frames.end - number * BLOCK).min(states.len());
            states[next % BLOCK..until].iter().for_each(&mut *look);
            next = number * BLOCK + until;
        }
        Ok(())
    }

    fn block(&self, stream: usize, number: usize) -> Result<Arc<Vec<State>>, DatasetError> {
        let mut cache = self.cache.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(states) = cache.get((stream, number)) {
            return Ok(states);
        }
        let states = Arc::new(self.read(stream, number)?);
        cache.put((stream, number), states.clone());
        Ok(states)
    }

    fn read(&self, stream: usize, number: usize) -> Result<Vec<State>, DatasetError> {
        let location = &self.streams[stream];
        let Block { from, until, before, frames, checksum } = location.blocks[number];
        let bag = &self.bags[location.bag];
        let mut found = Xxh3::new();
        let mut states = Vec::with_capacity(frames);
        let of_this = |frame: &Result<Frame, BagError>| match frame {
            Ok(frame) => frame.stream == location.id,
            // A stream that was skipped.
            Err(BagError::Frame { place: Some((stream, _)), .. }) => *stream == location.id,
            // Other damage was an error when the data set was loaded.
            Err(_) => true,
        };
        let all = bag.frames_between(TRUTH_TOPIC, from, until)?.filter(of_this);
        for frame in all.skip(before).take(frames) {
            let Frame { position, velocity, .. } = frame?;
            let state = State { position, velocity };
            add(&mut found, &state);
            states.push(state);
        }
        if states.len() != frames || found.digest() != checksum {
            let path: PathBuf = bag.path().into();
            return Err(DatasetError::Changed { path, stream: location.id });
        }
        Ok(states)
    }
}

impl Cache {
    fn get(&mut self, block: (usize, usize)) -> Option<Arc<Vec<State>>> {
        self.uses += 1;
        let held = self.blocks.get_mut(&block)?;
        held.last_use = self.uses;
        Some(held.states.clone())
    }

    fn put(&mut self, block: (usize, usize), states: Arc<Vec<State>>) {
        let bytes = bytes(&states);
        while self.usage.bytes + bytes > self.limit {
            let oldest = self.blocks.iter().min_by_key(|(_, held)| held.last_use);
            let Some(oldest) = oldest.map(|(&block, _)| block) else { break };
            if let Some(evicted) = self.blocks.remove(&oldest) {
                self.usage.bytes -= self::bytes(&evicted.states);
                self.usage.frames -= evicted.states.len();
            }
        }
        self.usage.reads += 1;
        self.usage.frames += states.len();
        self.usage.bytes += bytes;
        self.usage.most_bytes = self.usage.most_bytes.max(self.usage.bytes);
        self.blocks.insert(block, CachedBlock { last_use: self.uses, states });
    }
}

fn bytes(states: &[State]) -> u64 {
    states.iter().map(|state| frame_bytes(state.position.len())).sum()
}
