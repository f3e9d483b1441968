//! Scenes of older versions, in files and manifests.

use std::{fmt::Display, sync::Once};

use eddy_mpm::Scene;

/// Reads the older form of a scene ([`Scene::read_older_form`]). The first one that a process reads is reported, with its source:
/// a manifest may have hundreds.
pub(super) fn read(scene: &mut Scene, source: impl Display) {
    static REPORTED: Once = Once::new();
    if let Some(note) = scene.read_older_form() {
        REPORTED.call_once(|| tracing::warn!("{source}: {note}"));
    }
}
