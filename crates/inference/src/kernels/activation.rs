//! The networks' activation functions with their derivatives.

use std::borrow::Cow;

use pulp::{Arch, Simd, WithSimd};

use super::{
    math::{elu, exp, relu, sigmoid, tanh},
    vectors::zip,
};
use crate::checkpoint::Activation;

/// An elementwise activation function y = f(x).
pub trait Activate: Copy + Send + Sync {
    /// y.
    fn value<S: Simd>(self, simd: S, x: S::f32s) -> S::f32s;
    /// dy/dx, from x and y.
    fn slope<S: Simd>(self, simd: S, x: S::f32s, y: S::f32s) -> S::f32s;
}

/// 1 / (1 + exp(-x)).
#[derive(Clone, Copy, Debug)]
pub struct Sigmoid;
/// Hyperbolic tangent.
#[derive(Clone, Copy, Debug)]
pub struct Tanh;
/// max(0, x).
#[derive(Clone, Copy, Debug)]
pub struct Relu;
/// x for x > 0, exp(x) - 1 below.
#[derive(Clone, Copy, Debug)]
pub struct Elu;

impl Activate for Sigmoid {
    #[inline(always)]
    fn value<S: Simd>(self, simd: S, x: S::f32s) -> S::f32s {
        sigmoid(simd, x)
    }
    #[inline(always)]
    fn slope<S: Simd>(self, simd: S, _x: S::f32s, y: S::f32s) -> S::f32s {
        simd.mul_f32s(y, simd.sub_f32s(simd.splat_f32s(1.0), y))
    }
}

impl Activate for Tanh {
    #[inline(always)]
    fn value<S: Simd>(self, simd: S, x: S::f32s) -> S::f32s {
        tanh(simd, x)
    }
    #[inline(always)]
    fn slope<S: Simd>(self, simd: S, _x: S::f32s, y: S::f32s) -> S::f32s {
        simd.sub_f32s(simd.splat_f32s(1.0), simd.mul_f32s(y, y))
    }
}

impl Activate for Relu {
    #[inline(always)]
    fn value<S: Simd>(self, simd: S, x: S::f32s) -> S::f32s {
        relu(simd, x)
    }
    #[inline(always)]
    fn slope<S: Simd>(self, simd: S, x: S::f32s, _y: S::f32s) -> S::f32s {
        let zero = simd.splat_f32s(0.0);
        simd.select_f32s(simd.greater_than_f32s(x, zero), simd.splat_f32s(1.0), zero)
    }
}

impl Activate for Elu {
    #[inline(always)]
    fn value<S: Simd>(self, simd: S, x: S::f32s) -> S::f32s {
        elu(simd, x)
    }
    #[inline(always)]
    fn slope<S: Simd>(self, simd: S, x: S::f32s, y: S::f32s) -> S::f32s {
        let one = simd.splat_f32s(1.0);
        let positive = simd.greater_than_f32s(x, simd.splat_f32s(0.0));
        simd.select_f32s(positive, one, simd.add_f32s(y, one))
    }
}

impl Activate for Activation {
    #[inline(always)]
    fn value<S: Simd>(self, simd: S, x: S::f32s) -> S::f32s {
        match self {
            Self::Sigmoid => Sigmoid.value(simd, x),
            Self::Tanh => Tanh.value(simd, x),
            Self::Relu => Relu.value(simd, x),
            Self::Elu => Elu.value(simd, x),
        }
    }
    #[inline(always)]
    fn slope<S: Simd>(self, simd: S, x: S::f32s, y: S::f32s) -> S::f32s {
        match self {
            Self::Sigmoid => Sigmoid.slope(simd, x, y),
            Self::Tanh => Tanh.slope(simd, x, y),
            Self::Relu => Relu.slope(simd, x, y),
            Self::Elu => Elu.slope(simd, x, y),
        }
    }
}

/// Applies an activation function in place.
pub fn activate(activation: Activation, values: &mut [f32]) {
    Arch::new().dispatch(InPlace { activation, values });
}

/// The gradient before an activation function, if there is one, from that after it and from the values after it.
pub fn gradient_before<'a>(
    activation: Option<Activation>,
    output: &[f32],
    gradient: &'a [f32],
) -> Cow<'a, [f32]> {
    match activation {
        None => Cow::Borrowed(gradient),
        Some(Activation::Relu) => {
            Cow::Owned(Arch::new().dispatch(ReluGradient { output, gradient }))
        }
        Some(activation) => {
            let mut slopes = gradient.to_vec();
            Arch::new().dispatch(Slopes { activation, output, gradient: &mut slopes });
            Cow::Owned(slopes)
        }
    }
}

struct InPlace<'a> {
    activation: Activation,
    values: &'a mut [f32],
}

impl WithSimd for InPlace<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        zip(
            simd,
            [],
            [self.values],
            #[inline(always)]
            |[], [x]| [self.activation.value(simd, x)],
        );
    }
}

/// Multiplies a gradient by the slopes.
struct Slopes<'a> {
    activation: Activation,
    output: &'a [f32],
    gradient: &'a mut [f32],
}

impl WithSimd for Slopes<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        zip(
            simd,
            [self.output],
            [self.gradient],
            // y has the sign of x where the slope depends on it.
            #[inline(always)]
            |[y], [by]| [simd.mul_f32s(by, self.activation.slope(simd, y, y))],
        );
    }
}

/// Computes the exponential in place.
pub struct Exponentials<'a>(pub &'a mut [f32]);

impl WithSimd for Exponentials<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        zip(
            simd,
            [],
            [self.0],
            #[inline(always)]
            |[], [x]| [exp(simd, x)],
        );
    }
}

struct ReluGradient<'a> {
    output: &'a [f32],
    gradient: &'a [f32],
}

impl WithSimd for ReluGradient<'_> {
    type Output = Vec<f32>;

    // Left to the compiler, which need not initialise the list.
    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> Vec<f32> {
        let pairs = self.gradient.iter().zip(self.output);
        pairs.map(|(by, &y)| if y > 0.0 { *by } else { 0.0 }).collect()
    }
}
