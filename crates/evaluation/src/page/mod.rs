//! Self-contained HTML pages, for the reports of `eval`, `bench` and `study`.
//!
//! 1. `document`: a page of sections, each with paragraphs, tables, plots and pictures.
//! 2. `table`: rows of numbers under a caption. `text`: the same for a terminal.
//! 3. `plot`: named curves on linear or logarithmic axes, as SVG. `hover`: their values for `page.js`.
//! 4. `scale`: ranges and ticks of axes.
//! 5. `style`: colours, dashes and marks, distinguishable in print and by colour-blind readers.
//! 6. `grid`: pictures in rows and columns.
//! 7. `provenance`: command, version, machine and date.
//!
//! A page has no external resources. Its script adds values under the pointer and sortable tables; everything can be read
//! without it, and in print. All text is escaped.

mod document;
mod grid;
mod hover;
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
