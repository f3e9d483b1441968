// The pointwise encoder: Linear(INPUTS, E), activation, mean over the particles of a window. A fused form: no activation is stored.
// Otherwise a step of 256 windows of the paper's network would write 1.31 GB of activations and read them at least once, for the
// gradient: .63 ms at the 4.13 TB/s of an H200, beside .665 ms of the whole step as it is. Computed, not timed; PyTorch, which stores
// them, takes 2.98 ms (`gpu.md` of the book).
//
// Particles are taken in the order of their materials, so that the material's columns are a bias of
// its own for each material and a particle costs FEATURES multiplications whatever the materials are.
//
// The mean hands every particle the same gradient, so the weights' gradient is
// sum_rows g[row, j] S[row, k, j] / N with S[row, k, j] = sum_p slope(a_pj) x_pk, which does not need g:
// the forward pass adds it up, and nothing is computed again or kept for the backward pass. For ELU,
// slope = exp(min(a, 0)) and value = max(a, 0) + slope - 1: one exponential for both.
//
// sums: [rows, chunks, SUMS, E]: slope * feature for each feature, slopes for each material, values (of ELU
// without its slope - 1).
#define SUMS (FEATURES + MATERIAL_INPUTS + 1)
#define TILE 256

struct Scaling { float least[FEATURES]; float inverse_range[FEATURES]; };

__device__ __forceinline__ float feature(const Body& body, int k, const Scaling* scaling) {
  const float v = k < DIM ? body.x[k] : body.v[k - DIM];
  return (v - scaling->least[k]) * scaling->inverse_range[k];
}
// Bias of unit j for a material, and its weight for feature k.
__device__ __forceinline__ float material_bias(const float* w, int material, int j) {
  const float bias = w[INPUTS * EL + j];
#if ONE_HOT
  return bias + w[(FEATURES + material) * EL + j];
#else
  return bias + w[FEATURES * EL + j] * ((float)material / (MATERIAL_INPUTS - 1));
#endif
}

// The activation and its slope at `a`, in units of 1 / log2(e): of ELU without slope - 1; it and ReLU stay in these units.
__device__ __forceinline__ void activate_scaled(float a, float& y, float& s) {
#if ACTIVATION == 0
  y = divide(1.0f, 1.0f + exp2_approximate(-a));
  s = y * (1.0f - y);
#elif ACTIVATION == 1
  y = 1.0f - divide(2.0f, 1.0f + exp2_approximate(2.0f * a));
  s = 1.0f - y * y;
#elif ACTIVATION == 2
  y = fmaxf(a, 0.0f);
  s = a > 0.0f ? 1.0f : 0.0f;
#else
  y = fmaxf(a, 0.0f);
  s = exp2_approximate(fminf(a, 0.0f));
#endif
}

// A block has 256 units of a window's frame.
#define UNIT_BLOCKS ((E + 255) / 256)
#define ENCODED const int row = (blockIdx.z / UNIT_BLOCKS) * batch + blockIdx.y, units_from = (blockIdx.z % UNIT_BLOCKS) * 256;

// grid (chunks, batch, frames * UNIT_BLOCKS), block 256: 128 pairs of units j, j + 128, twice for half of the particles
extern "C" __global__ void __launch_bounds__(256, 4) encode(const Body* __restrict__ states, const u32* __restrict__ order,
    const u32* __restrict__ segments, const Window* __restrict__ windows, const Progress* __restrict__ progress,
    const float* __restrict__ w, const Scaling* __restrict__ scaling, float* __restrict__ sums, int batch) {
  __shared__ float tile[TILE][FEATURES];
  __shared__ float other[(FEATURES + 2) * 256];
  const int tid = threadIdx.x, lane = tid & 127, half = tid >> 7, chunk = blockIdx.x;
  ENCODED
  const int size = (N + gridDim.x - 1) / gridDim.x, first = chunk * size, last = min(N, first + size);
  const u32 stream = windows[(size_t)progress->step * batch + blockIdx.y].stream;
  const u32* sorted = order + (size_t)stream * N;
  const u32* ends = segments + (size_t)stream * (MATERIALS + 1);
  float* to = sums + ((size_t)row * gridDim.x + chunk) * SUMS * E;
  int unit[2];
  bool is[2];
  float weight[2][FEATURES], slope[2][FEATURES], value[2];
#pragma unroll
  for (int q = 0; q < 2; q++) {
    unit[q] = units_from + lane + 128 * q;
    is[q] = unit[q] < E;
    value[q] = 0.0f;
#pragma unroll
    for (int k = 0; k < FEATURES; k++) {
      weight[q][k] = is[q] ? w[k * EL + unit[q]] * LOG2E : 0.0f;
      slope[q][k] = 0.0f;
    }
  }
  for (int material = 0; material < MATERIAL_INPUTS; material++) {
    const int from = max(first, (int)ends[material]), to_end = min(last, (int)ends[material + 1]);
    float bias[2], slopes[2] = {0.0f, 0.0f};
#pragma unroll
    for (int q = 0; q < 2; q++) bias[q] = is[q] ? material_bias(w, material, unit[q]) * LOG2E : 0.0f;
    for (int at = from; at < to_end; at += TILE) {
      const int n = min(TILE, to_end - at);
      __syncthreads();
      if (tid < n) {
        const Body body = states[(size_t)row * N + sorted[at + tid]];
#pragma unroll
        for (int k = 0; k < FEATURES; k++) tile[tid][k] = feature(body, k, scaling);
      }
      __syncthreads();
#pragma unroll 2
      for (int p = half; p < n; p += 2) {
        float x[FEATURES];
#pragma unroll
        for (int k = 0; k < FEATURES; k++) x[k] = tile[p][k];
#pragma unroll
        for (int q = 0; q < 2; q++) {
          float a = bias[q]; // in units of 1 / log2(e)
#pragma unroll
          for (int k = 0; k < FEATURES; k++) a = fmaf(weight[q][k], x[k], a);
          float y, s;
          activate_scaled(a, y, s);
          value[q] += y;
          slopes[q] += s;
#pragma unroll
          for (int k = 0; k < FEATURES; k++) slope[q][k] = fmaf(s, x[k], slope[q][k]);
        }
      }
    }
    // The slopes of this material, of both halves.
    __syncthreads();
    if (half)
#pragma unroll
      for (int q = 0; q < 2; q++) other[lane + 128 * q] = slopes[q];
    __syncthreads();
    if (!half)
#pragma unroll
      for (int q = 0; q < 2; q++)
        if (is[q]) to[(FEATURES + material) * E + unit[q]] = slopes[q] + other[lane + 128 * q];
  }
  __syncthreads();
  if (half)
#pragma unroll
    for (int q = 0; q < 2; q++) {
#pragma unroll
      for (int k = 0; k < FEATURES; k++) other[k * 256 + lane + 128 * q] = slope[q][k];
      other[FEATURES * 256 + lane + 128 * q] = value[q];
    }
  __syncthreads();
  if (!half)
#pragma unroll
    for (int q = 0; q < 2; q++)
      if (is[q]) {
#pragma unroll
        for (int k = 0; k < FEATURES; k++) to[k * E + unit[q]] = slope[q][k] + other[k * 256 + lane + 128 * q];
        const float total = value[q] + other[FEATURES * 256 + lane + 128 * q];
        to[(FEATURES + MATERIAL_INPUTS) * E + unit[q]] = ACTIVATION >= 2 ? total * (1.0f / LOG2E) : total;
      }
}

// The same with both products on tensor cores, factors rounded to TF32: units x particles from the inputs (features, and
// one for the particle's material, whose weight is that material's bias), then with the slopes in the place of the sums
// units x inputs. Taking the 8 particles of a group in the order 0 2 4 6 1 3 5 7 makes the first product's registers the
// second one's left factor as they are. grid (chunks, batch, frames * UNIT_BLOCKS), block 256: a warp has 64 units, and
// half of the particles
#define COLUMNS (FEATURES + MATERIAL_INPUTS)
#define GROUPS ((COLUMNS + 7) / 8)
#define TENSOR_TILE 512
extern "C" __global__ void __launch_bounds__(256, 3) encode_tensor(const Body* __restrict__ states, const unsigned char* __restrict__ material,
    const Window* __restrict__ windows, const Progress* __restrict__ progress, const float* __restrict__ w,
    const Scaling* __restrict__ scaling, float* __restrict__ sums, int batch) {
  __shared__ float4 tile[TENSOR_TILE * 2 * GROUPS];
  const int tid = threadIdx.x, lane = tid & 31, warp = tid >> 5, half = warp >> 2, g = lane >> 2, q = lane & 3;
  ENCODED
  const int size = (N + gridDim.x - 1) / gridDim.x, first = blockIdx.x * size, last = min(N, first + size);
  const u32 stream = windows[(size_t)progress->step * batch + blockIdx.y].stream;
  const int local = (warp & 3) * 64 + g;
  float weight[4][GROUPS][4], slope[4][GROUPS][4], value[4][2];
#pragma unroll
  for (int t = 0; t < 4; t++)
#pragma unroll
    for (int i = 0; i < 4; i++) {
      value[t][i & 1] = 0.0f;
#pragma unroll
      for (int group = 0; group < GROUPS; group++) {
        const int k = 8 * group + q + 4 * (i >> 1), j = units_from + local + 16 * t + 8 * (i & 1);
        float number = 0.0f;
        if (j < E && k < COLUMNS) number = k < FEATURES ? w[k * EL + j] : material_bias(w, k - FEATURES, j);
        weight[t][group][i] = round_tf32(number * LOG2E);
        slope[t][group][i] = 0.0f;
      }
    }
  int padding = 0;
  for (int from = first; from < last; from += TENSOR_TILE) {
    const int n = min(TENSOR_TILE, last - from), padded_n = (n + 15) & ~15;
    padding += padded_n - n;
    __syncthreads();
    for (int p = tid; p < padded_n; p += 256) {
      Body body;
      int kind = -1;
      if (p < n) {
        body = states[(size_t)row * N + from + p];
        kind = material[(size_t)stream * N + from + p];
      }
      float input[8 * GROUPS];
#pragma unroll
      for (int k = 0; k < 8 * GROUPS; k++) {
        if (k < FEATURES) input[k] = p < n ? round_tf32(feature(body, k, scaling)) : 0.0f;
        else input[k] = k - FEATURES == kind ? 1.0f : 0.0f;
      }
#pragma unroll
      for (int k = 0; k < 2 * GROUPS; k++)
        tile[p * 2 * GROUPS + k] = float4{input[4 * k], input[4 * k + 1], input[4 * k + 2], input[4 * k + 3]};
    }
    __syncthreads();
    const float* numbers = (const float*)tile;
#pragma unroll 1
    for (int p = half * 8; p < padded_n; p += 16) {
      float right[GROUPS][2], left[GROUPS][2];
#pragma unroll
      for (int group = 0; group < GROUPS; group++)
#pragma unroll
        for (int i = 0; i < 2; i++) {
          right[group][i] = numbers[(p + g) * 8 * GROUPS + 8 * group + q + 4 * i];
          left[group][i] = numbers[(p + 2 * q + i) * 8 * GROUPS + 8 * group + g];
        }
#pragma unroll
      for (int t = 0; t < 4; t++) {
        float a[4] = {0.0f, 0.0f, 0.0f, 0.0f}, s[4];
#pragma unroll
        for (int group = 0; group < GROUPS; group++) multiply_tf32(a, weight[t][group], right[group]);
#pragma unroll
        for (int i = 0; i < 4; i++) {
          float y, by;
          activate_scaled(a[i], y, by);
          value[t][i >> 1] += y;
          s[(i >> 1) + 2 * (i & 1)] = round_tf32(by);
        }
#pragma unroll
        for (int group = 0; group < GROUPS; group++) multiply_tf32(slope[t][group], s, left[group]);
      }
    }
  }
#pragma unroll
  for (int t = 0; t < 4; t++)
#pragma unroll
    for (int r = 0; r < 2; r++)
#pragma unroll
      for (int m = 1; m < 4; m *= 2) value[t][r] += shuffle_xor(value[t][r], m);
  // The sums of both halves.
  float* other = (float*)tile;
  float* to = sums + ((size_t)row * gridDim.x + blockIdx.x) * SUMS * E + units_from;
#pragma unroll
  for (int pass = 0; pass < 2; pass++) {
    __syncthreads();
    if (half != pass)
#pragma unroll
      for (int t = 0; t < 4; t++)
#pragma unroll
        for (int r = 0; r < 2; r++) {
          const int unit = local + 16 * t + 8 * r;
          if (units_from + unit >= E) continue;
#pragma unroll
          for (int group = 0; group < GROUPS; group++)
#pragma unroll
            for (int i = 0; i < 2; i++) {
              const int k = 8 * group + 2 * q + i;
              if (k >= COLUMNS) continue;
              if (half) other[k * 256 + unit] = slope[t][group][2 * r + i];
              else to[k * E + unit] = slope[t][group][2 * r + i] + other[k * 256 + unit];
            }
          if (q == 0) {
            if (half) other[COLUMNS * 256 + unit] = value[t][r];
            else {
              float total = value[t][r] + other[COLUMNS * 256 + unit];
              if (ACTIVATION == 0) total -= 0.5f * padding;
              to[COLUMNS * E + unit] = ACTIVATION >= 2 ? total * (1.0f / LOG2E) : total;
            }
          }
        }
  }
}

// Means over the particles, and the ones beside them. grid rows, block 256
extern "C" __global__ void pool(const float* __restrict__ sums, float* __restrict__ pooled, int chunks) {
  const int row = blockIdx.x;
  for (int j = threadIdx.x; j < EP; j += 256) {
    float value = 0.0f, slopes = 0.0f;
    if (j < E)
      for (int c = 0; c < chunks; c++) {
        const float* from = sums + ((size_t)row * chunks + c) * SUMS * E;
        value += from[(FEATURES + MATERIAL_INPUTS) * E + j];
        if (ACTIVATION == 3)
          for (int m = 0; m < MATERIAL_INPUTS; m++) slopes += from[(FEATURES + m) * E + j];
      }
    const float mean = (ACTIVATION == 3 ? value + (slopes - (float)N) : value) * (1.0f / N);
    pooled[(size_t)row * EP + j] = j < E ? mean : (j == E ? 1.0f : 0.0f);
  }
}

// Gradient of the encoder's weights. grid (ceil(E / 32), INPUTS + 1), block (32, 32)
extern "C" __global__ void encoder_gradient(const float* __restrict__ g, const float* __restrict__ sums,
    float* __restrict__ dw, int rows, int chunks) {
  __shared__ float parts[32][33];
  const int j = blockIdx.x * 32 + threadIdx.x, k = blockIdx.y;
  float total = 0.0f;
  if (j < E)
    for (int r = threadIdx.y; r < rows; r += 32) {
      float s = 0.0f;
      for (int c = 0; c < chunks; c++) {
        const float* from = sums + ((size_t)r * chunks + c) * SUMS * E + j;
        if (k < FEATURES) s += from[k * E];
        else if (k < INPUTS && ONE_HOT) s += from[k * E];
        else
          for (int m = 0; m < MATERIAL_INPUTS; m++)
            s += from[(FEATURES + m) * E] * (k == INPUTS ? 1.0f : (float)m / (MATERIAL_INPUTS - 1));
      }
      total = fmaf(g[(size_t)r * EP + j], s, total);
    }
  parts[threadIdx.y][threadIdx.x] = total;
  __syncthreads();
  for (int m = 16; m; m >>= 1) {
    if (threadIdx.y < m) parts[threadIdx.y][threadIdx.x] += parts[threadIdx.y + m][threadIdx.x];
    __syncthreads();
  }
  if (threadIdx.y == 0 && j < E) dw[k * EL + j] = parts[0][threadIdx.x] * (1.0f / N);
}

// Gradient of positions and velocities, added to `carried`, [B, N]: of a frame that was predicted.
// grid (ceil(N / 256), batch), block 256
extern "C" __global__ void __launch_bounds__(256) encoder_points_gradient(const Body* __restrict__ states, const unsigned char* __restrict__ material,
    const Window* __restrict__ windows, const Progress* __restrict__ progress, const float* __restrict__ w,
    const Scaling* __restrict__ scaling, const float* __restrict__ g, Body* __restrict__ carried) {
  __shared__ float weights[64][FEATURES + MATERIAL_INPUTS + 1];
  const int p = blockIdx.x * 256 + threadIdx.x, b = blockIdx.y, batch = gridDim.y;
  const bool is = p < N;
  const u32 stream = windows[(size_t)progress->step * batch + b].stream;
  float x[FEATURES], dx[FEATURES];
  int kind = 0;
  if (is) {
    const Body body = states[(size_t)b * N + p];
    kind = material[(size_t)stream * N + p];
#pragma unroll
    for (int k = 0; k < FEATURES; k++) x[k] = feature(body, k, scaling);
  }
#pragma unroll
  for (int k = 0; k < FEATURES; k++) dx[k] = 0.0f;
  for (int from = 0; from < E; from += 64) {
    const int n = min(64, E - from);
    __syncthreads();
    for (int i = threadIdx.x; i < n * (FEATURES + MATERIAL_INPUTS + 1); i += 256) {
      const int k = i / n, j = i % n;
      weights[j][k] = k < FEATURES ? w[k * EL + from + j]
          : (k < FEATURES + MATERIAL_INPUTS ? material_bias(w, k - FEATURES, from + j) : g[(size_t)b * EP + from + j] * (1.0f / N));
    }
    __syncthreads();
    if (is)
      for (int j = 0; j < n; j++) {
        float a = weights[j][FEATURES + kind];
#pragma unroll
        for (int k = 0; k < FEATURES; k++) a = fmaf(weights[j][k], x[k], a);
        const float s = weights[j][FEATURES + MATERIAL_INPUTS] * activation_slope(activate(a));
#pragma unroll
        for (int k = 0; k < FEATURES; k++) dx[k] = fmaf(s, weights[j][k], dx[k]);
      }
  }
  if (!is) return;
  Body& to = carried[(size_t)b * N + p];
#pragma unroll
  for (int k = 0; k < FEATURES; k++) {
    const float by = dx[k] * scaling->inverse_range[k];
    if (k < DIM) to.x[k] += by; else to.v[k - DIM] += by;
  }
}
