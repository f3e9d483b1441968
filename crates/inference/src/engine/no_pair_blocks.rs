//! In place of `pair_blocks`, for processors that have no products of pairs.

use std::collections::BTreeMap;

use super::{core::CoreLayer, particle_blocks::GatheredBlock};
use crate::checkpoint::{Description, Weights};

/// There are none.
#[derive(Debug)]
pub(super) enum PairBlocks {}

/// No buffers.
#[derive(Debug, Default)]
pub(super) struct PairBuffer;

impl PairBlocks {
    pub(super) fn pack(_: usize, _: &Description, _: &BTreeMap<String, Weights>) -> Option<Self> {
        None
    }

    pub(super) fn buffer(&self, _: usize) -> PairBuffer {
        match *self {}
    }

    pub(super) fn decode(
        &self,
        _: &[CoreLayer],
        _: &GatheredBlock<'_>,
        _: &mut PairBuffer,
        _: (&mut [f32], usize),
    ) {
        match *self {}
    }
}
