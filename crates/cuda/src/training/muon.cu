// Muon (Jordan et al. 2024) for the weights of hidden layers, launched by `training/muon.rs`; `muon.rs` of eddy-learning on the
// processor. The momentum U of a tensor is multiplied by polynomials of the smaller of U U^T and U^T U, which is `size` wide, so that
// its singular values come to about 1.
#define MUON_PARTS 8
// As on the processor:
#define MUON_MOMENTUM 0.95f
#define MUON_ITERATIONS 5
#define MUON_EPSILON 1e-7f
struct MuonTensor {
  u32 first;          // where its numbers begin within all
  int rows, columns;  // padding included
  int stride;         // numbers from a row to the next one
  int tensor;
  u32 gram;           // where the parts of its small product begin within those of all, [MUON_PARTS, size, size]
  float step;         // what an orthogonal matrix is multiplied by, beside the learning rate
};
__device__ __forceinline__ int shorter(const MuonTensor& tensor) { return min(tensor.rows, tensor.columns); }
__device__ __forceinline__ int longer(const MuonTensor& tensor) { return max(tensor.rows, tensor.columns); }
__device__ __forceinline__ bool is_wide(const MuonTensor& tensor) { return tensor.rows < tensor.columns; }
// The momentum after a gradient; and, from that momentum, Nesterov's.
__device__ __forceinline__ float decayed_sum(float momentum, float gradient) { return MUON_MOMENTUM * momentum + gradient; }

// Changes the momentum, and a part of the small product. grid (MUON_PARTS, tensors), block 256, shared memory:
// ceil(longest / MUON_PARTS) rows of the largest size
extern "C" __global__ void __launch_bounds__(256) muon_gram(const MuonTensor* __restrict__ tensors, const float* __restrict__ gradients, float* __restrict__ momentum, const float* __restrict__ scales,
    float* __restrict__ grams) {
  DYNAMIC_SHARED(float, rows);
  const MuonTensor tensor = tensors[blockIdx.y];
  const float scale = scales[tensor.tensor];
  if (scale == 0.0f) return; // as in `adam`
  const int size = shorter(tensor), length = longer(tensor), each = (length + MUON_PARTS - 1) / MUON_PARTS;
  const int from = min((int)blockIdx.x * each, length), count = min(from + each, length) - from;
  const bool wide = is_wide(tensor);
  for (int i = threadIdx.x; i < count * size; i += 256) {
    // Neighbours in memory to neighbouring threads.
    const int across = wide ? i / count : i % size, along = wide ? i % count : i / size;
    const u32 place = tensor.first + (wide ? (u32)across * tensor.stride + from + along : (u32)(from + along) * tensor.stride + across);
    const float gradient = scale * gradients[place], changed = decayed_sum(momentum[place], gradient);
    momentum[place] = changed;
    rows[along * size + across] = decayed_sum(changed, gradient);
  }
  __syncthreads();
  float* gram = grams + tensor.gram + (size_t)blockIdx.x * size * size;
  for (int i = threadIdx.x; i < size * size; i += 256) {
    const float *left = rows + i / size, *right = rows + i % size;
    float sum = 0.0f;
    for (int row = 0; row < count; row++) sum = fmaf(left[row * size], right[row * size], sum);
    gram[i] = sum;
  }
}

// c = a b by a block of 256 threads, tiles of 4 x 4 each: `size` is a multiple of 4, and a symmetric, as all polynomials of the small
// product and their products are.
__device__ __forceinline__ void symmetric_product(const float* a, const float* b, float* c, int size) {
  const int wide = size / 4;
  for (int tile = threadIdx.x; tile < wide * wide; tile += 256) {
    const int row = 4 * (tile / wide), column = 4 * (tile % wide);
    float sums[4][4] = {};
    for (int k = 0; k < size; k++) {
      const float4 x = *(const float4*)(a + k * size + row), y = *(const float4*)(b + k * size + column);
      const float left[4] = {x.x, x.y, x.z, x.w}, right[4] = {y.x, y.y, y.z, y.w};
#pragma unroll
      for (int i = 0; i < 4; i++)
#pragma unroll
        for (int j = 0; j < 4; j++) sums[i][j] = fmaf(left[i], right[j], sums[i][j]);
    }
#pragma unroll
    for (int i = 0; i < 4; i++) *(float4*)(c + (row + i) * size + column) = float4{sums[i][0], sums[i][1], sums[i][2], sums[i][3]};
  }
  __syncthreads();
}

// factor = a I + b gram + c gram^2, whose square comes by way of `other`.
__device__ __forceinline__ void polynomial_of(const float* gram, float* other, float* factor, int size) {
  symmetric_product(gram, gram, other, size);
  for (int i = threadIdx.x; i < size * size; i += 256)
    factor[i] = -4.7750f * gram[i] + 2.0315f * other[i] + (i / size == i % size ? 3.4445f : 0.0f);
  __syncthreads();
}

// The polynomial of the small product, in place of its first part. grid tensors, block 256, shared memory: four matrices of the
// largest size
extern "C" __global__ void __launch_bounds__(256) muon_polynomial(const MuonTensor* __restrict__ tensors, const float* __restrict__ scales, float* __restrict__ grams) {
  DYNAMIC_SHARED(float, shared);
  const MuonTensor tensor = tensors[blockIdx.x];
  if (scales[tensor.tensor] == 0.0f) return;
  const int size = shorter(tensor), n = size * size;
  float *gram = shared, *factor = gram + n, *all = factor + n, *other = all + n, *parts = grams + tensor.gram;
  float trace = 0.0f;
  for (int i = threadIdx.x; i < n; i += 256) {
    float sum = 0.0f;
    for (int part = 0; part < MUON_PARTS; part++) sum += parts[(size_t)part * n + i];
    gram[i] = sum;
    if (i / size == i % size) trace += sum;
  }
  const float square = block_sum(trace);
  const float norm = fmaxf(sqrtf(square), MUON_EPSILON);
  for (int i = threadIdx.x; i < n; i += 256) gram[i] /= norm * norm;
  __syncthreads();
  polynomial_of(gram, other, factor, size);
  for (int i = threadIdx.x; i < n; i += 256) all[i] = factor[i];
  for (int iteration = 1; iteration < MUON_ITERATIONS; iteration++) {
    symmetric_product(gram, factor, other, size);
    symmetric_product(other, factor, gram, size);
    polynomial_of(gram, other, factor, size);
    symmetric_product(factor, all, other, size);
    float* swapped = all;
    all = other;
    other = swapped;
  }
  for (int i = threadIdx.x; i < n; i += 256) parts[i] = all[i] / norm;
}

// Changes weights and their average. grid (ceil(most rows * columns / 4 / 256), tensors), block 256
extern "C" __global__ void __launch_bounds__(256) muon(const MuonTensor* __restrict__ tensors, float* __restrict__ weights, const float* __restrict__ gradients, const float* __restrict__ momentum,
    float* __restrict__ average, const float* __restrict__ scales, const float* __restrict__ grams, const Schedule* __restrict__ schedule, const Progress* __restrict__ progress) {
  const MuonTensor tensor = tensors[blockIdx.y];
  const int number = blockIdx.x * 256 + threadIdx.x, wide = tensor.columns / 4;
  const float scale = scales[tensor.tensor];
  if (number >= tensor.rows * wide || scale == 0.0f) return;
  const int row = number / wide, column = 4 * (number % wide), size = shorter(tensor);
  const float* polynomial = grams + tensor.gram;
  float4 sum = {0.0f, 0.0f, 0.0f, 0.0f};
  for (int k = 0; k < size; k++) {
    if (is_wide(tensor)) {
      const u32 place = tensor.first + (u32)k * tensor.stride + column;
      const float4 m = *(const float4*)(momentum + place), g = *(const float4*)(gradients + place);
      const float by = polynomial[row * size + k];
      sum.x = fmaf(by, decayed_sum(m.x, scale * g.x), sum.x);
      sum.y = fmaf(by, decayed_sum(m.y, scale * g.y), sum.y);
      sum.z = fmaf(by, decayed_sum(m.z, scale * g.z), sum.z);
      sum.w = fmaf(by, decayed_sum(m.w, scale * g.w), sum.w);
    } else {
      const u32 place = tensor.first + (u32)row * tensor.stride + k;
      const float u = decayed_sum(momentum[place], scale * gradients[place]);
      const float4 by = *(const float4*)(polynomial + k * size + column);
      sum.x = fmaf(u, by.x, sum.x);
      sum.y = fmaf(u, by.y, sum.y);
      sum.z = fmaf(u, by.z, sum.z);
      sum.w = fmaf(u, by.w, sum.w);
    }
  }
  const Schedule& now = schedule[progress->step];
  const float step = now.plain_rate * tensor.step;
  const u32 place = tensor.first + (u32)row * tensor.stride + column;
  float4 weight = *(float4*)(weights + place);
  weight.x -= step * sum.x;
  weight.y -= step * sum.y;
  weight.z -= step * sum.z;
  weight.w -= step * sum.w;
  *(float4*)(weights + place) = weight;
  if (!average) return;
  float4 kept = *(float4*)(average + place);
  AVERAGE(x) AVERAGE(y) AVERAGE(z) AVERAGE(w)
  *(float4*)(average + place) = kept;
}
