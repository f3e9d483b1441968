//! Products by cuBLASLt, each with the first algorithm that it suggests: the same on the same GPU and library.

#![expect(unsafe_code, reason = "calls of the driver and its libraries")]

use std::{collections::HashMap, ffi::c_void, sync::Mutex};

use cudarc::{
    cublaslt::{result as lt, sys},
    driver::{CudaSlice, CudaStream, DevicePtr as _},
};

use super::{Memory, Precision, Recordings};
use crate::{
    device::{Factor, Product},
    error::{Context as _, CudaError, Result},
};

/// Memory that an algorithm may use beside its factors (bytes).
const WORKSPACE: usize = 32 << 20;

/// What decides about an algorithm: sizes, strides, transpositions, whether the result is added, alignment.
type Key = [usize; 10];

/// A product's description and its algorithm.
#[derive(Clone, Copy)]
struct Plan {
    operation: sys::cublasLtMatmulDesc_t,
    left: sys::cublasLtMatrixLayout_t,
    right: sys::cublasLtMatrixLayout_t,
    result: sys::cublasLtMatrixLayout_t,
    algorithm: sys::cublasLtMatmulAlgo_t,
}

/// What all addresses of a product are multiples of (bytes): a power of two, at most 256.
fn alignment(product: &Product) -> u32 {
    let addresses =
        product.left.at.address() | product.right.at.address() | product.result.address();
    1 << addresses.trailing_zeros().min(8)
}

/// cuBLASLt with workspaces for two streams.
pub(super) struct Products {
    handle: sys::cublasLtHandle_t,
    precision: Precision,
    /// One for each stream.
    workspaces: [u64; 2],
    _memory: [Memory; 2],
    recordings: Recordings,
    plans: Mutex<HashMap<Key, Plan>>,
}

// SAFETY: the library's handles may be used from any thread.
unsafe impl Send for Products {}
// SAFETY: likewise; plans are behind a lock.
unsafe impl Sync for Products {}

impl Drop for Products {
    fn drop(&mut self) {
        let _guard = self.recordings.wait();
        let plans = self.plans.get_mut().unwrap_or_else(|broken| broken.into_inner());
        for plan in plans.values() {
            // SAFETY: nothing of this handle is used after this. A failure here has no remedy.
            unsafe {
                let _ = lt::destroy_matmul_desc(plan.operation);
                for layout in [plan.left, plan.right, plan.result] {
                    let _ = lt::destroy_matrix_layout(layout);
                }
            }
        }
        // SAFETY: as above.
        let _ = unsafe { lt::destroy_handle(self.handle) };
    }
}

impl Products {
    pub(super) fn new(
        stream: &std::sync::Arc<CudaStream>,
        precision: Precision,
        recordings: &Recordings,
    ) -> Result<Self> {
        let _guard = recordings.wait();
        let memory = || stream.alloc_zeros(WORKSPACE).context("cuMemAlloc");
        let memory: [CudaSlice<u8>; 2] = [memory()?, memory()?];
        Ok(Self {
            handle: lt::create_handle().context("cublasLtCreate")?,
            precision,
            workspaces: memory.each_ref().map(|slice| slice.device_ptr(stream).0),
            _memory: memory.map(|slice| Memory::new(slice, recordings)),
            recordings: recordings.clone(),
            plans: Mutex::default(),
        })
    }

    /// # Safety
    /// The memory must be as large as the sizes and strides ask for.
    pub(super) unsafe fn multiply(
        &self,
        stream: &CudaStream,
        workspace: usize,
        product: &Product,
    ) -> Result<()> {
        let [rows, inner, columns] = product.sizes;
        let key = [
            rows,
            inner,
            columns,
            product.left.stride,
            product.right.stride,
            product.stride,
            product.left.transposed.into(),
            product.right.transposed.into(),
            product.add.into(),
            alignment(product) as usize,
        ];
        let known =
            self.plans.lock().unwrap_or_else(|broken| broken.into_inner()).get(&key).copied();
        let plan = match known {
            Some(plan) => plan,
            None => {
                let plan = self.plan(product)?;
                self.plans.lock().unwrap_or_else(|broken| broken.into_inner()).insert(key, plan);
                plan
            }
        };
        // SAFETY: as for this function.
        unsafe { self.run(stream, workspace, product, &plan) }
    }

    /// # Safety
    /// As [`Self::multiply`].
    unsafe fn run(
        &self,
        stream: &CudaStream,
        workspace: usize,
        product: &Product,
        plan: &Plan,
    ) -> Result<()> {
        let (one, add) = (1f32, if product.add { 1f32 } else { 0f32 });
        let pointer = |address: u64| address as *mut c_void;
        // SAFETY: the caller's promise; the plan was made for these sizes.
        unsafe {
            lt::matmul(
                self.handle,
                plan.operation,
                (&raw const one).cast(),
                (&raw const add).cast(),
                pointer(product.right.at.address()),
                plan.right,
                pointer(product.left.at.address()),
                plan.left,
                pointer(product.result.address()),
                plan.result,
                pointer(product.result.address()),
                plan.result,
                &raw const plan.algorithm,
                pointer(self.workspaces[workspace]),
                WORKSPACE,
                stream.cu_stream().cast(),
            )
        }
        .context("cublasLtMatmul")
    }

    /// cuBLAS goes through matrices column by column, so it is asked for the transpose of the product:
    /// `result' = right' left'`.
    #[expect(clippy::too_many_lines, reason = "one sequence of calls of cuBLASLt")]
    fn plan(&self, product: &Product) -> Result<Plan> {
        use sys::{
            cublasLtMatmulDescAttributes_t as Attribute,
            cublasLtMatmulPreferenceAttributes_t as Preference,
        };
        let [rows, inner, columns] = product.sizes;
        let compute = match self.precision {
            Precision::Tf32 => sys::cublasComputeType_t::CUBLAS_COMPUTE_32F_FAST_TF32,
            Precision::Fp32 => sys::cublasComputeType_t::CUBLAS_COMPUTE_32F,
        };
        let numbers = sys::cudaDataType_t::CUDA_R_32F;
        let operation =
            lt::create_matmul_desc(compute, numbers).context("cublasLtMatmulDescCreate")?;
        for (attribute, factor) in [
            (Attribute::CUBLASLT_MATMUL_DESC_TRANSA, &product.right),
            (Attribute::CUBLASLT_MATMUL_DESC_TRANSB, &product.left),
        ] {
            let transposed = i32::from(factor.transposed); // CUBLAS_OP_N or CUBLAS_OP_T
            // SAFETY: the attribute is an i32.
            unsafe {
                lt::set_matmul_desc_attribute(
                    operation,
                    attribute,
                    (&raw const transposed).cast(),
                    4,
                )
            }
            .context("cublasLtMatmulDescSetAttribute")?;
        }
        let layout = |rows: usize, columns: usize, stride: usize| {
            lt::create_matrix_layout(numbers, rows as u64, columns as u64, stride as i64)
                .context("cublasLtMatrixLayoutCreate")
        };
        let factor = |factor: &Factor, rows, columns| match factor.transposed {
            false => layout(rows, columns, factor.stride),
            true => layout(columns, rows, factor.stride),
        };
        let right = factor(&product.right, columns, inner)?;
        let left = factor(&product.left, inner, rows)?;
        let result = layout(columns, rows, product.stride)?;
        let preference = lt::create_matmul_pref().context("cublasLtMatmulPreferenceCreate")?;
        let (most, mut count) = (WORKSPACE, 0);
        let mut found = Vec::<sys::cublasLtMatmulHeuristicResult_t>::with_capacity(1);
        // SAFETY: the attribute is a size of 8 bytes; there is room for one result.
        unsafe {
            lt::set_matmul_pref_attribute(
                preference,
                Preference::CUBLASLT_MATMUL_PREF_MAX_WORKSPACE_BYTES,
                (&raw const most).cast(),
                size_of_val(&most),
            )
            .context("cublasLtMatmulPreferenceSetAttribute")?;
            let alignment = alignment(product);
            for attribute in [
                Preference::CUBLASLT_MATMUL_PREF_MIN_ALIGNMENT_A_BYTES,
                Preference::CUBLASLT_MATMUL_PREF_MIN_ALIGNMENT_B_BYTES,
                Preference::CUBLASLT_MATMUL_PREF_MIN_ALIGNMENT_C_BYTES,
                Preference::CUBLASLT_MATMUL_PREF_MIN_ALIGNMENT_D_BYTES,
            ] {
                let value = (&raw const alignment).cast();
                lt::set_matmul_pref_attribute(
                    preference,
                    attribute,
                    value,
                    size_of_val(&alignment),
                )
                .context("cublasLtMatmulPreferenceSetAttribute")?;
            }
            sys::cublasLtMatmulAlgoGetHeuristic(
                self.handle,
                operation,
                right,
                left,
                result,
                result,
                preference,
                1,
                found.as_mut_ptr(),
                &mut count,
            )
            .result()
            .context("cublasLtMatmulAlgoGetHeuristic")?;
            found.set_len(usize::try_from(count).unwrap_or_default().min(1));
            lt::destroy_matmul_pref(preference).context("cublasLtMatmulPreferenceDestroy")?;
        }
        let Some(first) = found.first() else {
            let reason = format!("no algorithm for a product of {rows} x {inner} x {columns}");
            return Err(CudaError::Call { call: "cublasLtMatmulAlgoGetHeuristic", reason });
        };
        Ok(Plan { operation, left, right, result, algorithm: first.algo })
    }
}
