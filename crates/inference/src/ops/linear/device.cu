// A linear layer of a tile of rows in shared memory, for predictions. Matrices are [inner, gates, outputs], their widths rounded up to 4,
// the biases [gates, outputs] behind them. THREADS threads of a block have ROWS rows each at a time. Trainings multiply on tensor cores
// (`particle/products.cu` of eddy-cuda).

template <int UNITS> __device__ __forceinline__ void load_units(const float* from, float* to) {
  if constexpr (UNITS == 4) {
    const float4 four = *(const float4*)from;
    to[0] = four.x; to[1] = four.y; to[2] = four.z; to[3] = four.w;
  } else {
    const float2 two = *(const float2*)from;
    to[0] = two.x; to[1] = two.y;
  }
}
// sums[slot of gate][row][unit] += x w for ROWS rows of x, `step` apart, over `inner` numbers. The gate SPLIT goes to the slot
// behind the last gate; none if SPLIT is COUNT.
template <int COUNT, int SLOTS, int UNITS, int SPLIT>
__device__ __forceinline__ void add_products(float (&sums)[SLOTS][ROWS][UNITS], const float* x, int step, const float* __restrict__ w,
    int columns, int gate_columns, int inner) {
#pragma unroll 2
  for (int k = 0; k < inner; k += 4) {
    float row[ROWS][4];
#pragma unroll
    for (int r = 0; r < ROWS; r++) load_units<4>(x + r * step + k, row[r]);
#pragma unroll
    for (int i = 0; i < 4; i++)
#pragma unroll
      for (int gate = 0; gate < COUNT; gate++) {
        const int slot = gate == SPLIT ? COUNT : gate;
        float weight[UNITS];
        load_units<UNITS>(w + (size_t)(k + i) * columns + gate * gate_columns, weight);
#pragma unroll
        for (int r = 0; r < ROWS; r++)
#pragma unroll
          for (int u = 0; u < UNITS; u++) sums[slot][r][u] = fmaf(row[r][i], weight[u], sums[slot][r][u]);
      }
  }
}
// A linear layer on the rows of a tile in shared memory, with ReLU if `rectified`; the bias is behind the matrix.
template <int TILE_ROWS, bool BIASED> __device__ __forceinline__ void tile_product(const float* x, int x_stride, float* y, int y_stride,
    const float* __restrict__ w, int inner, int outputs, bool rectified) {
  constexpr int apart = TILE_ROWS / ROWS;
  for (int item = threadIdx.x; item < apart * (outputs / 4); item += THREADS) {
    const int row = item % apart, column = item / apart * 4;
    float sums[1][ROWS][4];
#pragma unroll
    for (int r = 0; r < ROWS; r++) {
      if constexpr (BIASED) load_units<4>(w + (size_t)inner * outputs + column, sums[0][r]);
      else
        for (int u = 0; u < 4; u++) sums[0][r][u] = 0.0f;
    }
    add_products<1, 1, 4, -1>(sums, x + row * x_stride, apart * x_stride, w + column, outputs, 0, inner);
#pragma unroll
    for (int r = 0; r < ROWS; r++)
#pragma unroll
      for (int u = 0; u < 4; u++) {
        const float sum = sums[0][r][u];
        y[(row + r * apart) * y_stride + column + u] = rectified && sum < 0.0f ? 0.0f : sum;
      }
  }
}
__device__ __forceinline__ void tile_linear(const float* x, int x_stride, float* y, int y_stride, const float* __restrict__ w, int inner,
    int outputs, bool rectified) {
  tile_product<TILE, true>(x, x_stride, y, y_stride, w, inner, outputs, rectified);
}
