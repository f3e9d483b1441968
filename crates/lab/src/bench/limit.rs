//! Roofline estimate for the solver on this machine, from peak arithmetic rate and memory bandwidth, and the read rate of
//! memory, which limits streaming networks.

use std::{hint::black_box, thread};

use pulp::{Arch, Simd, WithSimd};
use serde::Serialize;

use eddy_frames::clock::Clock;

/// Operations per particle and substep, counted in `mpm::fast` for an elastic particle: gather from nine nodes 128,
/// deformation and stress 65, scatter to nine nodes 130, stencils and positions 45. Divisions and square roots count as
/// one.
const OPERATIONS: f64 = 368.0;

/// Bytes read and written per particle and substep: position, velocity, C, F, Jp.
const BYTES: f64 = 2.0 * 52.0;

/// Timed rounds of arithmetic, about 20 ms.
const ROUNDS: u64 = 2_000_000;
/// Independent chains, enough to hide the latency of an instruction.
const CHAINS: usize = 12;
/// Numbers per thread for the memory bandwidth: far more than caches hold.
const NUMBERS: usize = 1 << 24;
/// Bytes read per thread for the read rate, about 50 ms.
const PASSED: usize = 1 << 29;
/// Repetitions, of which the best counts.
const TRIES: usize = 5;

/// Peak rates of this machine.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Limit {
    /// Number of threads.
    pub threads: usize,
    /// Additions and multiplications in vectors (1/s).
    pub operations: f64,
    /// Memory bandwidth, reading and writing (bytes/s).
    pub bytes: f64,
}

impl Limit {
    /// Measures the peak rates on a number of threads, in some tenths of a second.
    pub fn measure(threads: usize) -> Self {
        let operations = best(threads, || Arch::new().dispatch(Chains { rounds: ROUNDS }));
        let mut memory: Vec<Vec<f32>> = vec![vec![1.0; NUMBERS]; threads];
        let moved = (2 * size_of::<f32>() * NUMBERS) as f64;
        let bytes = best_of(&mut memory, |numbers| {
            for number in numbers.iter_mut() {
                *number += 1.0;
            }
            black_box(numbers);
            moved
        });
        Self { threads, operations, bytes }
    }

    /// Minimum time per particle and substep (s). `in_memory`: the particles exceed the caches.
    pub fn per_particle(&self, in_memory: bool) -> f64 {
        let arithmetic = OPERATIONS / self.operations;
        if in_memory { arithmetic.max(BYTES / self.bytes) } else { arithmetic }
    }
}

/// Independent chains of `x <- x a + b` in registers. Products and sums are separate instructions, as in the solver.
struct Chains {
    rounds: u64,
}

impl WithSimd for Chains {
    /// Number of operations.
    type Output = f64;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> f64 {
        let [factor, term] = [0.999, 0.001].map(|x| simd.splat_f32s(black_box(x)));
        let mut chains = [simd.splat_f32s(1.0); CHAINS];
        for _ in 0..self.rounds {
            for chain in &mut chains {
                *chain = simd.add_f32s(simd.mul_f32s(*chain, factor), term);
            }
        }
        black_box(chains.into_iter().map(|chain| simd.reduce_sum_f32s(chain)).sum::<f32>());
        self.rounds as f64 * (2 * CHAINS * S::F32_LANES) as f64
    }
}

/// Rate at which `threads` threads together read a list of `bytes` bytes repeatedly (bytes/s).
pub fn read_rate(threads: usize, bytes: usize) -> f64 {
    let length = (bytes / size_of::<u32>() / threads).max(1);
    let mut lists: Vec<Vec<u32>> = (0..threads).map(|_| vec![1; length]).collect();
    let rounds = (PASSED / (length * size_of::<u32>())).max(1);
    best_of(&mut lists, |list| {
        for _ in 0..rounds {
            let sum = Arch::new().dispatch(
                #[inline(always)]
                || black_box(&*list).iter().fold(0u32, |sum, &number| sum.wrapping_add(number)),
            );
            black_box(sum);
        }
        (rounds * length * size_of::<u32>()) as f64
    })
}

/// The best rate of `work` on `threads` threads; `work` returns the amount of work done.
fn best(threads: usize, work: impl Fn() -> f64 + Sync) -> f64 {
    best_of(&mut vec![(); threads], |()| work())
}

/// The best rate of `work` on all items, each on its own thread.
fn best_of<T: Send>(items: &mut [T], work: impl Fn(&mut T) -> f64 + Sync) -> f64 {
    (0..TRIES)
        .map(|_| {
            let clock = Clock::start();
            let done: f64 = thread::scope(|scope| {
                let work = &work;
                let threads: Vec<_> =
                    items.iter_mut().map(|item| scope.spawn(move || work(item))).collect();
                threads.into_iter().filter_map(|thread| thread.join().ok()).sum()
            });
            done / clock.now().as_secs_f64()
        })
        .fold(0.0, f64::max)
}
