//! The optimizer's moments by tensor name, and checksums of tensors.

use std::{collections::BTreeMap, path::Path};

use xxhash_rust::xxh3::Xxh3;

use super::{
    TrainError,
    optimizer::{Moments, Optimizer},
    record::damaged,
};
use eddy_inference::checkpoint::{Description, Weights, plan::Plan};

/// XXH3 of names and values, hexadecimal.
pub(super) fn checksum(tensors: &BTreeMap<String, Weights>) -> String {
    let mut hash = Xxh3::new();
    for (name, weights) in tensors {
        hash.update(name.as_bytes());
        for part in weights.values.chunks(1 << 12) {
            hash.update(&part.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>());
        }
    }
    format!("{:032x}", hash.digest128())
}

/// Names and sizes of the network's tensors, in the order of the optimizer; with a number behind it where there are several knots.
fn tensors(description: &Description) -> impl Iterator<Item = (String, usize)> {
    let layers = Plan::new(description).layers.into_iter().flat_map(|layer| {
        let biases = layer.output / layer.sharing;
        [(layer.weight, layer.input * layer.output), (layer.bias, biases)]
    });
    let tensors: Vec<_> = layers.collect();
    let knots = description.stiffness_knots.len();
    (0..knots.max(1)).flat_map(move |knot| {
        let end = if knots == 0 { String::new() } else { format!(".{knot}") };
        tensors.clone().into_iter().map(move |(name, size)| (name + &end, size))
    })
}

/// The optimizer's moments by name; none for tensors without a step.
pub(super) fn moments_by_name(
    optimizer: &Optimizer,
    description: &Description,
) -> BTreeMap<String, Weights> {
    let known = optimizer.moments.iter().zip(tensors(description));
    let held = known.filter(|(moments, _)| !moments.first.is_empty());
    held.flat_map(|(Moments { first, second, .. }, (name, size))| {
        let tensor = |values: &Vec<f32>| Weights { shape: vec![size], values: values.clone() };
        [(format!("first.{name}"), tensor(first)), (format!("second.{name}"), tensor(second))]
    })
    .collect()
}

/// The inverse of [`moments_by_name`].
pub(super) fn moments_in_order(
    file: &Path,
    mut named: BTreeMap<String, Weights>,
    description: &Description,
) -> Result<Vec<Moments>, TrainError> {
    let mut all = Vec::new();
    for (name, size) in tensors(description) {
        let mut take = |order: &str| {
            let name = format!("{order}.{name}");
            match named.remove(&name) {
                None => Ok(Vec::new()),
                Some(weights) if weights.values.len() == size => Ok(weights.values),
                Some(weights) => {
                    let found = format!("{} values", weights.values.len());
                    Err(damaged(file, &name, found, format!("{size} values")))
                }
            }
        };
        let moments =
            Moments { first: take("first")?, second: take("second")?, average: Vec::new() };
        if moments.first.len() != moments.second.len() {
            let found = moments.second.len();
            return Err(damaged(file, &format!("second.{name}"), found, moments.first.len()));
        }
        all.push(moments);
    }
    if let Some((name, _)) = named.first_key_value() {
        return Err(damaged(file, name, "a tensor", "none of that name in this network"));
    }
    Ok(all)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use eddy_inference::checkpoint::{Checkpoint, Core};

    proptest! {
        #[test]
        fn moments_are_restored_by_name(
            core in prop::sample::select(Core::ALL.to_vec()),
            layers in 1..4usize,
            knots in 0..3usize,
            absent in prop::collection::btree_set(0..20usize, 0..5),
        ) {
            let mut description = Checkpoint::shipped().unwrap().description;
            (description.core, description.sizes.layers) = (core, layers);
            (description.sizes.hidden, description.sizes.encoder) = (2, 3);
            description.stiffness_knots = (0..knots).map(|knot| knot as f32 + 1.0).collect();
            let mut next = 0.0;
            let mut numbers = |count: usize| {
                (0..count).map(|_| { next += 1.0; next }).collect::<Vec<f32>>()
            };
            let moments: Vec<_> = tensors(&description)
                .enumerate()
                .map(|(number, (_, size))| {
                    let size = if absent.contains(&number) { 0 } else { size };
                    Moments { first: numbers(size), second: numbers(size), average: Vec::new() }
                })
                .collect();
            let optimizer = Optimizer { steps: 3, moments, ..Optimizer::default() };
            let named = moments_by_name(&optimizer, &description);
            let read = moments_in_order("moments".as_ref(), named.clone(), &description).unwrap();
            prop_assert_eq!(read, optimizer.moments);

            let mut other = named;
            if let Some((name, weights)) = other.first_key_value() {
                let (name, weights) = (format!("{name}x"), weights.clone());
                other.insert(name.clone(), weights);
                let error = moments_in_order("moments".as_ref(), other, &description);
                prop_assert!(error.unwrap_err().to_string().contains(&name));
            }
        }
    }
}
