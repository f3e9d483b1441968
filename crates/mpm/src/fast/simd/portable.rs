//! Plain arrays, for every processor.

use std::{
    array,
    ops::{Add, BitAnd, BitOr, Div, Mul, Sub},
};

use super::{super::level::Work, LANES, Lanes, Simd, Vectors};

/// The baseline instructions of the architecture.
#[derive(Clone, Copy, Debug)]
pub(in super::super) struct Portable;

/// An array of numbers.
#[derive(Clone, Copy, Debug)]
pub(in super::super) struct Numbers<const N: usize>([f32; N]);

/// An array of booleans.
#[derive(Clone, Copy, Debug)]
pub(in super::super) struct Booleans([bool; LANES]);

macro_rules! operator {
    ($trait:ident, $name:ident, $operator:tt) => {
        impl<const N: usize> $trait for Numbers<N> {
            type Output = Self;
            #[inline(always)]
            fn $name(self, other: Self) -> Self {
                Self(array::from_fn(|k| self.0[k] $operator other.0[k]))
            }
        }
    };
}
operator!(Add, add, +);
operator!(Sub, sub, -);
operator!(Mul, mul, *);
operator!(Div, div, /);

impl BitAnd for Booleans {
    type Output = Self;
    #[inline(always)]
    fn bitand(self, other: Self) -> Self {
        Self(array::from_fn(|k| self.0[k] & other.0[k]))
    }
}

impl BitOr for Booleans {
    type Output = Self;
    #[inline(always)]
    fn bitor(self, other: Self) -> Self {
        Self(array::from_fn(|k| self.0[k] | other.0[k]))
    }
}

impl Simd for Portable {
    type Lanes = Numbers<LANES>;
    type Mask = Booleans;
    type Pairs = Numbers<8>;
    type Ones = Numbers<4>;

    #[inline(never)]
    fn run<W: Work>(self, work: W) -> W::Output {
        work.run(self)
    }
    #[inline(always)]
    fn splat(self, number: f32) -> Self::Lanes {
        Numbers([number; LANES])
    }
    #[inline(always)]
    fn load(self, lanes: &Lanes) -> Self::Lanes {
        Numbers(*lanes)
    }
    #[inline(always)]
    fn store(self, value: Self::Lanes, lanes: &mut Lanes) {
        *lanes = value.0;
    }
    #[inline(always)]
    fn load_vectors(self, vectors: &Vectors) -> [Self::Lanes; 2] {
        [0, 1].map(|axis| Numbers(array::from_fn(|k| vectors[k][axis])))
    }
    #[inline(always)]
    fn store_vectors(self, [x, y]: [Self::Lanes; 2], vectors: &mut Vectors) {
        *vectors = array::from_fn(|k| [x.0[k], y.0[k]]);
    }
    #[inline(always)]
    fn sqrt(self, value: Self::Lanes) -> Self::Lanes {
        Numbers(array::from_fn(|k| value.0[k].sqrt()))
    }
    #[inline(always)]
    fn less(self, a: Self::Lanes, b: Self::Lanes) -> Self::Mask {
        Booleans(array::from_fn(|k| a.0[k] < b.0[k]))
    }
    #[inline(always)]
    fn at_least(self, a: Self::Lanes, b: Self::Lanes) -> Self::Mask {
        Booleans(array::from_fn(|k| a.0[k] >= b.0[k]))
    }
    #[inline(always)]
    fn equal(self, a: Self::Lanes, b: Self::Lanes) -> Self::Mask {
        Booleans(array::from_fn(|k| a.0[k] == b.0[k]))
    }
    #[inline(always)]
    fn select(self, mask: Self::Mask, a: Self::Lanes, b: Self::Lanes) -> Self::Lanes {
        Numbers(array::from_fn(|k| if mask.0[k] { a.0[k] } else { b.0[k] }))
    }
    #[inline(always)]
    fn bits(self, mask: Self::Mask) -> u16 {
        mask.0.iter().enumerate().fold(0, |bits, (lane, &is_set)| bits | u16::from(is_set) << lane)
    }
    #[inline(always)]
    fn truncate(self, value: Self::Lanes) -> (Self::Lanes, [i32; LANES]) {
        let integers = array::from_fn(|k| value.0[k] as i32);
        (Numbers(array::from_fn(|k| integers[k] as f32)), integers)
    }

    #[inline(always)]
    fn splat_pairs(self, number: f32) -> Self::Pairs {
        Numbers([number; 8])
    }
    #[inline(always)]
    fn repeat(self, &[x, y]: &[f32; 2]) -> Self::Pairs {
        Numbers([x, y, x, y, x, y, x, y])
    }
    #[inline(always)]
    fn load_pairs(self, pairs: &[[f32; 2]; 4]) -> Self::Pairs {
        Numbers(array::from_fn(|k| pairs[k / 2][k % 2]))
    }
    #[inline(always)]
    fn store_pairs(self, value: Self::Pairs, pairs: &mut [[f32; 2]; 4]) {
        *pairs = array::from_fn(|j| [value.0[2 * j], value.0[2 * j + 1]]);
    }
    #[inline(always)]
    fn min_pairs(self, a: Self::Pairs, b: Self::Pairs) -> Self::Pairs {
        Numbers(array::from_fn(|k| if a.0[k] < b.0[k] { a.0[k] } else { b.0[k] }))
    }
    #[inline(always)]
    fn max_pairs(self, a: Self::Pairs, b: Self::Pairs) -> Self::Pairs {
        Numbers(array::from_fn(|k| if a.0[k] > b.0[k] { a.0[k] } else { b.0[k] }))
    }
    #[inline(always)]
    fn sums(self, [a, b, c]: [Self::Pairs; 3]) -> [[f32; 2]; 3] {
        let sum = |Numbers(r): Self::Pairs| {
            [(r[0] + r[4]) + (r[2] + r[6]), (r[1] + r[5]) + (r[3] + r[7])]
        };
        [sum(a), sum(b), sum(c)]
    }

    #[inline(always)]
    fn sum_ones(self, Numbers(ones): Self::Ones) -> f32 {
        (ones[0] + ones[2]) + (ones[1] + ones[3])
    }
    #[inline(always)]
    fn twice(self, ones: Self::Ones) -> Self::Pairs {
        Numbers(array::from_fn(|k| ones.0[k / 2]))
    }
    #[inline(always)]
    fn splat_ones(self, number: f32) -> Self::Ones {
        Numbers([number; 4])
    }
    #[inline(always)]
    fn load_ones(self, ones: &[f32; 4]) -> Self::Ones {
        Numbers(*ones)
    }
    #[inline(always)]
    fn store_ones(self, value: Self::Ones, ones: &mut [f32; 4]) {
        *ones = value.0;
    }
}
