//! Vectorised exponential, sigmoid, hyperbolic tangent, ELU, ReLU, and g of the log form.
//!
//! All but ReLU use one range reduction: e^x = 2^n e^r with n the integer nearest to x / ln 2, and
//! e^r = 1 + r + r^2 q(r) for |r| <= ln 2 / 2, where q has the coefficients of Cephes' `expf`
//! (Moshier 1992). e^x - 1 = 2^n (e^r - 1) + (2^n - 1) loses no precision near zero; ELU and tanh use it. NaN stays NaN.
//! Instruction sets with a fused multiply-add (AVX2, AVX-512, NEON) give the same bits in every lane; others round products.

use pulp::Simd;

/// log2(e).
const LOG2_E: f32 = std::f32::consts::LOG2_E;
/// The leading bits of ln 2, few enough for n times it to be exact.
const LN2_HIGH: f32 = 0.693_359_4;
/// ln 2 minus [`LN2_HIGH`].
const LN2_LOW: f32 = -2.121_944_4e-4;
/// 1.5 * 2^23: numbers of this size have no fraction; adding it rounds to an integer.
const ROUNDER: f32 = 12_582_912.0;
/// Coefficients of q, the highest power first.
const Q: [f32; 6] =
    [1.987_569_1e-4, 1.398_199_9e-3, 8.333_452e-3, 4.166_579_6e-2, 0.166_666_65, 0.5];
/// Bias of the exponent.
const EXPONENT_BIAS: u32 = 127;
/// Bits of the mantissa.
const MANTISSA_BITS: u32 = 23;

/// The x below which e^x is subnormal.
const MIN_EXPONENT: f32 = -87.336_54;

/// e^x. Relative error at most 1e-7; infinite from 88.7229 on, 0 below -87.3, since arithmetic on subnormal numbers is a
/// hundred times slower.
#[inline(always)]
pub fn exp<S: Simd>(simd: S, x: S::f32s) -> S::f32s {
    let vanishes = simd.less_than_f32s(x, simd.splat_f32s(MIN_EXPONENT));
    let (n, above_one) = reduce(simd, between(simd, x, MIN_EXPONENT, 89.0));
    let fraction = simd.add_f32s(simd.splat_f32s(1.0), above_one);
    // In two steps, as 2^n itself may not be a normal number.
    let shifted = simd.add_u32s(n, simd.splat_u32s(256));
    let half = simd.wrapping_dyn_shr_u32s(shifted, simd.splat_u32s(1));
    let half = simd.sub_u32s(half, simd.splat_u32s(128)); // n / 2, rounded down
    let rest = simd.sub_u32s(n, half);
    let power = simd.mul_f32s(fraction, power_of_two(simd, half));
    let power = simd.mul_f32s(power, power_of_two(simd, rest));
    simd.select_f32s(vanishes, simd.splat_f32s(0.0), power)
}

/// 1 / (1 + e^-x). Relative error at most 1.5e-7; 0 below -88.4.
#[inline(always)]
pub fn sigmoid<S: Simd>(simd: S, x: S::f32s) -> S::f32s {
    // At 88.8, 2^n is the bit pattern of infinity; at -88, that of zero.
    let negative = simd.sub_f32s(simd.splat_f32s(0.0), x);
    let negative = between(simd, negative, -88.0, 88.8);
    let (n, above_one) = reduce(simd, negative);
    let power = power_of_two(simd, n);
    let one = simd.splat_f32s(1.0);
    let exponential = simd.mul_f32s(simd.add_f32s(one, above_one), power);
    simd.div_f32s(one, simd.add_f32s(one, exponential))
}

/// Hyperbolic tangent, (e^2x - 1) / (e^2x + 1). Relative error at most 2e-7.
#[inline(always)]
pub fn tanh<S: Simd>(simd: S, x: S::f32s) -> S::f32s {
    // Beyond 10 it rounds to 1.
    let x = between(simd, x, -10.0, 10.0);
    let numerator = exp_minus_one(simd, simd.add_f32s(x, x));
    simd.div_f32s(numerator, simd.add_f32s(numerator, simd.splat_f32s(2.0)))
}

/// x for x > 0, e^x - 1 below (Clevert et al. 2015). Relative error at most 1e-7.
#[inline(always)]
pub fn elu<S: Simd>(simd: S, x: S::f32s) -> S::f32s {
    let positive = simd.greater_than_f32s(x, simd.splat_f32s(0.0));
    // Below -30 it rounds to -1.
    let below = exp_minus_one(simd, at_least(simd, x, -30.0));
    simd.select_f32s(positive, x, below)
}

/// max(0, x).
#[inline(always)]
pub fn relu<S: Simd>(simd: S, x: S::f32s) -> S::f32s {
    at_least(simd, x, 0.0)
}

/// g(x) = x + 1/2 for x > 0, sigmoid(x) below: positive and smooth, for the candidates of the log form
/// (Feng et al. 2024, appendix B).
#[inline(always)]
pub fn positive<S: Simd>(simd: S, x: S::f32s) -> S::f32s {
    let above = simd.greater_than_f32s(x, simd.splat_f32s(0.0));
    simd.select_f32s(above, simd.add_f32s(x, simd.splat_f32s(0.5)), sigmoid(simd, x))
}

/// e^x - 1 for -30 <= x <= 88; an arbitrary number outside this range.
#[inline(always)]
fn exp_minus_one<S: Simd>(simd: S, x: S::f32s) -> S::f32s {
    let (n, above_one) = reduce(simd, x);
    let power = power_of_two(simd, n);
    simd.mul_add_e_f32s(power, above_one, simd.sub_f32s(power, simd.splat_f32s(1.0)))
}

/// n and e^r - 1 with x = n ln 2 + r, |r| <= ln 2 / 2. n is in two's complement.
#[inline(always)]
fn reduce<S: Simd>(simd: S, x: S::f32s) -> (S::u32s, S::f32s) {
    let rounder = simd.splat_f32s(ROUNDER);
    let shifted = simd.mul_add_e_f32s(x, simd.splat_f32s(LOG2_E), rounder);
    let whole = simd.sub_f32s(shifted, rounder);
    let n = simd.sub_u32s(simd.transmute_u32s_f32s(shifted), simd.splat_u32s(ROUNDER.to_bits()));
    let r = simd.mul_add_e_f32s(whole, simd.splat_f32s(-LN2_HIGH), x);
    let r = simd.mul_add_e_f32s(whole, simd.splat_f32s(-LN2_LOW), r);
    let mut q = simd.splat_f32s(Q[0]);
    for coefficient in &Q[1..] {
        q = simd.mul_add_e_f32s(q, r, simd.splat_f32s(*coefficient));
    }
    (n, simd.mul_add_e_f32s(simd.mul_f32s(r, r), q, r))
}

/// 2^n for -126 <= n <= 127; 0 for -127, infinity for 128.
#[inline(always)]
fn power_of_two<S: Simd>(simd: S, n: S::u32s) -> S::f32s {
    let exponent = simd.add_u32s(n, simd.splat_u32s(EXPONENT_BIAS));
    let bits = simd.wrapping_dyn_shl_u32s(exponent, simd.splat_u32s(MANTISSA_BITS));
    simd.transmute_f32s_u32s(bits)
}

/// x, but at least `least`. Comparisons treat NaN the same on all instruction sets, minima and maxima do not.
#[inline(always)]
fn at_least<S: Simd>(simd: S, x: S::f32s, least: f32) -> S::f32s {
    let least = simd.splat_f32s(least);
    simd.select_f32s(simd.less_than_f32s(x, least), least, x)
}

/// x clamped to `least`..`most`.
#[inline(always)]
fn between<S: Simd>(simd: S, x: S::f32s, least: f32, most: f32) -> S::f32s {
    let x = at_least(simd, x, least);
    let most = simd.splat_f32s(most);
    simd.select_f32s(simd.greater_than_f32s(x, most), most, x)
}

#[cfg(test)]
mod tests {
    use pulp::{Arch, Simd, WithSimd};

    use super::*;

    #[derive(Clone, Copy, Debug)]
    enum Function {
        Exp,
        Sigmoid,
        Tanh,
        Elu,
        Relu,
    }

    impl Function {
        fn exactly(self, x: f64) -> f64 {
            match self {
                Self::Exp => x.exp(),
                Self::Sigmoid => 1.0 / (1.0 + (-x).exp()),
                Self::Tanh => x.tanh(),
                Self::Elu => x.max(x.min(0.0).exp_m1()),
                Self::Relu => x.max(0.0),
            }
        }
    }

    /// Applies a function to numbers; the last vector is padded with zeros.
    struct Apply<'a>(Function, &'a [f32]);

    impl WithSimd for Apply<'_> {
        type Output = Vec<f32>;

        #[inline(always)]
        fn with_simd<S: Simd>(self, simd: S) -> Vec<f32> {
            let Self(function, numbers) = self;
            let mut results = vec![0.0; numbers.len()];
            for (x, y) in numbers.chunks(S::F32_LANES).zip(results.chunks_mut(S::F32_LANES)) {
                let x = simd.partial_load_f32s(x);
                let result = match function {
                    Function::Exp => exp(simd, x),
                    Function::Sigmoid => sigmoid(simd, x),
                    Function::Tanh => tanh(simd, x),
                    Function::Elu => elu(simd, x),
                    Function::Relu => relu(simd, x),
                };
                simd.partial_store_f32s(y, result);
            }
            results
        }
    }

    /// The instruction sets of this processor; those with a fused multiply-add last.
    fn sets() -> Vec<Arch> {
        let mut sets = vec![Arch::Scalar];
        #[cfg(target_arch = "x86_64")]
        {
            sets.extend(pulp::x86::V3::try_new().map(Arch::V3));
            sets.extend(pulp::x86::V4::try_new().map(Arch::V4));
        }
        #[cfg(not(target_arch = "x86_64"))]
        sets.push(Arch::new());
        sets
    }

    /// Numbers of all magnitudes from 1e-30 to 1e3, of both signs, and from -105 to 90 in small steps.
    fn numbers() -> Vec<f32> {
        let sizes = (-300..30).map(|tenth| 10f32.powf(tenth as f32 / 10.0));
        let signed = sizes.flat_map(|size| [size, -size]);
        signed.chain((0..390_000).map(|step| -105.0 + step as f32 * 5.001e-4)).collect()
    }

    /// The largest relative error and its argument. Subnormal results may be zero.
    fn largest_error(function: Function, set: Arch) -> (f64, f32) {
        let numbers = numbers();
        let results = set.dispatch(Apply(function, &numbers));
        let errors = numbers.iter().zip(results).map(|(&x, found)| {
            let (exact, found) = (function.exactly(f64::from(x)), f64::from(found));
            let difference = (found - exact).abs();
            if exact > f64::from(f32::MAX) {
                (if found.is_infinite() { 0.0 } else { f64::INFINITY }, x)
            } else if exact.abs() < f64::from(f32::MIN_POSITIVE) {
                (if difference <= exact.abs() { 0.0 } else { f64::INFINITY }, x)
            } else {
                (difference / exact.abs(), x)
            }
        });
        errors.fold((0.0, 0.0), |worst, error| if error.0 > worst.0 { error } else { worst })
    }

    #[test]
    fn every_function_is_accurate_to_a_few_units_in_the_last_place() {
        let bounds = [
            (Function::Exp, 1e-7),
            (Function::Sigmoid, 1.5e-7),
            (Function::Tanh, 2e-7),
            (Function::Elu, 1e-7),
            (Function::Relu, 0.0),
        ];
        for (function, bound) in bounds {
            for set in sets() {
                let (error, x) = largest_error(function, set);
                println!("{function:?}: {error:e} at {x}");
                assert!(error <= bound, "{function:?} {set:?}: {error:e} at {x}");
            }
        }
    }

    #[test]
    fn limits_are_exact_and_nan_stays() {
        let far = [f32::INFINITY, f32::NEG_INFINITY, 200.0, -200.0, 0.0, f32::NAN];
        let cases = [
            (Function::Exp, [f32::INFINITY, 0.0, f32::INFINITY, 0.0, 1.0]),
            (Function::Sigmoid, [1.0, 0.0, 1.0, 0.0, 0.5]),
            (Function::Tanh, [1.0, -1.0, 1.0, -1.0, 0.0]),
            (Function::Elu, [f32::INFINITY, -1.0, 200.0, -1.0, 0.0]),
            (Function::Relu, [f32::INFINITY, 0.0, 200.0, 0.0, 0.0]),
        ];
        for (function, expected) in cases {
            for set in sets() {
                let found = set.dispatch(Apply(function, &far));
                assert_eq!(found[..5], expected, "{function:?} {set:?}");
                assert!(found[5].is_nan(), "{function:?} {set:?}");
            }
        }
    }

    #[test]
    fn instruction_sets_with_a_fused_multiply_add_give_the_same_bits() {
        let numbers = numbers();
        for function in [Function::Exp, Function::Sigmoid, Function::Tanh, Function::Elu] {
            let bits = |set: &Arch| -> Vec<u32> {
                set.dispatch(Apply(function, &numbers)).iter().map(|y| y.to_bits()).collect()
            };
            let all: Vec<_> = sets()[1..].iter().map(bits).collect();
            assert!(all.windows(2).all(|pair| pair[0] == pair[1]), "{function:?}");
        }
    }
}
