//! Quantisation to the 256 colours of a GIF. The palette is fixed, so that animations do not flicker.

use super::canvas::Canvas;
use eddy_frames::{
    Material,
    palette::{self, BLACK, GREY, Rgb, WHITE, mix},
};

/// Mixtures of a colour with white, for the edges of discs.
const SHARES: usize = 4;

/// Shades of speed.
const SHADES: usize = 56;

/// Bits per channel of the lookup table.
const BITS: usize = 5;

/// The palette of a GIF and a lookup table of nearest colours.
pub(super) struct Quantizer {
    colors: Vec<Rgb>,
    /// Index of the nearest colour by the upper bits of red, green and blue.
    nearest: Vec<u8>,
}

impl Quantizer {
    /// Greys, materials and speeds, each in several mixtures with white.
    pub(super) fn new() -> Self {
        let materials = Material::ALL.map(palette::of_material);
        let shades = (0..SHADES).map(|i| palette::of_share(i as f32 / (SHADES - 1) as f32));
        let full = materials.into_iter().chain(shades).chain([BLACK, GREY]);
        let mut colors = vec![WHITE];
        colors.extend(full.flat_map(|color| {
            (1..=SHARES).map(move |share| mix(WHITE, color, share as f32 / SHARES as f32))
        }));
        let cells = 1 << (3 * BITS);
        let nearest = (0..cells).map(|cell| index_of_nearest(&colors, center(cell))).collect();
        Self { colors, nearest }
    }

    /// The palette as red, green, blue of each colour.
    pub(super) fn palette(&self) -> Vec<u8> {
        self.colors.as_flattened().to_vec()
    }

    /// The picture as indices into the palette.
    pub(super) fn indices(&self, canvas: &Canvas) -> Vec<u8> {
        canvas.pixels().iter().map(|&pixel| self.nearest[cell(pixel)]).collect()
    }
}

fn cell([red, green, blue]: Rgb) -> usize {
    let upper = |channel: u8| usize::from(channel) >> (8 - BITS);
    (upper(red) << (2 * BITS)) | (upper(green) << BITS) | upper(blue)
}

/// The centre of a cell; the outermost cells represent pure black and white.
fn center(cell: usize) -> Rgb {
    let mask = (1 << BITS) - 1;
    let channel = |shift: usize| (((cell >> shift) & mask) * 255 / mask) as u8;
    [channel(2 * BITS), channel(BITS), channel(0)]
}

fn index_of_nearest(colors: &[Rgb], color: Rgb) -> u8 {
    let distance = |other: &Rgb| -> i32 {
        (0..3).map(|i| (i32::from(other[i]) - i32::from(color[i])).pow(2)).sum()
    };
    let nearest = colors.iter().enumerate().min_by_key(|(_, other)| distance(other));
    nearest.map_or(0, |(index, _)| index as u8)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_that_occur_are_nearly_preserved() {
        let quantizer = Quantizer::new();
        assert!(quantizer.colors.len() <= 256, "{}", quantizer.colors.len());
        let shades = (0..=20u8).map(|i| palette::of_share(f32::from(i) / 20.0));
        let occurring = Material::ALL.map(palette::of_material).into_iter().chain(shades);
        for color in occurring.chain([WHITE, GREY]) {
            let shown = quantizer.colors[usize::from(quantizer.nearest[cell(color)])];
            let error = (0..3).map(|i| shown[i].abs_diff(color[i])).max().unwrap();
            assert!(error <= 12, "{color:?} is shown as {shown:?}");
        }
    }
}
