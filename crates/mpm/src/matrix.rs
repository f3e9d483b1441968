//! 2x2 matrices for the constitutive law.

use std::ops::{Add, Mul};

/// A 2x2 matrix; `xy` is row x, column y.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Matrix2 {
    /// Row x, column x.
    pub xx: f32,
    /// Row x, column y.
    pub xy: f32,
    /// Row y, column x.
    pub yx: f32,
    /// Row y, column y.
    pub yy: f32,
}

impl Matrix2 {
    /// The identity.
    pub const IDENTITY: Self = Self::new(1.0, 0.0, 0.0, 1.0);
    /// Zero everywhere.
    pub const ZERO: Self = Self::new(0.0, 0.0, 0.0, 0.0);

    /// The matrix with these rows: `[[xx, xy], [yx, yy]]`.
    pub const fn new(xx: f32, xy: f32, yx: f32, yy: f32) -> Self {
        Self { xx, xy, yx, yy }
    }

    /// `value` on the diagonal.
    pub const fn diagonal(value: f32) -> Self {
        Self::new(value, 0.0, 0.0, value)
    }

    /// The determinant.
    pub fn determinant(self) -> f32 {
        self.xx * self.yy - self.xy * self.yx
    }

    /// The transpose.
    pub fn transpose(self) -> Self {
        Self::new(self.xx, self.yx, self.xy, self.yy)
    }
}

impl Add for Matrix2 {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self::new(self.xx + other.xx, self.xy + other.xy, self.yx + other.yx, self.yy + other.yy)
    }
}

impl Mul for Matrix2 {
    type Output = Self;

    fn mul(self, other: Self) -> Self {
        Self::new(
            self.xx * other.xx + self.xy * other.yx,
            self.xx * other.xy + self.xy * other.yy,
            self.yx * other.xx + self.yy * other.yx,
            self.yx * other.xy + self.yy * other.yy,
        )
    }
}

impl Mul<f32> for Matrix2 {
    type Output = Self;

    fn mul(self, factor: f32) -> Self {
        Self::new(self.xx * factor, self.xy * factor, self.yx * factor, self.yy * factor)
    }
}
