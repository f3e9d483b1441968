//! Pictures of frames and metrics: PNG, animated PNG, GIF.
//!
//! 1. `palette`: colours of materials and of speeds.
//! 2. `canvas`: raster images: antialiased discs, rectangles, text.
//! 3. `panel`: a frame with its time and a legend. Shapes such as tools are drawn over it.
//! 4. `backend`: plots of pages on a canvas.
//! 5. `file`: PNG files and animations. `video`: MP4, written by ffmpeg.
//! 6. `quantize`: the 256 colours of a GIF.
//! 7. `sampling`: which frames a strip or an animation shows.

mod backend;
mod canvas;
mod file;
mod panel;
mod quantize;
mod sampling;
mod video;

pub(crate) use backend::CanvasBackend;
pub use canvas::Canvas;
pub use file::{Animation, Kind, PictureError, png_bytes, write_png};
pub use panel::{Coloring, Painter};
pub use sampling::{animation_timing, evenly_spaced};
