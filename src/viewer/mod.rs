//! The live page: truth beside prediction, and how far apart they are.
//!
//! 1. [`hub`]: where a node leaves copies of its frames while somebody looks; never makes it wait.
//! 2. [`comparison`]: pairs truth and prediction of the same instant, and measures them beside the trivial baselines.
//! 3. `composer`: one thread between the hub and the browsers: compares, encodes.
//! 4. [`wire`]: a shown frame as bytes.
//! 5. `mailbox`: what waits for one browser: the newest frame, and a few words.
//! 6. [`controls`]: what a page may ask for; who can do it decides what is offered.
//! 7. `words`: what is said in JSON: who is there, figures, curves.
//! 8. `gate`: who may connect: pages of this server, under an address of this machine.
//! 9. [`address`]: where it listens; `server`: HTTP and WebSocket on a thread of their own.
//! 10. `page/`: what the browser gets, embedded in the program.

mod address;
mod comparison;
mod composer;
mod controls;
mod gate;
mod hub;
mod mailbox;
mod server;
mod wire;
mod words;

pub use address::{InvalidAddress, ListenAddress};
pub use comparison::{Ahead, Comparison, Curves, Pair, Point, Summary};
pub use controls::{Command, Controls, NoControls, State};
pub use hub::{Hub, Report};
pub use server::{Viewer, ViewerError};
pub use wire::{HEADER, Shown, VERSION, encode};
pub use words::Program;
