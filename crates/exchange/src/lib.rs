//! Converts frames between bags and the files of other programs: NumPy, ParaView, learned simulators.
//!
//! Imports run one way, from the end of this list to its start.
//!
//! Export:
//! 1. `streams`: the streams of bags, their properties and frames. `aligned`: frames of several topics, matched by
//!    sequence number.
//! 2. `export`: selects the format. `csv` is one table, `ply` and `vtu` are one file per frame, `vtkhdf` is one per
//!    stream; `vtu` and `vtkhdf` have properties of the particles (`point_data`), among them density and strain (`fields`),
//!    pressure and energy (`recorded`). `npz` has arrays, `gns` and `hdf5` are data sets of learned simulators
//!    (`data_set`) with a `metadata.json` (`metadata`).
//!
//! Import:
//! 3. `trajectory`: checks the arrays of one stream and makes frames of them.
//! 4. `import`: writes bags like those of `eddy simulate`.
//!
//! Both: `arrays`, NumPy arrays in a zip archive, without pickles.

mod aligned;
mod arrays;
mod csv;
mod data_set;
mod error;
mod export;
mod fields;
mod gns;
#[cfg(feature = "hdf5")]
mod hdf5;
mod import;
mod metadata;
mod npz;
mod ply;
mod point_data;
mod recorded;
mod streams;
mod trajectory;
#[cfg(feature = "hdf5")]
mod vtkhdf;
mod vtu;

pub use aligned::{AlignedFrames, Frames};
pub use error::ExchangeError;
pub use export::{ExportFormat, export};
pub use import::{ImportFormat, Imported, import};
pub use streams::{FrameSelection, Progress, Streams, Track};
pub use trajectory::ImportOverrides;

/// The example of the README, which a test runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
