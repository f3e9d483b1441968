//! Self-contained HTML pages, for the reports of `eval`, `bench` and `study`, and pictures of particle frames.
//!
//! 1. `document`: a page of sections, each with paragraphs, tables, plots and pictures.
//! 2. `table`: rows of numbers under a caption. `text`: the same for a terminal.
//! 3. `plot`: named curves on linear or logarithmic axes, as SVG. `hover`: their values for `page.js`.
//! 4. `scale`: ranges and ticks of axes.
//! 5. `style`: colours, dashes and marks, distinguishable in print and by colour-blind readers.
//! 6. `grid`: pictures in rows and columns.
//! 7. `provenance`: command, version, machine and date.
//! 8. [`picture`]: frames and plots as PNG, GIF and MP4.
//!
//! A page has no external resources. Its script adds values under the pointer and sortable tables; everything can be read
//! without it, and in print. All text is escaped.

mod document;
mod grid;
mod hover;
pub mod picture;
mod plot;
mod provenance;
mod scale;
mod style;
mod table;
mod text;

pub use document::{Page, Section};
pub use grid::{Picture, PictureGrid};
pub use plot::{LinePlot, Series};
pub use provenance::{Machine, Provenance, command_line};
pub use scale::{Axis, Scale};
pub use table::{Cell, Table};
pub use text::wrapped;

/// The example of the README, which a test runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
