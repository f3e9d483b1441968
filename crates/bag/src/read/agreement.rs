//! Compares what `metadata.yaml` says of a bag with its files.

use std::path::Path;

use super::{
    contents::{Contents, TopicInfo},
    index::FileIndex,
    reader::BagReader,
};
use crate::format::{
    channel::Channel,
    description::{DescribedTopic, Description},
    layout, metadata,
};
use eddy_frames::Stamp;

/// Some writers state a duration that is a nanosecond longer.
const TOLERANCE: i64 = 1;

/// What a bag says differently in two places.
pub(super) fn disagreements(bag: &BagReader) -> Vec<String> {
    let contents = bag.contents();
    let mut found = versions(contents);
    if let Some(in_yaml) = &contents.in_yaml {
        let yaml = contents.path.join(metadata::FILE_NAME);
        let of_yaml = counts(bag, in_yaml)
            .into_iter()
            .chain(times(bag, in_yaml))
            .chain(topics(contents, in_yaml))
            .chain(files(contents, in_yaml))
            .chain(recording(in_yaml, &contents.in_files));
        found.extend(of_yaml.map(|finding| format!("{}: {finding}", yaml.display())));
    }
    found
}

/// The channels of each version of the type of a topic.
fn versions_of(contents: &Contents, topic: usize) -> Vec<Vec<&Channel>> {
    let mut versions: Vec<Vec<&Channel>> = Vec::new();
    let channels = contents.distinct.iter().zip(&contents.topic_of);
    for (channel, _) in channels.filter(|(_, of)| **of == topic) {
        let same = |version: &&mut Vec<&Channel>| {
            version.iter().all(|known| known.is_same_version(channel))
        };
        match versions.iter_mut().find(same) {
            Some(version) => version.push(channel),
            None => versions.push(vec![channel]),
        }
    }
    versions
}

/// Topics with several versions of a type.
fn versions(contents: &Contents) -> Vec<String> {
    let describe = |(number, topic): (usize, &TopicInfo)| {
        let versions = versions_of(contents, number);
        let hash = |version: &Vec<&Channel>| {
            let hash = version.iter().find_map(|channel| channel.type_hash());
            hash.unwrap_or("one without a type hash").to_owned()
        };
        let (count, TopicInfo { name, type_name, .. }) = (versions.len(), topic);
        let hashes = versions.iter().map(hash).collect::<Vec<_>>().join(", ");
        (count > 1).then(|| {
            format!("topic {name}: found {count} versions of {type_name} ({hashes}), expected one")
        })
    };
    contents.topics.iter().enumerate().filter_map(describe).collect()
}

fn counts(bag: &BagReader, in_yaml: &Description) -> Option<String> {
    let stated = in_yaml.message_count?;
    let found = bag.message_count();
    (stated != found)
        .then(|| format!("message_count: found {stated}, expected the {found} of the files"))
}

fn times(bag: &BagReader, in_yaml: &Description) -> Option<String> {
    let of_files = span(bag.start(), bag.end())?;
    differ("starting_time and duration", in_yaml.times?, of_files)
}

fn span(start: Option<Stamp>, end: Option<Stamp>) -> Option<[i64; 2]> {
    let (start, end) = (start?, end?);
    Some([start.0, end.0.saturating_sub(start.0)])
}

fn differ(what: &str, stated: [i64; 2], of_files: [i64; 2]) -> Option<String> {
    let [start, duration] = stated;
    let [first, length] = of_files;
    let agrees = start == first && duration.abs_diff(length) <= TOLERANCE as u64;
    (!agrees).then(|| {
        format!("{what}: found {start} and {duration} ns, expected {first} and {length} ns as in the files")
    })
}

fn topics(contents: &Contents, in_yaml: &Description) -> Vec<String> {
    let mut found = Vec::new();
    if in_yaml.topics.is_empty() {
        return found;
    }
    // The channels as the files have them.
    let channels = || contents.files.iter().flat_map(|file| file.channels.values());
    for topic in &in_yaml.topics {
        let DescribedTopic { name, type_name, hash, messages, .. } = topic;
        let of_topic: Vec<&Channel> = channels()
            .map(|channel| &**channel)
            .filter(|channel| channel.topic == *name && channel.type_name() == type_name)
            .collect();
        let in_files = contents.topics.iter();
        let in_files =
            in_files.filter(|topic| topic.name == *name && topic.type_name == *type_name);
        let count: u64 = in_files.map(|topic| topic.message_count).sum();
        let same = in_yaml
            .topics
            .iter()
            .filter(|other| other.name == *name && other.type_name == *type_name);
        let stated: Option<u64> = same.map(|topic| topic.messages).sum();
        if of_topic.is_empty() && *messages != Some(0) {
            let other = channels().find(|channel| channel.topic == *name);
            let expected =
                other.map_or("no such topic".to_owned(), |channel| channel.type_name().to_owned());
            found.push(format!(
                "topic {name}: found type {type_name}, expected {expected} as in the files"
            ));
        } else if let Some(stated) = stated.filter(|stated| *stated != count) {
            found.push(format!(
                "topic {name}: found {stated} messages, expected the {count} of the files"
            ));
        }
        if !topic.offers_as(&of_topic) {
            found.push(format!("topic {name}: found other offered_qos_profiles than in the files, expected the same; those of metadata.yaml are used"));
        }
        let hashes = of_topic.iter().filter_map(|channel| channel.type_hash());
        // Of several versions, which are a finding of their own, there is only one in metadata.yaml.
        let is_one = hashes.clone().all(|of| Some(of) == hashes.clone().next());
        let other = hashes.clone().find(|of| is_one && !hash.is_empty() && *of != hash.as_str());
        if let Some(other) = other {
            found.push(format!("topic {name}: type_description_hash: found {hash}, expected {other} as in the files; that of metadata.yaml is used"));
        }
    }
    for topic in contents.topics.iter().filter(|topic| topic.message_count > 0) {
        let is_listed = in_yaml.topics.iter().any(|listed| listed.name == topic.name);
        if !is_listed {
            let (name, count) = (&topic.name, topic.message_count);
            found.push(format!("topics_with_message_count: found no {name}, expected it with the {count} messages of the files"));
        }
    }
    // Two versions of a type may have an entry each.
    found.dedup();
    found
}

fn files(contents: &Contents, in_yaml: &Description) -> Vec<String> {
    let mut found = Vec::new();
    let name = |path: &Path| path.file_name().map(|name| name.to_string_lossy().into_owned());
    let of_file = |file: &FileIndex| {
        let stated = in_yaml.files.get(&name(&file.path)?)?;
        let count = file.messages();
        let messages = (stated.messages != count).then(|| {
            format!(
                "files: {}: message_count: found {}, expected {count}",
                name(&file.path).unwrap_or_default(),
                stated.messages
            )
        });
        let (first, last) = file.times.unwrap_or_default();
        let stamp = |time: u64| Some(Stamp(i64::try_from(time).unwrap_or(i64::MAX)));
        let of_file = span(stamp(first), stamp(last)).filter(|_| count > 0);
        let times = of_file.and_then(|of_file| {
            let what = format!("files: {}: starting_time and duration", name(&file.path)?);
            differ(&what, stated.times, of_file)
        });
        Some([messages, times])
    };
    found.extend(contents.files.iter().filter_map(of_file).flatten().flatten());
    let unlisted = layout::mcap_files(&contents.path).unwrap_or_default();
    for file in unlisted
        .iter()
        .filter(|file| contents.files.iter().all(|known| name(&known.path) != name(file)))
    {
        let file = name(file).unwrap_or_default();
        found.push(format!(
            "relative_file_paths: found no {file}, expected all .mcap files beside it"
        ));
    }
    found
}

fn recording(in_yaml: &Description, in_files: &Description) -> Vec<String> {
    let mut found = Vec::new();
    let (distro, other) = (&in_yaml.distro, &in_files.distro);
    if !distro.is_empty() && !other.is_empty() && distro != other {
        found.push(format!("ros_distro: found {distro}, expected {other} as in the files; that of metadata.yaml is used"));
    }
    for (key, value) in &in_yaml.custom_data {
        if let Some(other) = in_files.custom_data.get(key).filter(|other| *other != value) {
            found.push(format!("custom_data: {key}: found {value}, expected {other} as in the files; that of metadata.yaml is used"));
        }
    }
    found
}
