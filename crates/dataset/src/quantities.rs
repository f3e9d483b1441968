//! Sources of a stream's stiffness and gravity: the metadata of its bag, otherwise the manifest of `eddy simulate` beside the bag.

use std::path::Path;

use super::{DatasetError, simulate::ScenesBeside};
use eddy_bag::{BagReader, custom_data::Quantity};
use eddy_inference::engine::Stated;

/// Stiffness and gravity of the streams of bags.
pub(super) struct Quantities {
    /// What the metadata of each bag says.
    stated: Vec<Stated>,
    beside: ScenesBeside,
}

impl Quantities {
    /// Of these bags.
    ///
    /// # Errors
    /// [`DatasetError::Stated`].
    pub(super) fn of_bags(bags: &[BagReader]) -> Result<Self, DatasetError> {
        let of_bag = |bag| -> Result<Stated, DatasetError> {
            let gravity = stated(bag, Quantity::Gravity)?;
            Ok(Stated { gravity, stiffness: stated(bag, Quantity::Stiffness)? })
        };
        let stated = bags.iter().map(of_bag).collect::<Result<_, _>>()?;
        Ok(Self { stated, beside: ScenesBeside::default() })
    }

    /// Those of a stream in the bag of this number and path, as far as they are known.
    pub(super) fn of(&mut self, bag: usize, path: &Path, stream: u64) -> Stated {
        let Stated { gravity, stiffness } = self.stated[bag];
        let mut beside = |quantity| self.beside.quantity(path, stream, quantity);
        Stated {
            gravity: gravity.or_else(|| beside(Quantity::Gravity)),
            stiffness: stiffness.or_else(|| beside(Quantity::Stiffness)),
        }
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

/// Stiffness and gravity of the streams of a bag, if its metadata says them, otherwise of the first stream of a topic, as far as they are
/// known.
///
/// # Errors
/// [`DatasetError::Stated`] if the metadata says no number in their ranges.
pub fn stated_by(bag: &BagReader, topic: &str) -> Result<Stated, DatasetError> {
    let mut quantities = Quantities::of_bags(std::slice::from_ref(bag))?;
    // Whoever reads the frames reports what is wrong with them.
    let first = bag.frames(topic).ok().and_then(|mut frames| frames.next()?.ok());
    Ok(quantities.of(0, bag.path(), first.map_or(0, |frame| frame.stream)))
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
