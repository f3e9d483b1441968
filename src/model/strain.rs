//! The shape of solids, strain and bend, against the one they rest in: [`Rest::shape`] over tensors.

use std::sync::Arc;

use burn::tensor::{Tensor, TensorData};

use super::{fused, pairs, training};
use crate::kernels::rest::{Rest, SHAPE_FEATURES};

/// Of particles at `position`, `[T R, 2]`, R of them at rest in `rest`, over T frames: `[T R, 5]`.
///
/// Without a record of gradients this is the kernel as well; no gradient passes on other devices than
/// flex.
pub(crate) fn shape(position: &Tensor<2>, rest: &Arc<Rest>) -> Tensor<2> {
    if fused::runs_on(&position.device()) {
        return training::shape(rest.clone(), position.clone());
    }
    let [rows, _] = position.dims();
    let shape = rest.shape(&pairs(position.clone()));
    Tensor::from_data(TensorData::new(shape, [rows, SHAPE_FEATURES]), &position.device())
}
