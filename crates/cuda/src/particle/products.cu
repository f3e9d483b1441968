// Products on tensor cores, 16 rows a warp. Each factor is split into its leading 11 bits and the next 11, which TF32 holds; but for
// the product of the latter and the last two bits, products are those of FP32. Matrices are [outputs, inner], so that a thread reads four numbers
// behind each other.
#define WARP_ROWS 16
// Columns of 8 that a warp has at a time.
#define WARP_COLUMNS 3

// A thread's place in the fragments of m16n8k8: row of the left factor, and column of the right one; quadruple within 16 numbers.
__device__ __forceinline__ int fragment_row() { return lane_of() / 4; }
__device__ __forceinline__ int fragment_quad() { return lane_of() % 4; }

struct Parts { float high, low; };
__device__ __forceinline__ Parts parts_of(float v) {
  const float high = round_tf32(v);
  return {high, v - high};
}
// The sums of 16 x 8 products: of the leading bits, and of the others.
struct Fragment { float large[4], small[4]; };
__device__ __forceinline__ Fragment no_sums() { return {{0.0f, 0.0f, 0.0f, 0.0f}, {0.0f, 0.0f, 0.0f, 0.0f}}; }
// Number i of a thread is at row fragment_row() + 8 (i / 2), column 2 fragment_quad() + i % 2.
__device__ __forceinline__ float sum_of(const Fragment& sums, int i) { return sums.large[i] + sums.small[i]; }
// A step over 8 numbers: two of each of the thread's rows `fragment_row()` and that + 8, and two of its column.
__device__ __forceinline__ void add_step(float (&large)[4], float (&small)[4], const Parts (&rows)[4], const Parts (&column)[2]) {
  const float high[4] = {rows[0].high, rows[1].high, rows[2].high, rows[3].high};
  const float low[4] = {rows[0].low, rows[1].low, rows[2].low, rows[3].low};
  const float right_high[2] = {column[0].high, column[1].high}, right_low[2] = {column[0].low, column[1].low};
  multiply_tf32(small, low, right_high);
  multiply_tf32(small, high, right_low);
  multiply_tf32(large, high, right_high);
}
// Two steps over 16 numbers, of which a thread has the quadruple `fragment_quad()`: any order of the numbers gives the sum.
__device__ __forceinline__ void add_quads(Fragment& sums, const float4& upper, const float4& lower, const float4& column) {
  const Parts first[4] = {parts_of(upper.x), parts_of(lower.x), parts_of(upper.y), parts_of(lower.y)};
  const Parts second[4] = {parts_of(upper.z), parts_of(lower.z), parts_of(upper.w), parts_of(lower.w)};
  const Parts right[2][2] = {{parts_of(column.x), parts_of(column.y)}, {parts_of(column.z), parts_of(column.w)}};
  add_step(sums.large, sums.small, first, right[0]);
  add_step(sums.large, sums.small, second, right[1]);
}
__device__ __forceinline__ float4 quad_of(const float* from, bool is) {
  return is ? *(const float4*)from : float4{0.0f, 0.0f, 0.0f, 0.0f};
}

// Copies four numbers, or zeros, to shared memory, while the thread goes on; `end_copies` ends a group of them, `wait_copies` waits
// until all groups but the last so many are there.
#ifdef EMULATED
#define copy_quad(to, from, is) (*(float4*)(to) = quad_of(from, is))
#define end_copies()
#define wait_copies(last)
#else
__device__ __forceinline__ void copy_quad(float* to, const float* from, bool is) {
  asm volatile("cp.async.cg.shared.global [%0], [%1], 16, %2;" ::"r"((u32)__cvta_generic_to_shared(to)), "l"(from), "r"(is ? 16 : 0) : "memory");
}
#define end_copies() asm volatile("cp.async.commit_group;" ::: "memory")
#define wait_copies(last) asm volatile("cp.async.wait_group %0;" ::"n"(last) : "memory")
#endif

// A linear layer on a warp's rows in shared memory: y [16, outputs] = x [16, inner] times w [outputs, inner], whose rows are `step`
// apart, plus the bias where there is one, plus y if `ADDED`, with ReLU if `rectified`.
template <bool ADDED> __device__ __forceinline__ void tile_product(const float* x, int x_stride, float* y, int y_stride,
    const float* __restrict__ w, int step, const float* __restrict__ bias, int inner, int outputs, bool rectified) {
  const int row = fragment_row(), quads = inner / 4;
  for (int first = 0; first < outputs; first += 8 * WARP_COLUMNS) {
    Fragment sums[WARP_COLUMNS];
#pragma unroll
    for (int c = 0; c < WARP_COLUMNS; c++) sums[c] = no_sums();
    for (int k = 0; k < quads; k += 4) {
      const int quad = k + fragment_quad();
      const bool is = quad < quads;
      const float4 upper = quad_of(x + row * x_stride + 4 * quad, is), lower = quad_of(x + (row + 8) * x_stride + 4 * quad, is);
#pragma unroll
      for (int c = 0; c < WARP_COLUMNS; c++) {
        const int column = first + 8 * c + row;
        if (first + 8 * c < outputs) add_quads(sums[c], upper, lower, quad_of(w + (size_t)column * step + 4 * quad, is && column < outputs));
      }
    }
#pragma unroll
    for (int c = 0; c < WARP_COLUMNS; c++)
#pragma unroll
      for (int i = 0; i < 4; i++) {
        const int column = first + 8 * c + 2 * fragment_quad() + i % 2;
        if (column >= outputs) continue;
        float& to = y[(row + 8 * (i / 2)) * y_stride + column];
        const float sum = sum_of(sums[c], i) + (bias ? bias[column] : 0.0f) + (ADDED ? to : 0.0f);
        to = rectified && sum < 0.0f ? 0.0f : sum;
      }
  }
}
// A layer with the transposed matrix and its bias behind it, as `train_transpose` leaves them.
__device__ __forceinline__ void tile_layer(const float* x, int x_stride, float* y, int y_stride, const float* __restrict__ w, int inner,
    int outputs, bool rectified) {
  tile_product<false>(x, x_stride, y, y_stride, w, inner, w + inner * outputs, inner, outputs, rectified);
}
// The gradient by a layer's input from the one by its sums: the matrix is as it is, [inner, outputs].
__device__ __forceinline__ void tile_gradient(const float* by, int by_stride, float* to, int to_stride, const float* __restrict__ w, int inner,
    int outputs) {
  tile_product<false>(by, by_stride, to, to_stride, w, outputs, nullptr, outputs, inner, false);
}
