//! The bag of a scene, and the output directory with the bags of all scenes.

use std::{
    path::Path,
    sync::{Mutex, PoisonError},
};

use sha2::{Digest, Sha256};

use super::{
    SimulateError, directory,
    manifest::{EnergyCurve, Finished, Manifest, RecordedRequest, Start},
    staging::Staging,
};
use crate::dataset::TRUTH_TOPIC;
use eddy_bag::{BagError, BagWriter, TopicId, WriterOptions};
use eddy_frames::Frame;
use eddy_messages::{FrameCdr, Message, ParticleFrame};
use eddy_mpm::Energy;

/// The output directory, locked by this process.
#[derive(Debug)]
pub struct Store {
    staging: Staging,
    manifest: Mutex<Manifest>,
}

impl Store {
    /// Locks the directory, which must still have the manifest that was planned with.
    pub(super) fn open(
        output: &Path,
        request: &RecordedRequest,
        manifest: Option<&Manifest>,
    ) -> Result<Self, SimulateError> {
        let staging = Staging::open(output)?;
        let found = Manifest::open(output, request)?;
        if Some(&found) != manifest {
            return Err(SimulateError::Changed { output: output.to_owned() });
        }
        Ok(Self { staging, manifest: Mutex::new(found) })
    }

    /// The directory.
    pub fn output(&self) -> &Path {
        self.staging.output()
    }

    /// Enters a finished scene in the manifest and gives its bag its final name.
    ///
    /// # Errors
    /// [`SimulateError::Io`] when the manifest or the bag cannot be written.
    pub fn deliver(&self, finished: &Finished) -> Result<(), SimulateError> {
        let mut manifest = self.manifest.lock().unwrap_or_else(PoisonError::into_inner);
        manifest.insert(finished.clone());
        manifest.save()?;
        self.staging.deliver(&directory(finished.start.id))
    }

    /// Removes the unfinished bag of a scene.
    pub(super) fn discard(&self, id: u64) -> Result<(), SimulateError> {
        self.staging.discard(&directory(id))
    }

    /// Removes all unfinished bags and unlocks the directory.
    pub fn close(self) {
        self.staging.close();
    }
}

/// The bag of a scene that is being simulated.
pub struct Recording {
    start: Start,
    writer: BagWriter,
    topic: TopicId,
    digest: Sha256,
    frames: u64,
    energy: EnergyCurve,
}

impl Recording {
    /// Creates the bag in the folder of unfinished bags.
    ///
    /// # Errors
    /// [`SimulateError::Io`], [`SimulateError::Bag`].
    pub fn begin(store: &Store, start: &Start) -> Result<Self, SimulateError> {
        let place = store.staging.place(&directory(start.id))?;
        let mut writer = BagWriter::create(&place, WriterOptions::default())?;
        let topic = writer.topic(TRUTH_TOPIC, ParticleFrame::TYPE)?;
        let (digest, energy) = (Sha256::new(), EnergyCurve::default());
        Ok(Self { start: start.clone(), writer, topic, digest, frames: 0, energy })
    }

    /// Adds the next frame and its energy.
    ///
    /// # Errors
    /// As [`BagWriter::write`].
    pub fn add(&mut self, frame: &Frame, energy: Energy) -> Result<(), BagError> {
        let cdr = frame.to_cdr();
        self.digest.update(&cdr);
        self.energy.push(frame.stamp.seconds(), energy);
        self.frames += 1;
        self.writer.write(self.topic, frame.stamp, frame.stamp, &cdr)
    }

    /// Finishes the bag and syncs it to disk.
    ///
    /// # Errors
    /// As [`BagWriter::finish`].
    pub fn finish(self) -> Result<Finished, BagError> {
        self.writer.finish()?;
        Ok(Finished {
            start: self.start,
            frames: self.frames,
            energy: self.energy.thinned(),
            sha256: format!("{:x}", self.digest.finalize()),
        })
    }
}
