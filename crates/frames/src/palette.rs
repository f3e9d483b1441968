//! Colour-blind-safe colours.

use super::Material;

/// Red, green and blue, each 0 to 255 (sRGB).
pub type Rgb = [u8; 3];

/// White.
pub const WHITE: Rgb = [255; 3];
/// Outline of the domain.
pub const GREY: Rgb = [150; 3];
/// Tools.
pub const TOOL: Rgb = [95, 100, 110];
/// Forces on tools.
pub const FORCE: Rgb = [190, 30, 45];
/// Text.
pub const BLACK: Rgb = [30; 3];

/// Colour of a material, from the palette of Okabe and Ito ("Color Universal Design", 2008). The colours also differ in
/// lightness.
pub fn of_material(material: Material) -> Rgb {
    match material {
        Material::Liquid => [0, 114, 178],
        Material::Snow => [86, 180, 233],
        Material::Jelly => [230, 159, 0],
        Material::Rope => [213, 94, 0],
        Material::Sand => [204, 121, 167],
    }
}

/// viridis at 0, 1/8, ..., 1 (S. van der Walt and N. Smith, matplotlib 1.5, CC0).
const VIRIDIS: [Rgb; 9] = [
    [68, 1, 84],
    [71, 44, 122],
    [59, 81, 139],
    [44, 113, 142],
    [33, 144, 141],
    [39, 173, 129],
    [92, 200, 99],
    [170, 220, 50],
    [253, 231, 37],
];

/// The colour scale, in equal steps from its lower to its upper end.
pub fn scale() -> &'static [Rgb] {
    &VIRIDIS
}

/// Colour of a speed relative to the maximum, 0 to 1, on a perceptually uniform scale.
pub fn of_share(share: f32) -> Rgb {
    let last = VIRIDIS.len() - 1;
    let place = share.clamp(0.0, 1.0) * last as f32;
    let below = (place as usize).min(last - 1);
    mix(VIRIDIS[below], VIRIDIS[below + 1], place - below as f32)
}

/// Linear interpolation from `from` (0) to `to` (1).
pub fn mix(from: Rgb, to: Rgb, share: f32) -> Rgb {
    let one = |from: u8, to: u8| {
        (f32::from(from) + (f32::from(to) - f32::from(from)) * share).round() as u8
    };
    [one(from[0], to[0]), one(from[1], to[1]), one(from[2], to[2])]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Relative luminance, roughly.
    fn lightness([red, green, blue]: Rgb) -> f32 {
        0.21 * f32::from(red) + 0.72 * f32::from(green) + 0.07 * f32::from(blue)
    }

    #[test]
    fn faster_is_lighter() {
        let shades: Vec<f32> =
            (0..=100u8).map(|i| lightness(of_share(f32::from(i) / 100.0))).collect();
        assert!(shades.is_sorted(), "{shades:?}");
        assert_eq!(of_share(-1.0), VIRIDIS[0]);
        assert_eq!(of_share(2.0), VIRIDIS[8]);
    }

    #[test]
    fn materials_have_distinct_colours() {
        for a in Material::ALL {
            for b in Material::ALL.into_iter().filter(|&b| b > a) {
                let (a, b) = (of_material(a), of_material(b));
                let distance: i32 =
                    (0..3).map(|i| (i32::from(a[i]) - i32::from(b[i])).pow(2)).sum();
                assert!(distance > 50 * 50, "{a:?} {b:?}");
            }
        }
    }
}
