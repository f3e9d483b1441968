//! A file or an object.

use std::{
    fmt, fs,
    io::{self, Read, Seek, SeekFrom},
    path::{Path, PathBuf},
    sync::{Arc, mpsc},
};

use super::{pieces::Pieces, storage};

/// A file or an object, read at any position from any thread. Cheap to clone.
#[derive(Clone)]
pub struct File {
    size: u64,
    source: Source,
}

#[derive(Clone)]
enum Source {
    /// Opened for every read: a data set has more files than a process may have open.
    Disk(PathBuf),
    #[cfg_attr(not(feature = "object-store"), expect(dead_code, reason = "made with the feature"))]
    Remote(Arc<dyn Remote>),
}

/// An object of a store.
pub(crate) trait Remote: Send + Sync {
    /// Begins to fetch `length` bytes from byte `position`.
    fn fetch(&self, position: u64, length: u64) -> Prefetched;
}

impl File {
    /// Opens a file or an object.
    ///
    /// # Errors
    /// Those of the system or of the store.
    pub fn open(path: &Path) -> io::Result<Self> {
        storage(path)?.open(path)
    }

    pub(crate) fn on_disk(path: PathBuf, size: u64) -> Self {
        Self { size, source: Source::Disk(path) }
    }

    #[cfg(feature = "object-store")]
    pub(crate) fn remote(remote: impl Remote + 'static, size: u64) -> Self {
        Self { size, source: Source::Remote(Arc::new(remote)) }
    }

    /// Size when it was opened (bytes).
    pub fn size(&self) -> u64 {
        self.size
    }

    /// Reads `length` bytes from byte `position`.
    ///
    /// # Errors
    /// Those of the system or of the store; [`io::ErrorKind::UnexpectedEof`] when there are fewer bytes. An object that has
    /// been replaced since it was opened is an error.
    pub fn read(&self, position: u64, length: u64) -> io::Result<Vec<u8>> {
        match &self.source {
            Source::Disk(path) => {
                let mut file = fs::File::open(path)?;
                file.seek(SeekFrom::Start(position))?;
                let mut bytes = Vec::with_capacity(length as usize);
                file.take(length).read_to_end(&mut bytes)?;
                complete(bytes, length)
            }
            Source::Remote(object) => object.fetch(position, length).wait(),
        }
    }

    /// Begins to fetch `length` bytes from byte `position` of an object; `None` for a file on disk, which the system reads
    /// ahead.
    pub fn prefetch(&self, position: u64, length: u64) -> Option<Prefetched> {
        match &self.source {
            Source::Disk(_) => None,
            Source::Remote(object) => Some(object.fetch(position, length)),
        }
    }

    /// A reader that starts at the first byte.
    ///
    /// # Errors
    /// Those of the system.
    pub fn reader(&self) -> io::Result<Reader> {
        Ok(Reader(match &self.source {
            Source::Disk(path) => AnyReader::Disk(fs::File::open(path)?),
            Source::Remote(_) => AnyReader::Remote(Pieces::of(self.clone())),
        }))
    }
}

impl fmt::Debug for File {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let path = match &self.source {
            Source::Disk(path) => Some(path),
            Source::Remote(_) => None,
        };
        f.debug_struct("File").field("path", &path).field("size", &self.size).finish()
    }
}

fn complete(bytes: Vec<u8>, length: u64) -> io::Result<Vec<u8>> {
    if (bytes.len() as u64) < length {
        return Err(io::ErrorKind::UnexpectedEof.into());
    }
    Ok(bytes)
}

/// Bytes on their way from a store.
#[derive(Debug)]
pub struct Prefetched {
    pub(crate) length: u64,
    pub(crate) bytes: mpsc::Receiver<io::Result<Vec<u8>>>,
}

impl Prefetched {
    /// Waits for the bytes.
    ///
    /// # Errors
    /// As [`File::read`].
    pub fn wait(self) -> io::Result<Vec<u8>> {
        let bytes = self.bytes.recv().map_err(|_| io::Error::other("the request has ended"))??;
        complete(bytes, self.length)
    }
}

/// Reads a [`File`] in order, or from wherever it is moved to.
#[derive(Debug)]
pub struct Reader(AnyReader);

#[derive(Debug)]
enum AnyReader {
    Disk(fs::File),
    Remote(Pieces),
}

impl Read for Reader {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        match &mut self.0 {
            AnyReader::Disk(file) => file.read(into),
            AnyReader::Remote(pieces) => pieces.read(into),
        }
    }
}

impl Seek for Reader {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        match &mut self.0 {
            AnyReader::Disk(file) => file.seek(to),
            AnyReader::Remote(pieces) => pieces.seek(to),
        }
    }
}
