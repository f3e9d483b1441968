//! The live page: truth beside prediction, and how far apart they are.
//!
//! 1. [`hub`]: where a node leaves copies of its frames while somebody looks; never makes it wait.
//! 2. [`comparison`]: pairs truth and prediction of the same instant, and measures them beside the trivial baselines;
//!    `curves`: errors lately. `explained`: predictions joined with what is said of them, where they come as messages.
//! 3. `composer`: one thread between the hub and the browsers: compares, encodes.
//! 4. [`wire`]: a shown frame as bytes.
//! 5. `mailbox`: what waits for one browser: the newest frame, and a few words.
//! 6. [`controls`]: what a page may ask for; who can do it decides what is offered.
//! 7. `words`: what is said in JSON: who is there, figures, curves.
//! 8. `gate`: who may connect: pages of this server, under an address of this machine.
//! 9. `server`: HTTP and WebSocket on a thread of their own.
//! 10. `page/`: what the browser gets, embedded in the program.

mod comparison;
mod composer;
mod controls;
mod curves;
mod explained;
mod gate;
mod hub;
mod mailbox;
mod server;
mod wire;
mod words;

pub use comparison::{Ahead, Comparison, Pair};
pub use controls::{Command, Controls, NoControls, State};
pub use curves::{Curves, Point, Summary};
pub use explained::Explained;
pub use hub::{Hub, Report};
pub use server::{Viewer, ViewerError};
pub use wire::{HEADER, Shown, VERSION, encode};
pub use words::Program;
