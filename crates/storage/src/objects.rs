//! Objects of stores.

use std::{
    io::{self, Read as _},
    path::Path,
    sync::Arc,
};

use bytes::Bytes;
use futures_util::TryStreamExt as _;
use object_store::{
    Error, GetOptions, ObjectStore, ObjectStoreExt as _, PutMode, UpdateVersion,
    buffered::BufWriter, path::Path as Key,
};
use tokio::io::AsyncWriteExt as _;

use super::{
    Entry, File, Kind, Storage, Version,
    client::{Location, begin, wait},
    file::{Prefetched, Remote},
};

/// Parts in which a large file is uploaded (bytes).
const PART: usize = 8 << 20;

pub(crate) struct Objects;

impl Storage for Objects {
    fn kind(&self, path: &Path) -> io::Result<Kind> {
        let Location { store, key } = Location::of(path)?;
        wait(async move {
            if !key.as_ref().is_empty() {
                match store.head(&key).await {
                    Ok(_) => return Ok(Kind::File),
                    Err(Error::NotFound { .. }) => {}
                    Err(error) => {
                        // An answer to HEAD has no body that says why.
                        store.list(Some(&key)).try_next().await?;
                        return Err(error);
                    }
                }
            }
            match store.list(Some(&key)).try_next().await? {
                Some(_) => Ok(Kind::Directory),
                None => {
                    Err(Error::NotFound { path: key.to_string(), source: "no such key".into() })
                }
            }
        })
    }

    fn list(&self, directory: &Path) -> io::Result<Vec<Entry>> {
        let Location { store, key } = Location::of(directory)?;
        let prefix = key.clone();
        let found = wait(async move { store.list_with_delimiter(Some(&key)).await })?;
        let entry = |key: &Key, is_directory| {
            // An object of the prefix's own name marks an empty directory.
            let name = key.filename().filter(|_| *key != prefix)?;
            Some(Entry { path: directory.join(name), is_directory })
        };
        let files = found.objects.iter().filter_map(|object| entry(&object.location, false));
        let directories = found.common_prefixes.iter().filter_map(|prefix| entry(prefix, true));
        Ok(files.chain(directories).collect())
    }

    fn open(&self, path: &Path) -> io::Result<File> {
        let Location { store, key } = Location::of(path)?;
        let object = (store.clone(), key.clone());
        let found = wait(async move { store.head(&key).await })?;
        let (store, key) = object;
        Ok(File::remote(Object { store, key, version: found.e_tag }, found.size))
    }
}

/// An object as it was when it was opened.
struct Object {
    store: Arc<dyn ObjectStore>,
    key: Key,
    /// Its entity tag; another object of the same name has another one.
    version: Option<String>,
}

impl Remote for Object {
    fn fetch(&self, position: u64, length: u64) -> Prefetched {
        let (store, key) = (self.store.clone(), self.key.clone());
        let mut options = GetOptions::new().with_range(Some(position..position + length));
        options.if_match = self.version.clone();
        let bytes = begin(async move {
            if length == 0 {
                return Ok(Vec::new());
            }
            Ok(store.get_opts(&key, options).await?.bytes().await?.into())
        });
        Prefetched { length, bytes }
    }
}

/// Stores a file as the object at a URL.
pub(crate) fn upload(file: &Path, to: &Path) -> io::Result<()> {
    let Location { store, key } = Location::of(to)?;
    let mut source = std::fs::File::open(file)?;
    let mut writer = BufWriter::with_capacity(store, key, PART);
    // Read on this thread, part by part: the requests' threads must not wait for a disk.
    loop {
        let mut part = Vec::with_capacity(PART);
        source.by_ref().take(PART as u64).read_to_end(&mut part)?;
        let is_last = part.len() < PART;
        writer = wait(async move {
            writer.put(Bytes::from(part)).await?;
            Ok(writer)
        })?;
        if is_last {
            break;
        }
    }
    wait(async move {
        let outcome = writer.shutdown().await;
        outcome.map_err(|error| Error::Generic { store: "upload", source: error.into() })
    })
}

/// The content of an object and its version; `None` if it does not exist.
pub(crate) fn read_version(path: &Path) -> io::Result<Option<(Vec<u8>, Version)>> {
    let Location { store, key } = Location::of(path)?;
    wait(async move {
        let found = match store.get(&key).await {
            Err(Error::NotFound { .. }) => return Ok(None),
            found => found?,
        };
        let (e_tag, generation) = (found.meta.e_tag.clone(), found.meta.version.clone());
        Ok(Some((found.bytes().await?.into(), Version { e_tag, generation })))
    })
}

/// Replaces the known version of an object, or creates it.
pub(crate) fn replace(path: &Path, bytes: Vec<u8>, known: Option<&Version>) -> io::Result<Version> {
    let Location { store, key } = Location::of(path)?;
    let mode = match known.cloned() {
        None => PutMode::Create,
        Some(Version { e_tag, generation }) => {
            PutMode::Update(UpdateVersion { e_tag, version: generation })
        }
    };
    wait(async move {
        let written =
            store.put_opts(&key, bytes.into(), mode.into()).await.map_err(|error| match error {
                // Stores differ in how they say that another version is there.
                Error::Precondition { path, source } => Error::AlreadyExists { path, source },
                other => other,
            })?;
        Ok(Version { e_tag: written.e_tag, generation: written.version })
    })
}
