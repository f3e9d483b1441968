//! The live page: truth beside prediction, and the distance between them.
//!
//! 1. [`hub`]: copies of frames for the page while a browser is connected; never blocks the source.
//! 2. [`comparison`]: pairs truth and prediction of the same instant and measures their distance; [`baselines`]: the
//!    distances of the trivial baselines; [`curves`]: recent errors.
//! 3. [`joiner`]: predictions joined with their status messages.
//! 4. [`wire`]: a displayed frame as bytes. [`controls`]: commands of a page. [`protocol`]: the page's other messages, in
//!    JSON.
//! 5. `composer`: a thread that compares and encodes.
//! 6. `mailbox`: messages waiting for one browser.
//! 7. `access`: which requests are allowed. `token`: who may control the program. `connections`: how many there may be, and
//!    how long they may take. `server`: HTTP. `browser`: the WebSocket of one browser. `prometheus`: counters and rates for
//!    Prometheus.
//! 8. [`panel`]: the page of a node, a player or both. [`bag_view`]: the page of a bag that is played.
//! 9. `page/`: HTML, CSS and JavaScript, embedded in the program.

mod access;
mod bag_view;
mod baselines;
mod browser;
mod comparison;
mod composer;
mod connections;
mod controls;
mod curves;
mod hub;
mod joiner;
mod mailbox;
mod panel;
mod prometheus;
mod protocol;
mod server;
mod token;
mod wire;

pub use bag_view::BagView;
pub use comparison::{Comparison, Pair, PredictionInfo};
pub use controls::{ControlState, Controls, NoControls, PageCommand, ToolTarget};
pub use curves::{Curves, Point, Summary};
pub use hub::{Hub, NodeStatus};
pub use joiner::StatusJoiner;
pub use panel::{ControlPanel, LivePage};
pub use protocol::PageInfo;
pub use server::{Viewer, ViewerError};
pub use wire::{DisplayedFrame, HEADER, VERSION, encode};
