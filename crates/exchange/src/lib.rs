//! Frames to and from the files of other programs: numpy, ParaView, learned simulators.
//!
//! Out of bags:
//! 1. `streams`: which streams the bags hold, what changes in them, and their frames.
//! 2. `export`: the formats and what each writes:
//!    `csv` one table; `ply` and `vtu` a file a frame; `npz` arrays; `gns` and `hdf5` data sets of
//!    learned simulators (`data_set`), with `metadata` (`metadata.json` and the statistics in it).
//!
//! Into bags:
//! 3. `import`: what is missing in a file, and bags as `eddy simulate` writes them.
//! 4. `trajectory`: arrays of one stream, checked and put together to frames.
//!
//! Both ways: `arrays`, numpy's arrays in a zip archive, without pickles.

mod arrays;
mod csv;
mod data_set;
mod error;
mod export;
mod gns;
#[cfg(feature = "hdf5")]
mod hdf5;
mod import;
mod metadata;
mod npz;
mod ply;
mod streams;
mod trajectory;
mod vtu;

pub use error::ExchangeError;
pub use export::{ExportFormat, export};
pub use import::{ImportFormat, Imported, Supplement, import};
pub use streams::{Choice, Streams, Track, Watch};

/// The example of the README, which a test runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
