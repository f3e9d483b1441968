//! Merges several bags in the order of time.

use std::{collections::BTreeMap, iter::Peekable, path::Path};

use super::copy::{CopyOptions, Recording, copy};
use crate::{
    error::BagError,
    format::{channel::Channel, custom_data::CustomData, summary::BagSummary},
    read::{
        messages::{BagMessage, Messages},
        reader::BagReader,
    },
};

/// Copies the messages of all bags into a new one at `output`, in the order of their log time;
/// messages of the same time in the order of the bags.
///
/// # Errors
/// [`BagError::TopicType`] when a topic has two types, or one type with two definitions by its type
/// hash; otherwise as [`extract`](fn@super::extract).
pub fn merge(
    bags: &[BagReader],
    output: &Path,
    options: CopyOptions<'_>,
) -> Result<BagSummary, BagError> {
    check_types(bags)?;
    let channels = bags.iter().flat_map(|bag| bag.channels());
    let inputs = bags.iter().map(|bag| bag.messages().peekable()).collect();
    let auxiliary = bags.iter().flat_map(BagReader::auxiliary);
    let distro = bags.first().map_or("", BagReader::distro);
    let is_common = bags.iter().all(|bag| bag.distro() == distro);
    let distro = if is_common { distro.to_owned() } else { String::new() };
    let recording = Recording { custom_data: common_custom_data(bags), distro, auxiliary };
    copy(output, channels, recording, Merged { inputs }, options)
}

/// The entries that all bags have.
fn common_custom_data(bags: &[BagReader]) -> CustomData {
    let common = bags.iter().map(|bag| bag.custom_data().clone()).reduce(|mut common, other| {
        common.retain(|key, value| other.get(key) == Some(value));
        common
    });
    common.unwrap_or_default()
}

fn check_types(bags: &[BagReader]) -> Result<(), BagError> {
    let mut known: BTreeMap<&str, &Channel> = BTreeMap::new();
    for bag in bags {
        for channel in bag.channels() {
            let first = known.entry(&channel.topic).or_insert(channel);
            let same_hash = match (first.type_hash(), channel.type_hash()) {
                (Some(first), Some(hash)) => first == hash,
                _ => true,
            };
            if first.type_name() != channel.type_name() || !same_hash {
                return Err(BagError::TopicType {
                    path: bag.path().into(),
                    topic: channel.topic.clone(),
                    found: type_and_hash(channel),
                    expected: type_and_hash(first),
                });
            }
        }
    }
    Ok(())
}

fn type_and_hash(channel: &Channel) -> String {
    match channel.type_hash() {
        Some(hash) => format!("{} ({hash})", channel.type_name()),
        None => channel.type_name().to_owned(),
    }
}

/// The messages of several bags.
struct Merged {
    inputs: Vec<Peekable<Messages>>,
}

impl Iterator for Merged {
    type Item = Result<BagMessage, BagError>;

    fn next(&mut self) -> Option<Self::Item> {
        let time = |next: Option<&Result<BagMessage, BagError>>| {
            // An error comes first: it stops the copy.
            next.map(|message| message.as_ref().ok().map(|message| message.log_time))
        };
        let (_, earliest) = self
            .inputs
            .iter_mut()
            .enumerate()
            .filter_map(|(number, input)| Some(((time(input.peek())?, number), input)))
            .min_by_key(|(key, _)| *key)?;
        earliest.next()
    }
}
