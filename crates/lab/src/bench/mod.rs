//! Tables of what this machine carries.
//!
//! 1. [`solver`]: time of a substep by particles and threads.
//! 2. [`training`]: time of a training step by core and length of the window.
//! 3. [`inference`]: time of a predicted frame by core, on the engine and in burn.
//! 4. [`bag`]: rates of bags that are written and read, losses of a live recording.
//! 5. [`transport`]: how long a frame is on its way.
//! 6. [`node`]: what a node adds to its model's time, how many streams it carries.
//! 7. [`replay`]: how late a player's messages are.
//! 8. [`view`]: what the live page costs who is looked at.
//! 9. [`limit`]: what the processor and its memory would allow.

pub mod bag;
pub mod inference;
pub mod limit;
pub mod node;
mod particles;
pub mod replay;
pub mod solver;
mod spread;
pub mod training;
pub mod transport;
pub mod view;

pub use spread::Spread;
