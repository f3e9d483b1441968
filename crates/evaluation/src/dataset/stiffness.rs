//! Sources of a stream's stiffness: the metadata of its bag, otherwise the manifest of `eddy simulate` beside the bag.

use std::path::Path;

use super::{DatasetError, simulate::ScenesBeside};
use eddy_bag::{
    BagReader,
    custom_data::{STIFFNESS, parse_stiffness},
};

/// The stiffness of the streams of bags.
pub(super) struct Stiffnesses {
    /// What the metadata of each bag says.
    stated: Vec<Option<f32>>,
    beside: ScenesBeside,
}

impl Stiffnesses {
    /// Of these bags.
    ///
    /// # Errors
    /// [`DatasetError::StatedStiffness`].
    pub(super) fn of_bags(bags: &[BagReader]) -> Result<Self, DatasetError> {
        let stated = bags.iter().map(stated).collect::<Result<_, _>>()?;
        Ok(Self { stated, beside: ScenesBeside::default() })
    }

    /// The stiffness of a stream in the bag of this number and path (density x velocity^2); `None` if unknown.
    pub(super) fn of(&mut self, bag: usize, path: &Path, stream: u64) -> Option<f32> {
        self.stated[bag].or_else(|| self.beside.stiffness(path, stream))
    }
}

/// What the metadata of a bag says (density x velocity^2); `None` if it says nothing.
///
/// # Errors
/// [`DatasetError::StatedStiffness`] unless it is a positive number.
fn stated(bag: &BagReader) -> Result<Option<f32>, DatasetError> {
    let Some(found) = bag.custom_data().get(STIFFNESS) else { return Ok(None) };
    let invalid =
        || DatasetError::StatedStiffness { path: bag.path().to_owned(), found: found.clone() };
    parse_stiffness(found).map(Some).ok_or_else(invalid)
}

/// The stiffness of the streams of a bag (density x velocity^2), if its metadata says it, otherwise of the first stream of a topic.
///
/// # Errors
/// [`DatasetError::Stiffness`] if it is not known, [`DatasetError::StatedStiffness`] if the metadata says no positive number,
/// [`DatasetError::Bag`] if the bag cannot be read.
pub fn stiffness_of(bag: &BagReader, topic: &str) -> Result<f32, DatasetError> {
    if let Some(stated) = stated(bag)? {
        return Ok(stated);
    }
    let first = bag.frames(topic)?.next().transpose()?;
    let stream = first.map_or(0, |frame| frame.stream);
    let unknown = || DatasetError::Stiffness { path: bag.path().to_owned(), stream };
    ScenesBeside::default().stiffness(bag.path(), stream).ok_or_else(unknown)
}

/// The stiffness of a stream of a bag (density x velocity^2), as its metadata says it, otherwise as `beside` does; `None` if it is not
/// known.
///
/// # Errors
/// [`DatasetError::StatedStiffness`] if the metadata says no positive number.
pub fn stiffness_of_stream(
    bag: &BagReader,
    stream: u64,
    beside: &mut ScenesBeside,
) -> Result<Option<f32>, DatasetError> {
    Ok(stated(bag)?.or_else(|| beside.stiffness(bag.path(), stream)))
}
