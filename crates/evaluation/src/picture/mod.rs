//! Pictures of frames and numbers: PNG, animated PNG, GIF.
//!
//! 1. `palette`: colours of materials and of speeds.
//! 2. `canvas`: pixels: discs with smooth edges, lines, words.
//! 3. `panel`: one frame: the domain, its particles, the time, and what the colours mean.
//! 4. `scatter`: named points on logarithmic axes.
//! 5. `file`: PNG and animations.
//! 6. `quantize`: the 256 colours of a GIF.

mod canvas;
mod file;
mod palette;
mod panel;
mod quantize;
mod scatter;

pub use canvas::Canvas;
pub use file::{Animation, Kind, PictureError, png_bytes, write_png};
pub use palette::{Rgb, of_material as material_color, scale as scale_colors};
pub use panel::{Coloring, Painter};
pub use scatter::{Mark, Scatter, ScatterPoint};
