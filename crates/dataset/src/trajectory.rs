//! One trajectory of a data set: its description, and access to its frames in memory or on disk.

use std::{ops::Range, path::PathBuf, sync::Arc};

use sha2::{Digest, Sha256};

use super::{
    DatasetError, FrameStore, Stream, add_to_digest, begin_digest, hex, statistics::Bounds,
};
use eddy_bag::RecordedTools;
use eddy_frames::{Domain, Material, Stamp, State, tool::Sweep};
use eddy_inference::engine::{Stated, StreamSetup};

/// Consecutive frames of one simulated trajectory, in memory or on disk.
#[derive(Clone, Debug)]
pub struct Trajectory {
    /// Stream id in its bag: the scene id for simulated data.
    pub id: u64,
    /// The bag it is from.
    pub source: PathBuf,
    /// Time between two frames (s).
    pub dt: f32,
    /// The box that holds the particles.
    pub domain: Domain,
    /// Materials, `[N]`, the same in every frame.
    pub material: Vec<Material>,
    /// Sequence number of the first frame.
    pub first_sequence: u64,
    /// Stamp of the first frame.
    pub first_stamp: Stamp,
    /// Young's modulus of its materials, if it is known (density x velocity^2): from the metadata of its bag, or from the manifest of
    /// `eddy simulate` beside the bag.
    pub stiffness: Option<f32>,
    /// Gravity along y, negative is down, if it is known (domain lengths per second squared): from the same places.
    pub gravity: Option<f32>,
    /// Its tools, if it has any.
    pub tools: Option<Arc<RecordedTools>>,
    /// Number of frames.
    pub frames: usize,
    /// Bounding box of its positions (domain lengths).
    pub bounds: Bounds,
    /// Positions in the first frame, `[N]`: taken as the rest shape of solids.
    pub rest: Arc<Vec<[f32; 2]>>,
    storage: Storage,
}

/// Where the frames are.
#[derive(Clone, Debug)]
enum Storage {
    Memory(Arc<Vec<State>>),
    /// On disk: index of the stream in the store.
    Disk(Arc<FrameStore>, usize),
}

impl Trajectory {
    /// The stream with index `number` in a store. The states of `stream` are ignored.
    pub(super) fn stored(
        stream: Stream,
        frames: usize,
        bounds: Bounds,
        rest: Vec<[f32; 2]>,
        store: &Arc<FrameStore>,
        number: usize,
    ) -> Self {
        Self::with_storage(stream, frames, bounds, rest, Storage::Disk(store.clone(), number))
    }

    fn with_storage(
        stream: Stream,
        frames: usize,
        bounds: Bounds,
        rest: Vec<[f32; 2]>,
        storage: Storage,
    ) -> Self {
        let Stream {
            id,
            source,
            dt,
            domain,
            material,
            first_sequence,
            first_stamp,
            stiffness,
            tools,
            ..
        } = stream;
        Self {
            id,
            source,
            dt,
            domain,
            material,
            first_sequence,
            first_stamp,
            stiffness,
            gravity: None,
            tools,
            frames,
            bounds,
            rest: Arc::new(rest),
            storage,
        }
    }

    /// Memory that its positions and velocities take (bytes).
    pub fn bytes(&self) -> u64 {
        (self.frames * self.material.len() * size_of::<[[f32; 2]; 2]>()) as u64
    }

    /// The store of its frames, unless they are in memory.
    pub fn frame_store(&self) -> Option<&Arc<FrameStore>> {
        match &self.storage {
            Storage::Memory(_) => None,
            Storage::Disk(store, _) => Some(store),
        }
    }

    /// Calls `look` with a range of its frames, in order.
    ///
    /// # Errors
    /// [`DatasetError::Bag`], [`DatasetError::Changed`] when frames on disk cannot be read again.
    ///
    /// # Panics
    /// When the range exceeds its frames.
    pub fn visit(
        &self,
        frames: Range<usize>,
        mut look: impl FnMut(&State),
    ) -> Result<(), DatasetError> {
        match &self.storage {
            Storage::Memory(states) => states[frames].iter().for_each(look),
            Storage::Disk(store, number) => store.visit(*number, frames, &mut look)?,
        }
        Ok(())
    }

    /// As [`Stream::sweep`].
    pub fn sweep(&self, frame: usize) -> Option<Sweep> {
        self.tools.as_ref()?.sweep(self.first_sequence + frame as u64, self.dt)
    }

    /// What is known of it at its beginning.
    pub fn setup(&self) -> StreamSetup<'_> {
        let &Self { domain, first_sequence: sequence, gravity, stiffness, .. } = self;
        let stated = Stated { gravity, stiffness };
        StreamSetup { domain, position: &self.rest, material: &self.material, sequence, stated }
    }

    /// Its stiffness.
    ///
    /// # Errors
    /// [`DatasetError::Stiffness`] if it is not known.
    pub fn known_stiffness(&self) -> Result<f32, DatasetError> {
        let unknown = || DatasetError::Stiffness { path: self.source.clone(), stream: self.id };
        self.stiffness.ok_or_else(unknown)
    }

    /// Identifies the stream independently of its id and bag: the first 16 hexadecimal digits of the SHA-256 over its
    /// interval, materials and first two frames. The first frame alone would not distinguish a scene in water from the
    /// same scene in honey.
    ///
    /// # Errors
    /// As [`Trajectory::visit`].
    pub fn fingerprint(&self) -> Result<String, DatasetError> {
        let mut hasher = Sha256::new();
        begin_digest(&mut hasher, 0, self.dt, &self.material);
        self.visit(0..self.frames.min(2), |state| add_to_digest(&mut hasher, state))?;
        let mut digits = hex(hasher);
        digits.truncate(16);
        Ok(digits)
    }

    /// A range of its frames as a stream.
    ///
    /// # Errors
    /// As [`Trajectory::visit`].
    ///
    /// # Panics
    /// As [`Trajectory::visit`].
    pub fn cut(&self, frames: Range<usize>) -> Result<Stream, DatasetError> {
        let start = frames.start;
        let mut states = Vec::with_capacity(frames.len());
        self.visit(frames, |state| states.push(state.clone()))?;
        Ok(Stream {
            id: self.id,
            source: self.source.clone(),
            dt: self.dt,
            domain: self.domain,
            material: self.material.clone(),
            first_sequence: self.first_sequence + start as u64,
            first_stamp: self.first_stamp.advance(self.dt, start as u32),
            stiffness: self.stiffness,
            tools: self.tools.clone(),
            states,
        })
    }
}

impl From<Stream> for Trajectory {
    /// A stream in memory.
    fn from(mut stream: Stream) -> Self {
        let states = std::mem::take(&mut stream.states);
        let mut bounds = Bounds::default();
        states.iter().for_each(|state| bounds.widen(state));
        let rest = states.first().map(|state| state.position.clone()).unwrap_or_default();
        Self::with_storage(stream, states.len(), bounds, rest, Storage::Memory(Arc::new(states)))
    }
}
