//! eddy learns the motion of simulated particles and predicts it live.
//!
//! A surrogate node subscribes to particle-state frames, keeps the hidden state of a minimal
//! recurrent network (minGRU, minLSTM) for every stream, and publishes the predicted next frames
//! over shared memory, Zenoh or DDS. Ground truth comes from a Material-Point-Method solver, is recorded
//! as MCAP bags, and bags are what networks are trained and judged on.
//!
//! Layers, each using only lower ones (`tests/all/layers.rs` holds this table):
//!
//! | layer | modules |
//! |---|---|
//! | L8 | `cli`, `commands`, `fuzzing` |
//! | L7 | `study` |
//! | L6 | `bench`, `config`, `launch` |
//! | L5 | `node`, `train`, `viewer` |
//! | L4 | `eval`, `exchange` |
//! | L3 | `dataset`, `model`, `ros` |
//! | L2 | `bag`, `engine`, `page`, `transport` |
//! | L1 | `checkpoint`, `clock`, `kernels`, `mpm`, `msg`, `picture` |
//! | L0 | `frame`, `near`, `progress` |

pub mod bag;
pub mod bench;
pub mod checkpoint;
pub mod clock;
pub mod config;
pub mod dataset;
pub mod engine;
pub mod eval;
pub mod exchange;
pub mod frame;
#[doc(hidden)]
pub mod fuzzing;
pub mod kernels;
pub mod launch;
pub mod model;
pub mod mpm;
pub mod msg;
pub mod near;
pub mod node;
pub mod page;
pub mod picture;
pub mod progress;
pub mod ros;
pub mod study;
pub mod train;
pub mod transport;
pub mod viewer;
