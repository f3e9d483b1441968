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

/// ReLU, in place.
pub fn relu_in_place(values: &mut [f32]) {
    Arch::new().dispatch(Rectify(values));
}

/// The gradient before a layer's ReLU from the gradient after it: zero where the output is not positive. Unchanged if the
/// layer is not `rectified`.
pub fn relu_gradient<'a>(rectified: bool, output: &[f32], gradient: &'a [f32]) -> Cow<'a, [f32]> {
    if !rectified {
        return Cow::Borrowed(gradient);
    }
    Cow::Owned(Arch::new().dispatch(ReluGradient { output, gradient }))
}

struct Rectify<'a>(&'a mut [f32]);

impl WithSimd for Rectify<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        zip(
            simd,
            [],
            [self.0],
            #[inline(always)]
            |[], [x]| [relu(simd, x)],
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
