//! Points and vectors of scene files: exactly two numbers. Serde reads an array's first numbers and ignores further ones;
//! a scene with three coordinates would silently lose its third.

use serde::{Deserialize, Deserializer, de::Error};

/// Two numbers.
pub fn pair<'de, D: Deserializer<'de>>(deserializer: D) -> Result<[f32; 2], D::Error> {
    two(&Vec::deserialize(deserializer)?)
}

/// A list of two numbers each.
pub fn pairs<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<[f32; 2]>, D::Error> {
    Vec::<Vec<f32>>::deserialize(deserializer)?.iter().map(|numbers| two(numbers)).collect()
}

/// A list of such lists.
pub fn lists<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<Vec<[f32; 2]>>, D::Error> {
    let lists = Vec::<Vec<Vec<f32>>>::deserialize(deserializer)?;
    lists.iter().map(|list| list.iter().map(|numbers| two(numbers)).collect()).collect()
}

fn two<E: Error>(numbers: &[f32]) -> Result<[f32; 2], E> {
    numbers.try_into().map_err(|_| {
        let found = numbers.len();
        E::custom(format!("found {found} numbers, expected 2: scenes are two-dimensional"))
    })
}
