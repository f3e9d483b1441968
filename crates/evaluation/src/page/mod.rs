//! Self-contained HTML pages: what `eval`, `bench` and the paper's comparisons show to people.
//!
//! 1. `document`: a page of sections, each with paragraphs, tables, plots and pictures.
//! 2. `table`: rows of numbers under a caption.
//! 3. `plot`: named curves on linear or logarithmic axes, as SVG.
//! 4. `scale`: where an axis begins and ends, and its ticks.
//! 5. `style`: colours, dashes and marks that are told apart in print and by the colour-blind.
//! 6. `grid`: pictures in rows and columns.
//! 7. `provenance`: how to make a page again.
//!
//! A page needs nothing but itself: no script, no font, no request. Whatever text goes in is escaped.

mod document;
mod grid;
mod plot;
mod provenance;
mod scale;
mod style;
mod table;

pub use document::{Page, Section};
pub use grid::{Picture, PictureGrid};
pub use plot::{LinePlot, Series};
pub use provenance::{Machine, Provenance, command_line};
pub use scale::{Axis, Scale};
pub use table::{Cell, Table};
