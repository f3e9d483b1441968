// Pooling by the maximum: for each unit h of the second Linear, the largest of its outputs over the particles of a window.
// The outputs of a group of windows lie in memory at the same time, [rows, N, HP]; which particle has the largest one is
// kept, [rows, H], and all gradients go through these particles alone.

// The first Linear's activations of particles, and the ones beside them: `points` [rows, N, EP].
// grid (ceil(N / POINT_TILE), rows), block 256
#define POINT_TILE 16
__device__ __forceinline__ void encode_tile(const Body* bodies, const int* kinds, int n, const float* __restrict__ w,
    const Scaling* __restrict__ scaling, float* __restrict__ points) {
  for (int j = threadIdx.x; j < EP; j += 256) {
    float weight[FEATURES], bias[MATERIAL_INPUTS];
    if (j < E) {
#pragma unroll
      for (int k = 0; k < FEATURES; k++) weight[k] = w[k * EL + j];
#pragma unroll
      for (int m = 0; m < MATERIAL_INPUTS; m++) bias[m] = material_bias(w, m, j);
    }
    for (int p = 0; p < n; p++) {
      float y = j == E ? 1.0f : 0.0f;
      if (j < E) {
        float a = 0.0f;
#pragma unroll
        for (int m = 0; m < MATERIAL_INPUTS; m++) a = kinds[p] == m ? bias[m] : a;
#pragma unroll
        for (int k = 0; k < FEATURES; k++) a = fmaf(weight[k], feature(bodies[p], k, scaling), a);
        y = activate(a);
      }
      points[(size_t)p * EP + j] = y;
    }
  }
}
extern "C" __global__ void __launch_bounds__(256) encode_points(const Body* __restrict__ states, const unsigned char* __restrict__ material,
    const Window* __restrict__ windows, const Progress* __restrict__ progress, const float* __restrict__ w,
    const Scaling* __restrict__ scaling, float* __restrict__ points, int first, int batch) {
  __shared__ Body bodies[POINT_TILE];
  __shared__ int kinds[POINT_TILE];
  const int row = blockIdx.y, from = blockIdx.x * POINT_TILE, n = min(POINT_TILE, N - from);
  const u32 stream = windows[(size_t)progress->step * batch + (first + row) % batch].stream;
  if (threadIdx.x < n) {
    bodies[threadIdx.x] = states[(size_t)row * N + from + threadIdx.x];
    kinds[threadIdx.x] = material[(size_t)stream * N + from + threadIdx.x];
  }
  __syncthreads();
  encode_tile(bodies, kinds, n, w, scaling, points + ((size_t)row * N + from) * EP);
}
// The same of streams; their particles stand in the order of their materials, and each stream's begin `stride` numbers after
// those of the one before.
extern "C" __global__ void __launch_bounds__(256) encode_points_of_streams(const Body* __restrict__ frames, const Row* __restrict__ rows,
    const float* __restrict__ w, const Scaling* __restrict__ scaling, float* __restrict__ points, u64 stride) {
  __shared__ Body bodies[POINT_TILE];
  __shared__ int kinds[POINT_TILE];
  const int b = blockIdx.y, from = blockIdx.x * POINT_TILE, n = min(POINT_TILE, N - from);
  const Row row = rows[b];
  if (threadIdx.x < n) {
    const int at = from + threadIdx.x;
    bodies[threadIdx.x] = frames[(size_t)b * N + row.order[at]];
    int kind = 0;
    for (int m = 1; m < MATERIAL_INPUTS; m++) kind += at >= (int)row.segments[m];
    kinds[threadIdx.x] = kind;
  }
  __syncthreads();
  encode_tile(bodies, kinds, n, w, scaling, points + (size_t)b * stride + (size_t)from * EP);
}

// The largest outputs, behind the means if there are means: `input` [rows, IP]; and the first particle that has each of them,
// if `which` [rows, H] is asked for. Each window's outputs begin `stride` numbers after those of the one before.
// grid (ceil((IP - MEAN * H) / 32), rows), block (32, 8)
extern "C" __global__ void __launch_bounds__(256) largest(const float* __restrict__ outputs, u64 stride, float* __restrict__ input, u32* __restrict__ which) {
  __shared__ float values[8][32];
  __shared__ int particles[8][32];
  const int h = blockIdx.x * 32 + threadIdx.x, row = blockIdx.y;
  const float* from = outputs + (size_t)row * stride + h;
  float best = 0.0f;
  int particle = 0;
  if (h < H && threadIdx.y < N) {
    particle = threadIdx.y;
    best = from[(size_t)particle * HP];
    for (int p = threadIdx.y + 8; p < N; p += 8) {
      const float value = from[(size_t)p * HP];
      if (value > best) {
        best = value;
        particle = p;
      }
    }
  }
  values[threadIdx.y][threadIdx.x] = best;
  particles[threadIdx.y][threadIdx.x] = particle;
  __syncthreads();
  if (threadIdx.y || MEAN * H + h >= IP) return;
  float* to = input + (size_t)row * IP + MEAN * H + h;
  if (h >= H) {
    *to = h == H ? 1.0f : 0.0f;
    return;
  }
  for (int y = 1; y < 8 && y < N; y++) {
    const float value = values[y][threadIdx.x];
    const int other = particles[y][threadIdx.x];
    if (value > best || (value == best && other < particle)) {
      best = value;
      particle = other;
    }
  }
  *to = best;
  if (which) which[(size_t)row * H + h] = particle;
}

// Gradient of the means' part of the core's input, for the product with the second Linear: `mean` [frames, batch, HP].
// grid (ceil(HP / 128), batch, frames), block 128
extern "C" __global__ void mean_part(const float* __restrict__ input, float* __restrict__ mean) {
  const int j = blockIdx.x * 128 + threadIdx.x, row = blockIdx.z * gridDim.y + blockIdx.y;
  if (j < HP) mean[(size_t)row * HP + j] = j < H ? input[(size_t)row * IP + j] : 0.0f;
}

// Gradients by the weights of both Linears, of unit h = blockIdx.x of the second one: added to what its means give, if there
// are means; those by the first Linear, for features and materials, into `parts` [H, FEATURES + MATERIAL_INPUTS, E].
// grid H, block 256
extern "C" __global__ void __launch_bounds__(256) maximum_gradient(const Body* __restrict__ states, const unsigned char* __restrict__ material,
    const Window* __restrict__ windows, const Progress* __restrict__ progress, const float* __restrict__ w,
    const Scaling* __restrict__ scaling, const float* __restrict__ second, const float* __restrict__ d_input,
    const u32* __restrict__ which, float* __restrict__ d_second, float* __restrict__ parts, int rows, int batch) {
  const int h = blockIdx.x;
  for (int j = threadIdx.x; j <= E; j += 256) {
    float by_second = 0.0f, by_first[FEATURES + MATERIAL_INPUTS], weight[FEATURES], bias[MATERIAL_INPUTS], above = 0.0f;
    if (j < E) {
      above = second[(size_t)j * HP + h];
#pragma unroll
      for (int k = 0; k < FEATURES; k++) weight[k] = w[k * EL + j];
#pragma unroll
      for (int m = 0; m < MATERIAL_INPUTS; m++) bias[m] = material_bias(w, m, j);
    }
#pragma unroll
    for (int k = 0; k < FEATURES + MATERIAL_INPUTS; k++) by_first[k] = 0.0f;
    for (int row = 0; row < rows; row++) {
      const float g = d_input[(size_t)row * IP + MEAN * H + h];
      if (j == E) {
        by_second += g;
        continue;
      }
      const u32 p = which[(size_t)row * H + h];
      const Body body = states[(size_t)row * N + p];
      const int kind = material[(size_t)windows[(size_t)progress->step * batch + row % batch].stream * N + p];
      float x[FEATURES], a = 0.0f;
#pragma unroll
      for (int m = 0; m < MATERIAL_INPUTS; m++) a = kind == m ? bias[m] : a;
#pragma unroll
      for (int k = 0; k < FEATURES; k++) {
        x[k] = feature(body, k, scaling);
        a = fmaf(weight[k], x[k], a);
      }
      const float y = activate(a), slope = g * above * activation_slope(y);
      by_second = fmaf(g, y, by_second);
#pragma unroll
      for (int k = 0; k < FEATURES; k++) by_first[k] = fmaf(slope, x[k], by_first[k]);
#pragma unroll
      for (int m = 0; m < MATERIAL_INPUTS; m++) by_first[FEATURES + m] += kind == m ? slope : 0.0f;
    }
    float* to = d_second + (size_t)j * HP + h;
    *to = MEAN ? *to + by_second : by_second;
    if (j < E)
#pragma unroll
      for (int k = 0; k < FEATURES + MATERIAL_INPUTS; k++) parts[((size_t)h * (FEATURES + MATERIAL_INPUTS) + k) * E + j] = by_first[k];
  }
}
// The sums of the parts. grid (ceil(E / 32), INPUTS + 1), block (32, 32)
extern "C" __global__ void maximum_sum(const float* __restrict__ parts, float* __restrict__ dw) {
  __shared__ float sums[32][33];
  const int j = blockIdx.x * 32 + threadIdx.x, k = blockIdx.y;
  float total = 0.0f;
  if (j < E)
    for (int h = threadIdx.y; h < H; h += 32) {
      const float* from = parts + (size_t)h * (FEATURES + MATERIAL_INPUTS) * E + j;
      if (k < FEATURES || (k < INPUTS && ONE_HOT)) total += from[k * E];
      else
        for (int m = 0; m < MATERIAL_INPUTS; m++)
          total += from[(FEATURES + m) * E] * (k == INPUTS ? 1.0f : (float)m / (MATERIAL_INPUTS - 1));
    }
  sums[threadIdx.y][threadIdx.x] = total;
  __syncthreads();
  for (int m = 16; m; m >>= 1) {
    if (threadIdx.y < m) sums[threadIdx.y][threadIdx.x] += sums[threadIdx.y + m][threadIdx.x];
    __syncthreads();
  }
  if (threadIdx.y || j >= E) return;
  float* to = dw + k * EL + j;
  *to = MEAN ? *to + sums[0][threadIdx.x] : sums[0][threadIdx.x];
}

// Gradient by the particle that has the largest output of a unit, `slopes` [B, H], of a frame that was predicted.
// grid (H, B), block 32
extern "C" __global__ void maximum_slopes(const Body* __restrict__ states, const unsigned char* __restrict__ material,
    const Window* __restrict__ windows, const Progress* __restrict__ progress, const float* __restrict__ w,
    const Scaling* __restrict__ scaling, const float* __restrict__ second, const float* __restrict__ d_input,
    const u32* __restrict__ which, Body* __restrict__ slopes) {
  __shared__ float sums[FEATURES][32];
  const int h = blockIdx.x, b = blockIdx.y, batch = gridDim.y;
  const float g = d_input[(size_t)b * IP + MEAN * H + h];
  const u32 p = which[(size_t)b * H + h];
  const Body body = states[(size_t)b * N + p];
  const int kind = material[(size_t)windows[(size_t)progress->step * batch + b].stream * N + p];
  float dx[FEATURES];
#pragma unroll
  for (int k = 0; k < FEATURES; k++) dx[k] = 0.0f;
  for (int j = threadIdx.x; j < E; j += 32) {
    float a = material_bias(w, kind, j);
#pragma unroll
    for (int k = 0; k < FEATURES; k++) a = fmaf(w[k * EL + j], feature(body, k, scaling), a);
    const float slope = g * second[(size_t)j * HP + h] * activation_slope(activate(a));
#pragma unroll
    for (int k = 0; k < FEATURES; k++) dx[k] = fmaf(slope, w[k * EL + j], dx[k]);
  }
#pragma unroll
  for (int k = 0; k < FEATURES; k++) sums[k][threadIdx.x] = dx[k];
  __syncthreads();
  for (int m = 16; m; m >>= 1) {
    if (threadIdx.x < m)
#pragma unroll
      for (int k = 0; k < FEATURES; k++) sums[k][threadIdx.x] += sums[k][threadIdx.x + m];
    __syncthreads();
  }
  if (threadIdx.x >= FEATURES) return;
  const int k = threadIdx.x;
  Body& to = slopes[(size_t)b * H + h];
  const float by = sums[k][0] * scaling->inverse_range[k];
  if (k < DIM) to.x[k] = by; else to.v[k - DIM] = by;
}
// Adds them to `carried` [B, N], each to its particle. grid (ceil(N / 256), B), block 256
extern "C" __global__ void __launch_bounds__(256) maximum_points_gradient(const u32* __restrict__ which, const Body* __restrict__ slopes, Body* __restrict__ carried) {
  __shared__ u32 particles[256];
  __shared__ Body tile[256];
  const int p = blockIdx.x * 256 + threadIdx.x, b = blockIdx.y;
  Body sum = {};
  for (int from = 0; from < H; from += 256) {
    const int n = min(256, H - from);
    __syncthreads();
    if (threadIdx.x < n) {
      particles[threadIdx.x] = which[(size_t)b * H + from + threadIdx.x];
      tile[threadIdx.x] = slopes[(size_t)b * H + from + threadIdx.x];
    }
    __syncthreads();
    for (int i = 0; i < n; i++)
      if ((int)particles[i] == p)
#pragma unroll
        for (int a = 0; a < DIM; a++) {
          sum.x[a] += tile[i].x[a];
          sum.v[a] += tile[i].v[a];
        }
  }
  if (p >= N) return;
  Body& to = carried[(size_t)b * N + p];
#pragma unroll
  for (int a = 0; a < DIM; a++) {
    to.x[a] += sum.x[a];
    to.v[a] += sum.v[a];
  }
}
