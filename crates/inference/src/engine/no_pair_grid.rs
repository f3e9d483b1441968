//! In place of `pair_grid`, for processors that have no products of pairs.

use super::grid::{Block, Fields};
use crate::checkpoint::{Weights, grid::GridLayer};

/// There are none.
#[derive(Debug)]
pub(super) enum PairGrid {}

impl PairGrid {
    pub(super) fn pack<'a>(
        _: usize,
        _: impl Iterator<Item = (&'a GridLayer, [&'a Weights; 2])>,
    ) -> Option<Self> {
        None
    }

    pub(super) fn round(&self, _: &[f32], _: &mut [u32]) {
        match *self {}
    }

    pub(super) fn layer(&self, _: usize, _: Block<'_>, _: &Fields<'_>) {
        match *self {}
    }
}
