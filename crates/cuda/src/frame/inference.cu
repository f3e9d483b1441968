// Streams, one frame at a time: B streams side by side, each in a row of its own. What is added to what in a row, and in
// which order, does not depend on B: a stream's predictions have the same bits whatever runs beside it.

// What is remembered of a stream.
struct Row {
  float* state;        // [layers, HP]; of LSTM also the cells, after all states
  const u32* order;    // particles in the order of their materials, [N]
  const u32* segments; // where each material starts in that order, [MATERIALS + 1]
};

// What a batch is made of, from the memory of the host: the frames, the streams' rows, and the states as rows of a
// matrix, `before` [layers, B, HP]. grid (ceil(max(N, layers * HP) / 256), B), block 256
extern "C" __global__ void __launch_bounds__(256) load_streams(const Row* __restrict__ host_rows, const Body* __restrict__ host_frames,
    Row* __restrict__ rows, Body* __restrict__ frames, float* __restrict__ before, int layers) {
  const int i = blockIdx.x * 256 + threadIdx.x, b = blockIdx.y, batch = gridDim.y;
  const Row row = host_rows[b];
  if (i == 0) rows[b] = row;
  if (i < N) frames[(size_t)b * N + i] = host_frames[(size_t)b * N + i];
  if (i < layers * HP) before[((size_t)(i / HP) * batch + b) * HP + i % HP] = row.state[i];
}

// The pointwise encoder without the sums for its gradient: sums over STREAM_TILE particles each, [B, gridDim.x, E].
// grid (ceil(N / STREAM_TILE), B, ceil(E / 256)), block 256: a thread has a unit
#define STREAM_TILE 64
extern "C" __global__ void __launch_bounds__(256) encode_streams(const Body* __restrict__ frames, const Row* __restrict__ rows,
    const float* __restrict__ w, const Scaling* __restrict__ scaling, float* __restrict__ sums) {
  __shared__ float tile[STREAM_TILE][FEATURES];
  const int b = blockIdx.y, j = blockIdx.z * 256 + threadIdx.x, first = blockIdx.x * STREAM_TILE;
  const int n = min(STREAM_TILE, N - first);
  const Row row = rows[b];
  if (threadIdx.x < n) {
    const Body body = frames[(size_t)b * N + row.order[first + threadIdx.x]];
#pragma unroll
    for (int k = 0; k < FEATURES; k++) tile[threadIdx.x][k] = feature(body, k, scaling);
  }
  __syncthreads();
  if (j >= E) return;
  float weight[FEATURES], total = 0.0f;
#pragma unroll
  for (int k = 0; k < FEATURES; k++) weight[k] = w[k * EL + j];
  for (int material = 0; material < MATERIAL_INPUTS; material++) {
    const int from = max(0, (int)row.segments[material] - first), to = min(n, (int)row.segments[material + 1] - first);
    const float bias = material_bias(w, material, j);
    for (int p = from; p < to; p++) {
      float a = bias;
#pragma unroll
      for (int k = 0; k < FEATURES; k++) a = fmaf(weight[k], tile[p][k], a);
      total += activate(a);
    }
  }
  sums[((size_t)b * gridDim.x + blockIdx.x) * E + j] = total;
}
// Means over the particles, and the ones beside them. grid B, block 256
extern "C" __global__ void __launch_bounds__(256) pool_streams(const float* __restrict__ sums, float* __restrict__ pooled, int chunks) {
  const int b = blockIdx.x;
  for (int j = threadIdx.x; j < EP; j += 256) {
    float total = 0.0f;
    if (j < E)
      for (int c = 0; c < chunks; c++) total += sums[((size_t)b * chunks + c) * E + j];
    pooled[(size_t)b * EP + j] = j < E ? total * (1.0f / N) : (j == E ? 1.0f : 0.0f);
  }
}

// Products of few rows with a matrix, which is read once for every ROWS rows: parts[s, b, c] is the sum over the s-th PART
// rows of the matrix, of `left[b, k] w[k, c]`. `inner` is a multiple of SPAN, `columns` of 4.
// grid (ceil(columns / 128), ceil(inner / PART), ceil(B / ROWS)), block 256: a warp has SPAN rows of the matrix, a thread
// four columns.
#define SPAN 8
#define PART (8 * SPAN)
template <int ROWS>
__device__ __forceinline__ void product_part(const float* __restrict__ left, const float* __restrict__ w, float* __restrict__ parts,
    int inner, int columns, int batch) {
  __shared__ float4 sums[8][ROWS][32];
  const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5, column = blockIdx.x * 128 + 4 * lane;
  const int first = blockIdx.y * PART + warp * SPAN, row = blockIdx.z * ROWS;
  const bool is = column < columns && first < inner;
  float4 weight[SPAN];
#pragma unroll
  for (int k = 0; k < SPAN; k++)
    weight[k] = is ? *(const float4*)(w + (size_t)(first + k) * columns + column) : float4{0.0f, 0.0f, 0.0f, 0.0f};
#pragma unroll
  for (int r = 0; r < ROWS; r++) {
    float4 sum = {0.0f, 0.0f, 0.0f, 0.0f};
    if (is && row + r < batch) {
      const float* from = left + (size_t)(row + r) * inner + first;
#pragma unroll
      for (int k = 0; k < SPAN; k++) {
        const float x = from[k];
        sum.x = fmaf(x, weight[k].x, sum.x);
        sum.y = fmaf(x, weight[k].y, sum.y);
        sum.z = fmaf(x, weight[k].z, sum.z);
        sum.w = fmaf(x, weight[k].w, sum.w);
      }
    }
    sums[warp][r][lane] = sum;
  }
  __syncthreads();
  for (int r = warp; r < ROWS; r += 8) {
    if (row + r >= batch || column >= columns) continue;
    float4 sum = sums[0][r][lane];
#pragma unroll
    for (int part = 1; part < 8; part++) {
      const float4 more = sums[part][r][lane];
      sum.x += more.x;
      sum.y += more.y;
      sum.z += more.z;
      sum.w += more.w;
    }
    *(float4*)(parts + ((size_t)blockIdx.y * batch + row + r) * columns + column) = sum;
  }
}
extern "C" __global__ void __launch_bounds__(256) product_of_row(const float* __restrict__ left, const float* __restrict__ w, float* __restrict__ parts,
    int inner, int columns, int batch) {
  product_part<1>(left, w, parts, inner, columns, batch);
}
extern "C" __global__ void __launch_bounds__(256) product_of_rows(const float* __restrict__ left, const float* __restrict__ w, float* __restrict__ parts,
    int inner, int columns, int batch) {
  product_part<8>(left, w, parts, inner, columns, batch);
}
__device__ __forceinline__ float product_sum(const float* parts, int count, int batch, int b, int columns, int column) {
  float sum = 0.0f;
#pragma unroll 4
  for (int s = 0; s < count; s++) sum += parts[((size_t)s * batch + b) * columns + column];
  return sum;
}

// What follows a product, from its `count` parts: a thread has a unit of a row, grid (ceil(HP / 128), B), block 128.
// `signal` [B, HP] goes on to the next product.

// A linear layer, or one with the activation after it.
// Rows of the signal are `stride` apart.
extern "C" __global__ void linear_streams(const float* __restrict__ parts, float* __restrict__ signal, int count, int active, int stride) {
  const int j = blockIdx.x * blockDim.x + threadIdx.x, b = blockIdx.y, batch = gridDim.y;
  if (j >= HP) return;
  const float y = product_sum(parts, count, batch, b, HP, j);
  signal[(size_t)b * stride + j] = padded(j, active ? activate(y) : y);
}
// Layer `layer` of `layers` of a core, from the parts of the products with its input and, if it has recurrent
// weights, with its last outputs.
// `before` are [B, HP], the outputs before the frame; the new state goes to the streams.
extern "C" __global__ void cells_streams(const float* __restrict__ parts, const float* __restrict__ recurrent, const float* __restrict__ before,
    const Row* __restrict__ rows, float* __restrict__ signal, int count, int recurrent_count, int layer, int layers) {
  const int j = blockIdx.x * blockDim.x + threadIdx.x, b = blockIdx.y, batch = gridDim.y;
  if (j >= HP) return;
  const size_t at = (size_t)b * HP + j;
  float sums[GATE_SUMS], state[STATES];
#pragma unroll
  for (int gate = 0; gate < GATES; gate++) {
    sums[gate] = product_sum(parts, count, batch, b, GATES * HP, gate * HP + j);
#if RECURRENT
    const float product = product_sum(recurrent, recurrent_count, batch, b, GATES * HP, gate * HP + j);
    if (gate == SPLIT_GATE) sums[GATE_SUMS - 1] = product;
    else sums[gate] += product;
#endif
  }
  float* own = rows[b].state + (size_t)layer * HP + j;
  state[0] = before[at];
#pragma unroll
  for (int i = 1; i < STATES; i++) state[i] = own[(size_t)i * layers * HP];
  cell_forward(sums, state);
  signal[at] = own[0] = padded(j, state[0]);
#pragma unroll
  for (int i = 1; i < STATES; i++) own[(size_t)i * layers * HP] = j < H ? state[i] : 0.0f;
}

// The next frames, to the memory of the host. grid (ceil(N / 256), B), block 256
extern "C" __global__ void __launch_bounds__(256) predict_streams(const float* __restrict__ parts, const Body* __restrict__ frames,
    Body* __restrict__ host_frames, int count, Motion motion) {
  const int p = blockIdx.x * 256 + threadIdx.x, b = blockIdx.y, batch = gridDim.y;
  if (p >= N) return;
  float output[DIM];
#pragma unroll
  for (int a = 0; a < DIM; a++) output[a] = product_sum(parts, count, batch, b, OP, DIM * p + a);
  host_frames[(size_t)b * N + p] = next_body(frames[(size_t)b * N + p], output, motion);
}
