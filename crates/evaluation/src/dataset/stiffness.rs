//! Where the stiffness of a stream is known from.

use std::path::Path;

use super::{DatasetError, simulate::ScenesBeside};
use eddy_bag::BagReader;

/// Key in `custom_data` of a bag's `metadata.yaml`: Young's modulus of all matter in the bag (density x velocity^2).
pub const STIFFNESS: &str = "eddy_stiffness";

/// The stiffness of the streams of bags: what `metadata.yaml` says, otherwise the manifest of `eddy simulate` beside the bag.
#[derive(Debug, Default)]
pub(super) struct Stiffnesses(ScenesBeside);

impl Stiffnesses {
    /// Of a stream of a bag (density x velocity^2) for which `metadata.yaml` says `stated`; `None` if nothing says it.
    pub(super) fn of(&mut self, stated: Option<f32>, bag: &Path, stream: u64) -> Option<f32> {
        stated.or_else(|| self.0.stiffness(bag, stream))
    }
}

/// What `metadata.yaml` of a bag says (density x velocity^2); `None` if it says nothing.
///
/// # Errors
/// [`DatasetError::StatedStiffness`] unless it is a positive number.
pub(super) fn stated(bag: &BagReader) -> Result<Option<f32>, DatasetError> {
    let Some(found) = bag.custom_data().remove(STIFFNESS) else { return Ok(None) };
    match found.parse::<f32>() {
        Ok(stiffness) if stiffness.is_finite() && stiffness > 0.0 => Ok(Some(stiffness)),
        _ => Err(DatasetError::StatedStiffness { path: bag.path().to_owned(), found }),
    }
}

/// The stiffness of the first stream of a topic of a bag (density x velocity^2): the bag of a scene has one.
///
/// # Errors
/// [`DatasetError::Stiffness`] if it is not known, [`DatasetError::StatedStiffness`] if what `metadata.yaml` says is no stiffness,
/// [`DatasetError::Bag`] if the bag cannot be read.
pub fn stiffness_of(bag: &BagReader, topic: &str) -> Result<f32, DatasetError> {
    let first = bag.frames(topic)?.next().transpose()?;
    let stream = first.map_or(0, |frame| frame.stream);
    let found = Stiffnesses::default().of(stated(bag)?, bag.path(), stream);
    found.ok_or_else(|| DatasetError::Stiffness { path: bag.path().to_owned(), stream })
}
