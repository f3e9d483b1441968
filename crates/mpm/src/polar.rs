//! Polar and singular value decomposition of a 2x2 matrix in closed form, without an angle.
//!
//! Every 2x2 matrix is the sum of a conformal part `[[a, -b], [b, a]]` (a rotation times `q`) and an
//! anticonformal part `[[c, d], [d, -c]]` (a reflection times `r`). Its singular values are `q + r`
//! and `q - r`, the second one negative for an inverted matrix, and the rotation of its polar
//! decomposition is the conformal part divided by `q`.

use super::matrix::Matrix2;

/// Below this the rotation of a matrix is undefined and taken as the identity.
const MIN_CONFORMAL: f32 = 1e-12;

/// A matrix split into its conformal and its anticonformal part.
#[derive(Clone, Copy, Debug)]
pub(super) struct Decomposition {
    /// The conformal part.
    conformal: Matrix2,
    /// The anticonformal part.
    anticonformal: Matrix2,
    /// Length `q` of the conformal part: the mean of the singular values.
    q: f32,
    /// Length `r` of the anticonformal part: half the difference of the singular values.
    r: f32,
}

/// The rotation `R` of the polar decomposition `F = R S`.
pub(super) fn rotation(matrix: Matrix2) -> Matrix2 {
    let cos = matrix.xx + matrix.yy;
    let sin = matrix.yx - matrix.xy;
    let length = (cos * cos + sin * sin).sqrt();
    if length < MIN_CONFORMAL {
        return Matrix2::IDENTITY;
    }
    let inverse = 1.0 / length;
    let (cos, sin) = (cos * inverse, sin * inverse);
    Matrix2::new(cos, -sin, sin, cos)
}

impl Decomposition {
    /// Splits a matrix.
    pub(super) fn of(matrix: Matrix2) -> Self {
        let a = 0.5 * (matrix.xx + matrix.yy);
        let b = 0.5 * (matrix.yx - matrix.xy);
        let c = 0.5 * (matrix.xx - matrix.yy);
        let d = 0.5 * (matrix.yx + matrix.xy);
        Self {
            conformal: Matrix2::new(a, -b, b, a),
            anticonformal: Matrix2::new(c, d, d, -c),
            q: (a * a + b * b).sqrt(),
            r: (c * c + d * d).sqrt(),
        }
    }

    /// The singular values, the larger one first; the second is negative for an inverted matrix.
    pub(super) fn singular_values(self) -> [f32; 2] {
        [self.q + self.r, self.q - self.r]
    }

    /// Cosine and sine of twice the angle of the axis of the larger singular value in the image: that of the left stretch.
    pub(super) fn left_axis(self) -> [f32; 2] {
        let Self { conformal, anticonformal, q, r } = self;
        // The product of a + ib and c + id has this angle.
        let (a, b) = (conformal.xx, conformal.yx);
        let (c, d) = (anticonformal.xx, anticonformal.yx);
        let length = q * r;
        if q < MIN_CONFORMAL || r < MIN_CONFORMAL {
            return [1.0, 0.0];
        }
        [(a * c - b * d) / length, (a * d + b * c) / length]
    }

    /// The matrix with the same singular vectors and other singular values.
    pub(super) fn with_singular_values(self, [large, small]: [f32; 2]) -> Matrix2 {
        let conformal = rescaled(self.conformal, self.q, 0.5 * (large + small), Matrix2::IDENTITY);
        let mirror = Matrix2::new(1.0, 0.0, 0.0, -1.0);
        let anticonformal = rescaled(self.anticonformal, self.r, 0.5 * (large - small), mirror);
        conformal + anticonformal
    }
}

/// `part` rescaled from length `from` to length `to`; `fallback` is its direction if its length is zero.
fn rescaled(part: Matrix2, from: f32, to: f32, fallback: Matrix2) -> Matrix2 {
    if from < MIN_CONFORMAL { fallback * to } else { part * (to / from) }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn rotated(angle: f32) -> Matrix2 {
        let (sin, cos) = angle.sin_cos();
        Matrix2::new(cos, -sin, sin, cos)
    }

    fn close(a: Matrix2, b: Matrix2, tolerance: f32) -> bool {
        let d = a + b * -1.0;
        [d.xx, d.xy, d.yx, d.yy].iter().all(|x| x.abs() <= tolerance)
    }

    proptest! {
        #[test]
        fn a_matrix_is_its_rotation_times_its_stretch(
            u in -3.1f32..3.1, v in -3.1f32..3.1, large in 0.5f32..2.0, ratio in 0.2f32..1.0
        ) {
            let stretch = Matrix2::new(large, 0.0, 0.0, large * ratio);
            let matrix = rotated(u) * stretch * rotated(v).transpose();
            prop_assert!(close(rotation(matrix), rotated(u) * rotated(v).transpose(), 1e-5));
        }

        #[test]
        fn singular_values_reconstruct_the_matrix(
            u in -3.1f32..3.1, v in -3.1f32..3.1, large in 0.5f32..2.0, ratio in -1.0f32..1.0
        ) {
            let stretch = Matrix2::new(large, 0.0, 0.0, large * ratio);
            let matrix = rotated(u) * stretch * rotated(v).transpose();
            let parts = Decomposition::of(matrix);
            let [first, second] = parts.singular_values();
            prop_assert!((first - large).abs() < 1e-5);
            prop_assert!((second - large * ratio).abs() < 1e-5);
            prop_assert!(close(parts.with_singular_values([first, second]), matrix, 1e-5));
        }
    }

    #[test]
    fn the_rotation_of_the_zero_matrix_is_the_identity() {
        assert_eq!(rotation(Matrix2::ZERO), Matrix2::IDENTITY);
        assert!(close(
            Decomposition::of(Matrix2::ZERO).with_singular_values([1.0, 1.0]),
            Matrix2::IDENTITY,
            0.0
        ));
    }
}
