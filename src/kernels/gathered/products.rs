//! Gathered rows times a matrix, and the matrix's gradient.
//!
//! Rows are worked on in chunks whose gathered numbers stay in the nearest caches. Each chunk is one
//! thread's, and sums over chunks are in their order: the same bits for any number of threads.

use rayon::prelude::*;

use crate::kernels::{
    matrix::{Into, Matrix, multiply_alone, sum_rows},
    nodes::MISSING,
};

/// Rows of a chunk.
const CHUNK: usize = 128;

/// Chunks whose gradients by the matrix are one part of the sum.
const CHUNKS: usize = 8;

/// Adds to `sums`, `[M, O]`, the rows that `table` gathers from `input`, `[.., I]`, times the matrix,
/// `[K I, O]`. What is negative becomes zero if `rectify`.
pub(super) fn add_products<const K: usize>(
    table: &[[u32; K]],
    input: &[f32],
    matrix: Matrix,
    sums: &mut [f32],
    rectify: bool,
) {
    let [rows, outputs] = matrix.shape();
    let inputs = rows / K;
    let chunks = table.par_chunks(CHUNK).zip(sums.par_chunks_mut(CHUNK * outputs));
    chunks.for_each_init(Vec::new, |gathered, (table, sums)| {
        gather(table, input, inputs, gathered);
        let gathered = Matrix::new(gathered, table.len(), rows);
        multiply_alone(gathered, matrix, sums, Into::Add);
        if rectify {
            for sum in sums {
                *sum = sum.max(0.0);
            }
        }
    });
}

/// The gradient `[K I, O]` by the matrix, from the input, `[.., I]`, and the sums' gradient, `[M, O]`.
pub(super) fn by_matrix<const K: usize>(
    table: &[[u32; K]],
    input: &[f32],
    inputs: usize,
    gradient: &[f32],
    outputs: usize,
) -> Vec<f32> {
    let rows = K * inputs;
    let size = rows * outputs;
    let mut parts = vec![0.0; table.len().div_ceil(CHUNKS * CHUNK) * size];
    parts
        .par_chunks_exact_mut(size)
        .zip(table.par_chunks(CHUNKS * CHUNK))
        .zip(gradient.par_chunks(CHUNKS * CHUNK * outputs))
        .for_each_init(Vec::new, |gathered, ((part, table), gradient)| {
            let chunks = table.chunks(CHUNK).zip(gradient.chunks(CHUNK * outputs));
            for (table, gradient) in chunks {
                gather(table, input, inputs, gathered);
                let gathered = Matrix::new(gathered, table.len(), rows).transposed();
                let gradient = Matrix::new(gradient, table.len(), outputs);
                multiply_alone(gathered, gradient, part, Into::Add);
            }
        });
    let mut sums = vec![0.0; size];
    sum_rows(&parts, &mut sums);
    sums
}

/// Adds to `sums`, `[M, O]`, each row's share of its parent's: row `parent[m]` of the products, in rows
/// of O, of `input`, `[P, I]`, and the matrix, `[I, 4 O]`.
pub(super) fn shares(parent: &[u32], input: &[f32], matrix: Matrix, sums: &mut [f32]) {
    let [inputs, outputs] = matrix.shape();
    let rows = input.len() / inputs;
    let mut products = vec![0.0; rows * outputs];
    let chunks = input.par_chunks(CHUNK * inputs).zip(products.par_chunks_mut(CHUNK * outputs));
    chunks.for_each(|(input, products)| {
        let input = Matrix::new(input, input.len() / inputs, inputs);
        multiply_alone(input, matrix, products, Into::Replace);
    });
    let width = outputs / 4;
    for (sums, &place) in sums.chunks_exact_mut(width).zip(parent) {
        let share = &products[place as usize * width..][..width];
        for (sum, share) in sums.iter_mut().zip(share) {
            *sum += share;
        }
    }
}

/// Fills `gathered`, `[M, K I]`, with rows of `input`; zeros where there is none.
fn gather<const K: usize>(
    table: &[[u32; K]],
    input: &[f32],
    inputs: usize,
    gathered: &mut Vec<f32>,
) {
    gathered.clear();
    for &row in table.as_flattened() {
        if row == MISSING {
            gathered.resize(gathered.len() + inputs, 0.0);
        } else {
            gathered.extend_from_slice(&input[row as usize * inputs..][..inputs]);
        }
    }
}
