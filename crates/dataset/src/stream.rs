//! One trajectory in memory.

use std::{
    path::{Path, PathBuf},
    sync::Arc,
};

use eddy_bag::RecordedTools;
use eddy_frames::{Domain, Frame, Material, Stamp, State, tool::Sweep};

/// Consecutive frames of one simulated trajectory.
#[derive(Clone, Debug)]
pub struct Stream {
    /// Stream id in its bag: the scene id for simulated data.
    pub id: u64,
    /// The bag it was read from.
    pub source: PathBuf,
    /// Time between two states (s).
    pub dt: f32,
    /// The box that holds the particles.
    pub domain: Domain,
    /// Materials, `[N]`, the same in every frame.
    pub material: Vec<Material>,
    /// Sequence number of the first state.
    pub first_sequence: u64,
    /// Stamp of the first state.
    pub first_stamp: Stamp,
    /// Young's modulus of its materials, if it is known (density x velocity^2).
    pub stiffness: Option<f32>,
    /// Its tools, if it has any.
    pub tools: Option<Arc<RecordedTools>>,
    /// The states, `dt` apart.
    pub states: Vec<State>,
}

impl Stream {
    /// A stream of one frame.
    pub fn begin(source: &Path, frame: Frame) -> Self {
        Self {
            id: frame.stream,
            source: source.to_owned(),
            dt: frame.dt,
            domain: frame.domain,
            material: frame.material,
            first_sequence: frame.sequence,
            first_stamp: frame.stamp,
            stiffness: None,
            tools: None,
            states: vec![State { position: frame.position, velocity: frame.velocity }],
        }
    }

    /// Whether `frame` directly follows the first `frames` frames.
    pub(super) fn is_continued_by(&self, frame: &Frame, frames: usize) -> bool {
        frame.sequence == self.first_sequence + frames as u64
            && frame.dt == self.dt
            && frame.domain == self.domain
            && frame.material == self.material
    }

    /// Name of the bag it was read from.
    pub fn name(&self) -> String {
        let stem = self.source.file_stem().unwrap_or(self.source.as_os_str());
        stem.to_string_lossy().into_owned()
    }

    /// The materials that occur.
    pub fn materials(&self) -> Vec<Material> {
        Material::ALL.into_iter().filter(|material| self.material.contains(material)).collect()
    }

    /// How its tools move from state `index` to the next, as [`RecordedTools::sweep`]; `None` without tools.
    pub fn sweep(&self, index: usize) -> Option<Sweep> {
        self.tools.as_ref()?.sweep(self.first_sequence + index as u64, self.dt)
    }

    /// State `index` as a frame.
    pub fn frame(&self, index: usize) -> Frame {
        let state = &self.states[index];
        Frame {
            stream: self.id,
            sequence: self.first_sequence + index as u64,
            stamp: self.first_stamp.advance(self.dt, index as u32),
            dt: self.dt,
            domain: self.domain,
            position: state.position.clone(),
            velocity: state.velocity.clone(),
            material: self.material.clone(),
        }
    }
}
