//! A scene becomes a bag; an output directory holds the bags of all scenes.

use std::{
    io::ErrorKind,
    path::Path,
    sync::{Mutex, PoisonError},
};

use anyhow::ensure;
use sha2::{Digest, Sha256};

use super::{
    directory,
    manifest::{EnergyCurve, Finished, Manifest, Request, Start},
    workshop::Workshop,
};
use eddy::{
    bag::{BagError, BagWriter, TopicId, WriterOptions},
    dataset::TRUTH_TOPIC,
    frame::Frame,
    mpm::Energy,
    msg::{Message, ParticleFrame},
};

/// The output directory while it is worked in.
pub(super) struct Archive {
    workshop: Workshop,
    manifest: Mutex<Manifest>,
}

impl Archive {
    /// Locks the directory, where `manifest` was found before.
    pub(super) fn open(
        output: &Path,
        request: &Request,
        manifest: Manifest,
    ) -> anyhow::Result<Self> {
        let workshop = Workshop::open(output)?;
        ensure!(
            Manifest::open(output, request.clone())? == manifest,
            "{}: another eddy simulate has added scenes just now; run the command again",
            output.display()
        );
        Ok(Self { workshop, manifest: Mutex::new(manifest) })
    }

    /// The directory.
    pub(super) fn output(&self) -> &Path {
        self.workshop.output()
    }

    /// Enters a finished scene in the manifest and gives its bag its final name.
    pub(super) fn deliver(&self, finished: &Finished) -> anyhow::Result<()> {
        let mut manifest = self.manifest.lock().unwrap_or_else(PoisonError::into_inner);
        manifest.insert(finished.clone());
        manifest.save(self.workshop.output())?;
        self.workshop.deliver(&directory(finished.start.id))
    }

    /// Takes away what is unfinished of a scene.
    pub(super) fn discard(&self, id: u64) -> anyhow::Result<()> {
        self.workshop.discard(&directory(id))
    }

    /// Takes away everything that is unfinished.
    pub(super) fn close(self) {
        self.workshop.close();
    }
}

/// The bag of a scene that is being simulated.
pub(super) struct Recording {
    start: Start,
    writer: BagWriter,
    topic: TopicId,
    digest: Sha256,
    frames: u64,
    energy: EnergyCurve,
}

impl Recording {
    /// Begins the bag in the place for what is unfinished.
    pub(super) fn begin(archive: &Archive, start: &Start) -> anyhow::Result<Self> {
        let place = archive.workshop.place(&directory(start.id))?;
        let mut writer = BagWriter::create(&place, WriterOptions::default())?;
        let topic = writer.topic(TRUTH_TOPIC, ParticleFrame::TYPE)?;
        let (digest, energy) = (Sha256::new(), EnergyCurve::default());
        Ok(Self { start: start.clone(), writer, topic, digest, frames: 0, energy })
    }

    /// Adds the next frame, and the energy in it.
    pub(super) fn add(&mut self, frame: &Frame, energy: Energy) -> Result<(), BagError> {
        let cdr = frame.to_cdr();
        self.digest.update(&cdr);
        self.energy.push(frame.stamp.seconds(), energy);
        self.frames += 1;
        self.writer.write(self.topic, frame.stamp, frame.stamp, &cdr)
    }

    /// Ends the bag and brings it to the disk.
    pub(super) fn finish(self) -> Result<Finished, BagError> {
        self.writer.finish()?;
        Ok(Finished {
            start: self.start,
            frames: self.frames,
            energy: self.energy.thinned(),
            sha256: format!("{:x}", self.digest.finalize()),
        })
    }
}

/// Whether this happened because the disk, or what this user may have of it, is full.
pub(super) fn disk_is_full(error: &anyhow::Error) -> bool {
    let full = |kind: ErrorKind| {
        matches!(kind, ErrorKind::StorageFull | ErrorKind::QuotaExceeded | ErrorKind::FileTooLarge)
    };
    error.chain().any(|cause| {
        let io = cause.downcast_ref::<std::io::Error>().map(std::io::Error::kind);
        let bag = cause.downcast_ref::<BagError>().and_then(|error| match error {
            BagError::Io { reason, .. } => Some(reason.kind()),
            _ => None,
        });
        io.or(bag).is_some_and(full)
    })
}
