//! Peak arithmetic rate of the processor, for comparison with the solver.

use super::{
    level::{Level, Work},
    simd::{LANES, Simd},
};

/// Independent chains, enough to hide the latency of an instruction.
const CHAINS: usize = 12;

/// Multiplies and adds in the widest vectors of the solver, in registers only, and returns the number of operations. Products
/// and sums are separate instructions, as in the solver.
pub fn multiply_and_add(rounds: u64) -> u64 {
    std::hint::black_box(Level::widest().run(Chains { rounds }));
    rounds * (2 * CHAINS * LANES) as u64
}

/// Independent chains of `x <- x a + b`.
struct Chains {
    rounds: u64,
}

impl Work for Chains {
    type Output = f32;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> f32 {
        let (factor, term) =
            (simd.splat(std::hint::black_box(0.999)), simd.splat(std::hint::black_box(0.001)));
        let mut chains = [simd.splat(1.0); CHAINS];
        for _ in 0..self.rounds {
            for chain in &mut chains {
                *chain = *chain * factor + term;
            }
        }
        let mut sum = chains[0];
        for chain in &chains[1..] {
            sum = sum + *chain;
        }
        let mut lanes = [0.0; LANES];
        simd.store(sum, &mut lanes);
        lanes.iter().sum()
    }
}
