//! Errors of iceoryx2 in words that say what to do. iceoryx2 names an error (`NodeCreationFailure::InternalError`), but not what it was
//! about; what is known to cause such errors is looked for here.

use std::{fmt::Display, fs, os::unix::fs::MetadataExt as _, path::PathBuf};

use iceoryx2::config::Config;

use crate::{Link, TransportError, descriptors, middleware};

/// Where Linux keeps shared memory.
const MEMORY: &str = "/dev/shm";

/// What an action on `link` failed for.
pub(super) fn error(link: &Link, action: &'static str, reason: &dyn Display) -> TransportError {
    if let Err(error) = descriptors::ensure(link, 0) {
        return error;
    }
    let user = rustix::process::geteuid().as_raw();
    // The superuser may use all files.
    if user != 0
        && let Some((path, owner)) = of_others(places(Config::global_config()), user)
    {
        return TransportError::OtherUser { link: link.clone(), path, owner, user };
    }
    middleware::error(link, action, &words(&reason.to_string()))
}

/// The folders of iceoryx2 and what is in them.
fn places(config: &Config) -> impl Iterator<Item = PathBuf> {
    let global = &config.global;
    let folders = [*global.root_path(), global.node_dir(), global.service_dir()];
    let folders = folders.map(|folder| PathBuf::from(folder.to_string()));
    let inside = folders.clone().into_iter().flat_map(|folder| fs::read_dir(folder).into_iter());
    let inside = inside.flatten().flatten().map(|entry| entry.path());
    folders.into_iter().chain(inside)
}

/// The first of these that belongs to another user, and which.
fn of_others(paths: impl IntoIterator<Item = PathBuf>, user: u32) -> Option<(PathBuf, u32)> {
    paths.into_iter().find_map(|path| {
        let owner = fs::metadata(&path).ok()?.uid();
        (owner != user).then_some((path, owner))
    })
}

/// The name of an error as words: `NodeCreationFailure::InternalError` is an internal error of iceoryx2. Anything else stays as it is.
fn words(text: &str) -> String {
    let name = text.rsplit("::").next().unwrap_or_default();
    let is_name = text.chars().all(|c| c.is_ascii_alphanumeric() || c == ':')
        && name.starts_with(|c: char| c.is_ascii_uppercase());
    if !is_name {
        return text.to_owned();
    }
    let mut words = String::new();
    for character in name.chars() {
        if character.is_ascii_uppercase() && !words.is_empty() {
            words.push(' ');
        }
        words.push(character.to_ascii_lowercase());
    }
    format!(
        "{words} (iceoryx2; its files are in {} and {MEMORY})",
        Config::global_config().global.root_path()
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_errors_become_words_and_sentences_stay() {
        for text in ["NodeCreationFailure::InternalError", "InternalError"] {
            let words = words(text);
            assert!(words.starts_with("internal error (iceoryx2; its files are in /"), "{words}");
        }
        for text in ["Permission denied (os error 13)", "gone"] {
            assert_eq!(words(text), text);
        }
    }

    #[test]
    fn files_of_another_user_are_found() {
        let path = std::env::temp_dir();
        let owner = fs::metadata(&path).unwrap().uid();
        let paths = || [PathBuf::from("/nowhere"), path.clone()];
        assert_eq!(of_others(paths(), owner), None);
        assert_eq!(of_others(paths(), owner + 1), Some((path.clone(), owner)));
    }
}
