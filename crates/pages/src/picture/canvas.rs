//! Raster images.

use eddy_frames::palette::{Rgb, WHITE, mix};
use embedded_graphics::{
    Drawable, Pixel,
    draw_target::DrawTarget,
    geometry::{OriginDimensions, Point, Size},
    mono_font::{
        MonoFont, MonoTextStyle,
        ascii::{FONT_8X13, FONT_10X20},
    },
    pixelcolor::{Rgb888, RgbColor},
    text::{Alignment, Baseline, Text, TextStyleBuilder},
};

const FONT: &MonoFont<'_> = &FONT_8X13;
/// Font of plots.
pub(super) const PLOT_FONT: &MonoFont<'_> = &FONT_10X20;

/// Height of a line of text (pixels).
pub(super) const LINE: usize = 18;

/// A raster image.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Canvas {
    width: usize,
    height: usize,
    pixels: Vec<Rgb>,
}

impl Canvas {
    /// A white image.
    pub fn new(width: usize, height: usize) -> Self {
        Self { width, height, pixels: vec![WHITE; width * height] }
    }

    /// Width (pixels).
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height (pixels).
    pub fn height(&self) -> usize {
        self.height
    }

    /// The pixels, row by row from the top.
    pub fn pixels(&self) -> &[Rgb] {
        &self.pixels
    }

    /// Copies another image into this one, with its upper left corner at `(left, top)`, clipped.
    pub fn paste(&mut self, other: &Self, left: usize, top: usize) {
        let columns = other.width.min(self.width.saturating_sub(left));
        for row in 0..other.height.min(self.height.saturating_sub(top)) {
            let from = &other.pixels[row * other.width..][..columns];
            self.pixels[(top + row) * self.width + left..][..columns].copy_from_slice(from);
        }
    }

    /// Draws an antialiased disc around `(x, y)` (pixels from the upper left corner).
    pub(super) fn disc(&mut self, [x, y]: [f32; 2], radius: f32, color: Rgb) {
        let reach = radius + 0.5;
        let range = |center: f32, extent: usize| {
            let first = (center - reach).floor().max(0.0) as usize;
            let end = (center + reach).ceil().max(0.0) as usize;
            first..end.min(extent)
        };
        for row in range(y, self.height) {
            for column in range(x, self.width) {
                let distance = (column as f32 + 0.5 - x).hypot(row as f32 + 0.5 - y);
                let cover = (reach - distance).clamp(0.0, 1.0);
                let pixel = &mut self.pixels[row * self.width + column];
                *pixel = mix(*pixel, color, cover);
            }
        }
    }

    /// Fills a rectangle, clipped.
    pub(super) fn fill(
        &mut self,
        left: usize,
        top: usize,
        width: usize,
        height: usize,
        color: Rgb,
    ) {
        let columns = left.min(self.width)..(left + width).min(self.width);
        for row in top.min(self.height)..(top + height).min(self.height) {
            self.pixels[row * self.width..][..self.width][columns.clone()].fill(color);
        }
    }

    /// Draws the outline of a rectangle, one pixel wide, inside it.
    pub(super) fn outline(
        &mut self,
        left: usize,
        top: usize,
        width: usize,
        height: usize,
        color: Rgb,
    ) {
        self.fill(left, top, width, 1, color);
        self.fill(left, top + height - 1, width, 1, color);
        self.fill(left, top, 1, height, color);
        self.fill(left + width - 1, top, 1, height, color);
    }

    /// Blends a colour into the pixel at `[x, y]`, clipped.
    pub(super) fn blend(&mut self, [x, y]: [i32; 2], color: Rgb, alpha: f32) {
        let inside = |at: i32, extent| usize::try_from(at).ok().filter(|&at| at < extent);
        if let (Some(x), Some(y)) = (inside(x, self.width), inside(y, self.height)) {
            let pixel = &mut self.pixels[y * self.width + x];
            *pixel = mix(*pixel, color, alpha);
        }
    }

    /// Draws text with its upper left corner at `(left, top)`.
    pub(super) fn text(&mut self, text: &str, left: usize, top: usize, color: Rgb) {
        self.text_in(FONT, text, left, top, color);
    }

    /// As [`Canvas::text`], in a font.
    pub(super) fn text_in(
        &mut self,
        font: &MonoFont<'_>,
        text: &str,
        left: usize,
        top: usize,
        color: Rgb,
    ) {
        let style = MonoTextStyle::new(font, Rgb888::new(color[0], color[1], color[2]));
        let place =
            TextStyleBuilder::new().alignment(Alignment::Left).baseline(Baseline::Top).build();
        let point = Point::new(left as i32, top as i32);
        match Text::with_text_style(text, point, style, place).draw(self) {
            Ok(_) => {}
            Err(never) => match never {},
        }
    }

    /// Width of a text (pixels).
    pub(super) fn width_of(text: &str) -> usize {
        Self::size_of(text, FONT).0
    }

    /// Width and height of a text in a font (pixels).
    pub(super) fn size_of(text: &str, font: &MonoFont<'_>) -> (usize, usize) {
        let Size { width, height } = font.character_size;
        (text.len() * (width + font.character_spacing) as usize, height as usize)
    }
}

impl OriginDimensions for Canvas {
    fn size(&self) -> Size {
        Size::new(self.width as u32, self.height as u32)
    }
}

impl DrawTarget for Canvas {
    type Color = Rgb888;
    type Error = std::convert::Infallible;

    fn draw_iter<I: IntoIterator<Item = Pixel<Rgb888>>>(
        &mut self,
        pixels: I,
    ) -> Result<(), Self::Error> {
        for Pixel(point, color) in pixels {
            self.blend([point.x, point.y], [color.r(), color.g(), color.b()], 1.0);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_disc_covers_its_area_at_any_position() {
        for center in [[10.0, 10.0], [10.3, 9.6], [10.5, 10.5]] {
            let mut canvas = Canvas::new(20, 20);
            canvas.disc(center, 3.0, [0; 3]);
            let ink: f32 = canvas.pixels().iter().map(|p| 1.0 - f32::from(p[0]) / 255.0).sum();
            let area = std::f32::consts::PI * 9.0;
            assert!((ink / area - 1.0).abs() < 0.03, "{ink} of {area}");
        }
    }

    #[test]
    fn drawings_are_clipped() {
        let mut canvas = Canvas::new(10, 8);
        canvas.disc([-40.0, 3.0], 3.0, [0; 3]);
        canvas.disc([f32::MAX, f32::MIN], 3.0, [0; 3]);
        canvas.text("far to the right", 9, 20, [0; 3]);
        assert_eq!(canvas, Canvas::new(10, 8));
        canvas.fill(8, 6, 100, 100, [0; 3]);
        canvas.disc([10.0, 0.0], 2.0, [0; 3]);
        assert_eq!(canvas.pixels()[79], [0; 3]);
    }
}
