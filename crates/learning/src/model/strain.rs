//! Strain and bend of solids relative to their rest shape: [`RestShape::shape_of`] over tensors.

use burn::tensor::{IndexingUpdateOp, Tensor, TensorData};

use super::sparse::indices;
use eddy_inference::kernels::rest_shape::{LIMIT, Link, RestShape, SCALE};

/// The shape features, `[T R, 5]`, of R particles with the rest shape `rest` at `position` over T frames, `[T R, 2]`.
pub(crate) fn shape(position: &Tensor<2>, rest: &RestShape) -> Tensor<2> {
    let [count, _] = position.dims();
    let frames = count / rest.len().max(1);
    let links = (0..frames).flat_map(|frame| {
        let rows = (0..rest.len()).flat_map(|row| rest.links(row).iter().map(move |l| (row, *l)));
        let first = frame * rest.len();
        rows.map(move |(row, link)| (first + row, first + link.particle as usize, link))
    });
    let links: Vec<(usize, usize, Link)> = links.collect();
    let device = position.device();
    let row = |pick: fn(&(usize, usize, Link)) -> usize| {
        indices(links.iter().map(|link| pick(link) as u32), &device)
    };
    let number = |pick: fn(&Link) -> f32| {
        let values: Vec<f32> = links.iter().map(|(.., link)| pick(link)).collect();
        Tensor::<2>::from_data(TensorData::new(values, [links.len(), 1]), &device)
    };
    let (own, other) = (row(|link| link.0), row(|link| link.1));
    let apart = position.clone().select(0, other) - position.clone().select(0, own.clone()); // [L, 2]
    let sum = |coefficient: Tensor<2>| {
        let zeros = Tensor::zeros([count, 2], &device);
        zeros.select_assign(0, own.clone(), apart.clone() * coefficient, IndexingUpdateOp::Add)
    };
    let first = sum(number(|link| link.coefficient[0])); // F_xx, F_yx
    let second = sum(number(|link| link.coefficient[1])); // F_xy, F_yy
    let bend = sum(number(|link| link.share));
    let squares = first.clone().square() + second.clone().square(); // B_xx, B_yy
    let across = |f: Tensor<2>| f.clone().slice([0..count, 0..1]) * f.slice([0..count, 1..2]);
    let product = across(first) + across(second); // B_xy
    let solid: Vec<f32> = (0..count)
        .map(|row| if rest.links(row % rest.len()).is_empty() { 0.0 } else { 1.0 })
        .collect();
    let solid = Tensor::<2>::from_data(TensorData::new(solid, [count, 1]), &device);
    let scale = Tensor::<1>::from_floats(SCALE, &device).unsqueeze::<2>();
    let shape = Tensor::cat(vec![squares - solid, product, bend], 1);
    (shape * scale).clamp(-LIMIT, LIMIT)
}
