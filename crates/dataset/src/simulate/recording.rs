//! The bag of a scene, and the output directory with the bags of all scenes.

use std::{
    path::Path,
    sync::{Mutex, PoisonError},
};

use sha2::{Digest, Sha256};

use super::{
    SimulateError, directory,
    manifest::{EnergyCurve, Finished, Manifest, RecordedRequest, Start, of_scene},
    staging::Staging,
};
use crate::{FIELDS_TOPIC, TRUTH_TOPIC};
use eddy_bag::{BagError, BagWriter, TopicId, WriterOptions, custom_data::Quantity};
use eddy_frames::{Frame, Stamp, tool::Tools};
use eddy_messages::{
    FrameCdr, Message, ParticleFrame, PointCloud2, ToolDescription, ToolFrame, cdr, cloud,
    tool_topics,
};
use eddy_mpm::{ParticleState, Simulation};

/// The output directory, locked by this process or shared with others.
#[derive(Debug)]
pub struct Store {
    staging: Staging,
    manifest: Mutex<Manifest>,
    /// Whether others share it: a scene then has a file of its own instead of an entry in the manifest.
    is_shared: bool,
    /// Whether pressure and energy of every particle are recorded.
    records_fields: bool,
}

impl Store {
    /// Locks the directory, which must still have the manifest that was planned with. Enters the scenes of processes that have
    /// shared the directory.
    pub(super) fn open(
        output: &Path,
        request: &RecordedRequest,
        manifest: Option<&Manifest>,
    ) -> Result<Self, SimulateError> {
        let staging = Staging::open(output)?;
        let mut found = Manifest::open(output, request)?;
        if Some(&found) != manifest {
            return Err(SimulateError::Changed { output: output.to_owned() });
        }
        if found.collect()? {
            found.save()?;
        }
        let (manifest, records_fields) = (Mutex::new(found), request.fields);
        Ok(Self { staging, manifest, is_shared: false, records_fields })
    }

    /// Shares the directory with other processes that simulate scenes of the same request.
    pub(super) fn share(output: &Path, request: &RecordedRequest) -> Result<Self, SimulateError> {
        let staging = Staging::share(output)?;
        let manifest = Mutex::new(Manifest::open(output, request)?);
        Ok(Self { staging, manifest, is_shared: true, records_fields: request.fields })
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
        if self.is_shared {
            manifest.save_entry(finished)?;
        } else {
            manifest.insert(finished.clone());
            manifest.save()?;
        }
        self.staging.deliver(&directory(finished.start.id))
    }

    /// Removes the unfinished bag of a scene.
    pub(super) fn discard(&self, id: u64) -> Result<(), SimulateError> {
        self.staging.discard(&directory(id))
    }

    /// Removes all unfinished bags, or those of this process if others share the directory, and unlocks it.
    pub fn close(self) {
        self.staging.close();
    }
}

/// The bag of a scene that is being simulated.
pub struct Recording {
    start: Start,
    writer: BagWriter,
    topic: TopicId,
    /// The topic of pressure and energy, if they are recorded.
    fields: Option<TopicId>,
    /// The tools and their topic, if there are any.
    tools: Option<(Tools, TopicId)>,
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
        for quantity in Quantity::ALL {
            writer.set_custom_data(quantity.key(), of_scene(&start.scene, quantity).to_string());
        }
        let topic = writer.topic(TRUTH_TOPIC, ParticleFrame::TYPE)?;
        let fields = store
            .records_fields
            .then(|| writer.topic(FIELDS_TOPIC, PointCloud2::TYPE))
            .transpose()?;
        let tools = start.scene.tools_of_stream();
        let tools = tools.map(|tools| describe(tools, &mut writer)).transpose()?;
        let (digest, energy) = (Sha256::new(), EnergyCurve::default());
        Ok(Self { start: start.clone(), writer, topic, fields, tools, digest, frames: 0, energy })
    }

    /// Adds the next frame of a simulation, its energy and its tools; pressure and energy of every particle, if requested.
    ///
    /// # Errors
    /// As [`BagWriter::write`]; [`SimulateError::Implausible`].
    pub fn add(&mut self, frame: &Frame, simulation: &Simulation) -> Result<(), SimulateError> {
        let (time, sequence) = (frame.stamp.seconds(), frame.sequence);
        let implausible = |reason| SimulateError::Implausible { time, sequence, reason };
        frame.check_plausible().map_err(implausible)?;
        let cdr = frame.to_cdr();
        self.digest.update(&cdr);
        self.energy.push(frame.stamp.seconds(), simulation.energy());
        self.frames += 1;
        if let Some((tools, topic)) = &self.tools {
            let cdr = cdr::encode(&ToolFrame::of(&simulation.tool_frame(frame), tools));
            self.writer.write_stamped(*topic, frame.stamp, &cdr)?;
        }
        self.writer.write_stamped(self.topic, frame.stamp, &cdr)?;
        let Some(topic) = self.fields else { return Ok(()) };
        let ParticleState { pressure, energy } = simulation.particle_state();
        let properties = [("pressure", &pressure[..]), ("energy", &energy[..])];
        let cdr = cloud::properties_to_cdr(frame, &properties);
        self.writer.write_stamped(topic, frame.stamp, &cdr)?;
        Ok(())
    }

    /// Finishes the bag and syncs it to disk.
    ///
    /// # Errors
    /// As [`BagWriter::finish`].
    pub fn finish(self, simulation: &Simulation) -> Result<Finished, BagError> {
        self.writer.finish()?;
        Ok(Finished {
            start: self.start,
            refined: simulation.refined().to_vec(),
            frames: self.frames,
            energy: self.energy.thinned(),
            sha256: format!("{:x}", self.digest.finalize()),
        })
    }
}

/// Writes what the tools of a scene are, and adds the topic of their poses.
fn describe(tools: Tools, writer: &mut BagWriter) -> Result<(Tools, TopicId), BagError> {
    let [poses, description] = tool_topics(TRUTH_TOPIC);
    let topic = writer.topic(&description, ToolDescription::TYPE)?;
    let message = ToolDescription::of(&tools, Stamp(0));
    writer.write_stamped(topic, Stamp(0), &cdr::encode(&message))?;
    let topic = writer.topic(&poses, ToolFrame::TYPE)?;
    Ok((tools, topic))
}
