//! Sources of a stream's stiffness and gravity: the metadata of its bag, otherwise the manifest of `eddy simulate` beside the bag.

use std::path::Path;

use super::{DatasetError, simulate::ScenesBeside};
use eddy_bag::{BagReader, custom_data::Quantity};

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
    /// [`DatasetError::Stated`].
    pub(super) fn of_bags(bags: &[BagReader]) -> Result<Self, DatasetError> {
        let stated = bags.iter().map(|bag| stated(bag, Quantity::Stiffness));
        Ok(Self { stated: stated.collect::<Result<_, _>>()?, beside: ScenesBeside::default() })
    }

    /// The stiffness of a stream in the bag of this number and path (density x velocity^2); `None` if unknown.
    pub(super) fn of(&mut self, bag: usize, path: &Path, stream: u64) -> Option<f32> {
        self.stated[bag].or_else(|| self.beside.quantity(path, stream, Quantity::Stiffness))
    }
}

/// What the metadata of a bag says; `None` if it says nothing.
///
/// # Errors
/// [`DatasetError::Stated`] unless it is a number in the range of the quantity.
fn stated(bag: &BagReader, quantity: Quantity) -> Result<Option<f32>, DatasetError> {
    let invalid = |found: &str| DatasetError::Stated {
        path: bag.path().to_owned(),
        quantity,
        found: found.to_owned(),
    };
    quantity.stated_in(bag.custom_data()).map_err(invalid)
}

/// The stiffness of the streams of a bag (density x velocity^2), if its metadata says it, otherwise of the first stream of a topic.
///
/// # Errors
/// [`DatasetError::Stiffness`] if it is not known, [`DatasetError::Stated`] if the metadata says no positive number,
/// [`DatasetError::Bag`] if the bag cannot be read.
pub fn stiffness_of(bag: &BagReader, topic: &str) -> Result<f32, DatasetError> {
    if let Some(stated) = stated(bag, Quantity::Stiffness)? {
        return Ok(stated);
    }
    let first = bag.frames(topic)?.next().transpose()?;
    let stream = first.map_or(0, |frame| frame.stream);
    let known = quantity_of_stream(bag, stream, Quantity::Stiffness, &mut ScenesBeside::default())?;
    known.ok_or_else(|| DatasetError::Stiffness { path: bag.path().to_owned(), stream })
}

/// A quantity of a stream of a bag, as its metadata says it, otherwise as `beside` does; `None` if it is not known.
///
/// # Errors
/// [`DatasetError::Stated`] if the metadata says no number in the range of the quantity.
pub fn quantity_of_stream(
    bag: &BagReader,
    stream: u64,
    quantity: Quantity,
    beside: &mut ScenesBeside,
) -> Result<Option<f32>, DatasetError> {
    Ok(stated(bag, quantity)?.or_else(|| beside.quantity(bag.path(), stream, quantity)))
}
