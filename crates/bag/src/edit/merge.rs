//! Merges several bags in the order of time.

use std::{
    collections::{BTreeMap, HashSet},
    iter::Peekable,
    path::Path,
    sync::Arc,
};

use super::copy::{CopyOptions, Recording, copy};
use crate::{
    error::BagError,
    format::{channel::Channel, custom_data::CustomData, summary::BagSummary},
    read::{messages::BagMessage, reader::BagReader},
};

/// A bag made from several.
#[derive(Debug)]
pub struct MergedBag {
    /// The new bag.
    pub summary: BagSummary,
    /// Why topics of some bags are not in it, each a [`BagError::TopicType`].
    pub left_out: Vec<BagError>,
}

/// Copies the messages of all bags into a new one at `output`, in the order of their log time;
/// messages of the same time in the order of the bags.
///
/// A topic of a bag is left out if it has another type there, or another definition by its type hash, than in the first bag
/// that has it: programs expect one type for each topic.
///
/// # Errors
/// As [`extract`](fn@super::extract).
pub fn merge(
    bags: &[BagReader],
    output: &Path,
    options: CopyOptions<'_>,
) -> Result<MergedBag, BagError> {
    let (kept, left_out) = of_one_type(bags);
    let inputs = bags.iter().map(|bag| {
        let is_kept = |message: &Result<BagMessage, _>| {
            message.as_ref().map_or(true, |message| kept.contains(&message.channel))
        };
        bag.messages().filter(is_kept).peekable()
    });
    let inputs = inputs.collect();
    let channels =
        bags.iter().flat_map(BagReader::channels).filter(|&channel| kept.contains(channel));
    let auxiliary = bags.iter().flat_map(BagReader::auxiliary);
    let distro = bags.first().map_or("", BagReader::distro);
    let is_common = bags.iter().all(|bag| bag.distro() == distro);
    let distro = if is_common { distro.to_owned() } else { String::new() };
    let recording = Recording { custom_data: common_custom_data(bags), distro, auxiliary };
    let summary = copy(output, channels, recording, Merged { inputs }, options)?;
    Ok(MergedBag { summary, left_out })
}

/// The entries that all bags have.
fn common_custom_data(bags: &[BagReader]) -> CustomData {
    let common = bags.iter().map(|bag| bag.custom_data().clone()).reduce(|mut common, other| {
        common.retain(|key, value| other.get(key) == Some(value));
        common
    });
    common.unwrap_or_default()
}

/// The channels with the type that their topic has in the first bag that has it, and why the others are left out.
fn of_one_type(bags: &[BagReader]) -> (HashSet<&Arc<Channel>>, Vec<BagError>) {
    let mut known: BTreeMap<&str, &Channel> = BTreeMap::new();
    let (mut kept, mut left_out) = (HashSet::new(), Vec::new());
    for bag in bags {
        for channel in bag.channels() {
            let first = known.entry(&channel.topic).or_insert(channel);
            let same_hash = match (first.type_hash(), channel.type_hash()) {
                (Some(first), Some(hash)) => first == hash,
                _ => true,
            };
            if first.type_name() == channel.type_name() && same_hash {
                kept.insert(channel);
            } else {
                left_out.push(BagError::TopicType {
                    path: bag.path().into(),
                    topic: channel.topic.clone(),
                    found: type_and_hash(channel),
                    expected: type_and_hash(first),
                });
            }
        }
    }
    (kept, left_out)
}

fn type_and_hash(channel: &Channel) -> String {
    match channel.type_hash() {
        Some(hash) => format!("{} ({hash})", channel.type_name()),
        None => channel.type_name().to_owned(),
    }
}

/// The messages of several bags.
struct Merged<M: Iterator> {
    inputs: Vec<Peekable<M>>,
}

impl<M: Iterator<Item = Result<BagMessage, BagError>>> Iterator for Merged<M> {
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
