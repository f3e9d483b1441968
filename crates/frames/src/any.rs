//! Frames whose dimension is only known from the data.

use std::fmt;

use super::{Domain, Frame, InvalidFrame, spatial};

/// A frame of two or three dimensions.
#[derive(Clone, Debug, PartialEq)]
pub enum AnyFrame {
    /// In the plane.
    Two(Frame<2>),
    /// In space.
    Three(Frame<3>),
}

/// Two or three numbers, one for each axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Coordinates {
    /// Those of axes that there are not are 0.
    numbers: [f32; 3],
    dimension: u32,
}

impl<const D: usize> From<[f32; D]> for Coordinates {
    fn from(coordinates: [f32; D]) -> Self {
        Self { numbers: spatial(coordinates), dimension: D as u32 }
    }
}

impl fmt::Display for Coordinates {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (axis, number) in self.numbers.iter().take(self.dimension as usize).enumerate() {
            let between = if axis > 0 { ", " } else { "" };
            write!(f, "{between}{number}")?;
        }
        Ok(())
    }
}

/// The domain of such a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AnyDomain {
    lower: Coordinates,
    upper: Coordinates,
}

impl<const D: usize> From<Domain<D>> for AnyDomain {
    fn from(Domain { lower, upper }: Domain<D>) -> Self {
        Self { lower: lower.into(), upper: upper.into() }
    }
}

impl AnyDomain {
    /// Number of dimensions, 2 or 3.
    pub fn dimension(&self) -> usize {
        self.lower.dimension as usize
    }

    /// The domain with these corners; `None` unless both have two coordinates or both have three.
    pub fn of_corners(lower: &[f32], upper: &[f32]) -> Option<Self> {
        if let (Ok(lower), Ok(upper)) = (lower.try_into(), upper.try_into()) {
            return Some(Domain::<2> { lower, upper }.into());
        }
        let (Ok(lower), Ok(upper)) = (lower.try_into(), upper.try_into()) else { return None };
        Some(Domain::<3> { lower, upper }.into())
    }
}

impl<const D: usize> TryFrom<AnyDomain> for Domain<D> {
    type Error = InvalidFrame;

    fn try_from(AnyDomain { lower, upper }: AnyDomain) -> Result<Self, InvalidFrame> {
        let found = lower.dimension as usize;
        let corner = |of: Coordinates| std::array::from_fn(|axis| of.numbers[axis]);
        let domain = (found == D).then(|| Self { lower: corner(lower), upper: corner(upper) });
        domain.ok_or_else(|| other(found, D))
    }
}

impl fmt::Display for AnyDomain {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { lower, upper } = self;
        let axes = lower.numbers.iter().zip(&upper.numbers).take(lower.dimension as usize);
        for (axis, (lower, upper)) in axes.enumerate() {
            let between = if axis > 0 { " x " } else { "" };
            write!(f, "{between}{lower} to {upper}")?;
        }
        Ok(())
    }
}

/// Calls the same code for frames of either dimension.
#[macro_export]
macro_rules! with_frame {
    ($any:expr, $frame:ident => $code:expr) => {
        match $any {
            $crate::AnyFrame::Two($frame) => $code,
            $crate::AnyFrame::Three($frame) => $code,
        }
    };
}

/// That a frame has another dimension.
fn other(found: usize, expected: usize) -> InvalidFrame {
    InvalidFrame::Dimension { field: "lower", found, expected: expected.to_string() }
}

impl From<Frame<2>> for AnyFrame {
    fn from(frame: Frame<2>) -> Self {
        Self::Two(frame)
    }
}

impl From<Frame<3>> for AnyFrame {
    fn from(frame: Frame<3>) -> Self {
        Self::Three(frame)
    }
}

impl<'a> TryFrom<&'a AnyFrame> for &'a Frame {
    type Error = InvalidFrame;

    fn try_from(frame: &'a AnyFrame) -> Result<Self, InvalidFrame> {
        match frame {
            AnyFrame::Two(frame) => Ok(frame),
            AnyFrame::Three(_) => Err(other(3, 2)),
        }
    }
}

impl TryFrom<AnyFrame> for Frame<2> {
    type Error = InvalidFrame;

    fn try_from(frame: AnyFrame) -> Result<Self, InvalidFrame> {
        match frame {
            AnyFrame::Two(frame) => Ok(frame),
            AnyFrame::Three(_) => Err(other(3, 2)),
        }
    }
}

impl TryFrom<AnyFrame> for Frame<3> {
    type Error = InvalidFrame;

    fn try_from(frame: AnyFrame) -> Result<Self, InvalidFrame> {
        match frame {
            AnyFrame::Two(_) => Err(other(2, 3)),
            AnyFrame::Three(frame) => Ok(frame),
        }
    }
}
