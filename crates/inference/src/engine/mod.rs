//! The networks of `model`, for streaming: one frame of a stream at a time.
//!
//! 1. `linear`: weights packed in the order they are read, and their products with rows of numbers;
//!    `products`: a layer for rows from one place, its sums to another.
//! 2. `encoder`: the frame model's pointwise encoder with its pooling, fused.
//! 3. `core`: the layers of the five cores.
//! 4. `crew`: threads that stay and share the items of a frame's stages.
//! 5. `frame_model`: the paper's network (Table 1) out of these.
//! 6. `particle_model`: one hidden state a particle, the stages of a frame. `particle_features` and
//!    `particle_blocks` have what happens to particles, `pieces` what they write to the grid's nodes,
//!    `surroundings` what happens to these.
//! 7. `rules`: what corrects a prediction, with the constants of the checkpoint; [`Corrector`] does it after any
//!    predictor.
//! 8. `memory`: what a network remembers of a stream, and in which `order`.
//! 9. [`Remark`]: what is predicted although the network was not made for it.
//! 10. [`Ballistic`]: the step of a particle that nothing else touches; [`scales`]: units of the particle
//!     model's inputs and outputs.
//! 11. `surrogate`: a checkpoint that predicts frames, one after the other; `workshop`: all threads on one
//!     stream, or each on its own.
//!
//! Vector instructions are chosen while the program runs (crate `pulp`). After a stream's first frame
//! nothing is allocated (`tests/allocation.rs` counts). The equations stand in `model`, whose networks
//! and the same rules behind them give the same numbers within 1e-5 (a property test there holds the two together).
//!
//! Letters in shapes are those of `model`.

mod ballistic;
mod core;
mod crew;
mod encoder;
mod error;
mod frame_model;
mod linear;
mod memory;
mod order;
mod particle_blocks;
mod particle_features;
mod particle_model;
mod pieces;
mod products;
mod remark;
mod rules;
pub mod scales;
mod surrogate;
mod surroundings;
mod workshop;

#[cfg(test)]
mod tests;

pub use ballistic::Ballistic;
pub use error::ModelError;
pub use memory::Memory;
pub use remark::Remark;
pub use rules::Corrector;
pub use surrogate::Surrogate;
pub use workshop::Stepper;
