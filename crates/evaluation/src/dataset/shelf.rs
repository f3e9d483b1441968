//! Frames that stay on disk, read again block by block, with a bounded number of blocks in memory.

use std::{
    collections::HashMap,
    ops::Range,
    path::PathBuf,
    sync::{Arc, Mutex, PoisonError},
};

use xxhash_rust::xxh3::Xxh3;

use super::{DatasetError, State, TRUTH_TOPIC};
use eddy_bag::BagReader;
use eddy_frames::{Frame, Stamp};

/// Frames of a block. A chunk of a bag holds about 25 frames of 2,500 particles: a block wastes little
/// of the first and the last chunk that it is read from.
pub(super) const BLOCK: usize = 64;

/// The bags of a data set, where each block of their streams is, and the blocks used last.
#[derive(Debug)]
pub struct Shelf {
    bags: Vec<BagReader>,
    streams: Vec<Place>,
    cache: Mutex<Cache>,
}

/// Where a stream is.
#[derive(Debug)]
pub(super) struct Place {
    /// Number of its bag.
    pub(super) bag: usize,
    /// The stream's id in the bag.
    pub(super) id: u64,
    pub(super) blocks: Vec<Block>,
}

/// Where [`BLOCK`] frames of a stream are, fewer in its last block.
#[derive(Clone, Debug)]
pub(super) struct Block {
    /// Log time of its first frame.
    pub(super) from: Stamp,
    /// Log time of its last frame.
    pub(super) until: Stamp,
    /// Frames of the same id that were logged at `from` before its first.
    pub(super) before: usize,
    pub(super) frames: usize,
    /// XXH3 of its numbers.
    pub(super) checksum: u64,
}

/// What is in memory of what is on disk.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Residency {
    /// Frames in memory.
    pub frames: usize,
    /// Their size (bytes).
    pub bytes: u64,
    /// The largest size there was (bytes).
    pub most_bytes: u64,
    /// Blocks read from disk so far.
    pub reads: u64,
}

/// The blocks used last; the one that was not used for longest goes first.
#[derive(Debug)]
struct Cache {
    /// Most bytes held, unless a single block is larger.
    limit: u64,
    blocks: HashMap<(usize, usize), Held>,
    /// Uses so far.
    uses: u64,
    residency: Residency,
}

#[derive(Debug)]
struct Held {
    last_use: u64,
    states: Arc<Vec<State>>,
}

/// Size of a frame of so many particles in memory (bytes).
pub(super) fn frame_bytes(particles: usize) -> u64 {
    (size_of::<State>() + particles * size_of::<[f32; 4]>()) as u64
}

/// Adds a state to the checksum of its block.
pub(super) fn add(checksum: &mut Xxh3, state: &State) {
    for number in state.position.iter().chain(&state.velocity).flatten() {
        checksum.update(&number.to_le_bytes());
    }
}

impl Shelf {
    /// Streams that lie in `bags`, of which at most `limit` bytes are in memory at a time, but always
    /// one block.
    pub(super) fn new(bags: Vec<BagReader>, streams: Vec<Place>, limit: u64) -> Self {
        let (blocks, residency) = (HashMap::new(), Residency::default());
        let cache = Mutex::new(Cache { limit, blocks, uses: 0, residency });
        Self { bags, streams, cache }
    }

    /// Most bytes of frames that it holds in memory, unless a single block is larger.
    pub fn limit(&self) -> u64 {
        self.cache.lock().unwrap_or_else(PoisonError::into_inner).limit
    }

    /// What is in memory of it.
    pub fn residency(&self) -> Residency {
        self.cache.lock().unwrap_or_else(PoisonError::into_inner).residency
    }

    /// Looks at some frames of a stream, one after the other.
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
        let place = &self.streams[stream];
        let Block { from, until, before, frames, checksum } = place.blocks[number];
        let bag = &self.bags[place.bag];
        let mut found = Xxh3::new();
        let mut states = Vec::with_capacity(frames);
        // Damage of other parts of the bag was an error when the set was loaded.
        let of_this = |frame: &Result<Frame, _>| !matches!(frame, Ok(f) if f.stream != place.id);
        let all = bag.frames_between(TRUTH_TOPIC, from, until)?.filter(of_this);
        for frame in all.skip(before).take(frames) {
            let Frame { position, velocity, .. } = frame?;
            let state = State { position, velocity };
            add(&mut found, &state);
            states.push(state);
        }
        if states.len() != frames || found.digest() != checksum {
            let path: PathBuf = bag.path().into();
            return Err(DatasetError::Changed { path, stream: place.id });
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
        while self.residency.bytes + bytes > self.limit {
            let oldest = self.blocks.iter().min_by_key(|(_, held)| held.last_use);
            let Some(oldest) = oldest.map(|(&block, _)| block) else { break };
            if let Some(gone) = self.blocks.remove(&oldest) {
                self.residency.bytes -= self::bytes(&gone.states);
                self.residency.frames -= gone.states.len();
            }
        }
        self.residency.reads += 1;
        self.residency.frames += states.len();
        self.residency.bytes += bytes;
        self.residency.most_bytes = self.residency.most_bytes.max(self.residency.bytes);
        self.blocks.insert(block, Held { last_use: self.uses, states });
    }
}

fn bytes(states: &[State]) -> u64 {
    states.iter().map(|state| frame_bytes(state.position.len())).sum()
}
