// The recurrent cells. `states` is [frames + 1, B, HP], the state before the first frame first; sums are
// [frames, B, gates * HP], gates side by side. `d_output` is the gradient by the outputs of these frames,
// `carried` [B, HP] the gradient by the last state from later frames; it leaves as the gradient by the state
// before the first frame. Gradients by the sums replace the sums.
// A thread has a unit of a window: grid (ceil(HP / 128), B), block 128.

// Candidates of the log form are made positive (Feng et al. 2024, appendix B).
__device__ __forceinline__ float candidate(float c) {
#if LOG_FORM
  return c >= 0.0f ? c + 0.5f : sigmoid(c);
#else
  return c;
#endif
}
__device__ __forceinline__ float candidate_slope(float c) {
#if LOG_FORM
  const float s = sigmoid(c);
  return c >= 0.0f ? 1.0f : s * (1.0f - s);
#else
  return 1.0f;
#endif
}
#define UNIT                                                           \
  const int j = blockIdx.x * blockDim.x + threadIdx.x, b = blockIdx.y, batch = gridDim.y; \
  if (j >= HP) return;                                                 \
  const size_t block = (size_t)batch * HP, at = (size_t)b * HP + j;

// minGRU: z = sigmoid(z'), h_t = (1 - z) h_{t-1} + z c.
__device__ __forceinline__ float mingru(float z, float c, float h) { return fmaf(sigmoid(z), candidate(c) - h, h); }
extern "C" __global__ void mingru_forward(const float* __restrict__ sums, float* __restrict__ states, int frames) {
  UNIT
  float h = j < H ? states[at] : 0.0f;
#pragma unroll 4
  for (int t = 0; t < frames; t++) {
    const float* gates = sums + ((size_t)t * batch + b) * 2 * HP + j;
    h = mingru(gates[0], gates[HP], h);
    states[(t + 1) * block + at] = padded(j, h);
  }
}
extern "C" __global__ void mingru_backward(float* __restrict__ sums, const float* __restrict__ states,
    const float* __restrict__ d_output, float* __restrict__ carried, int frames) {
  UNIT
  float carry = carried[at];
#pragma unroll 4
  for (int t = frames - 1; t >= 0; t--) {
    float* gates = sums + ((size_t)t * batch + b) * 2 * HP + j;
    const float z = sigmoid(gates[0]), c = candidate(gates[HP]), before = states[t * block + at];
    const float d = j < H ? carry + d_output[t * block + at] : 0.0f;
    gates[0] = d * (c - before) * z * (1.0f - z);
    gates[HP] = d * z * candidate_slope(gates[HP]);
    carry = d * (1.0f - z);
  }
  carried[at] = carry;
}

// minLSTM: f = sigmoid(f'), i = sigmoid(i'); normalised: h_t = h_{t-1} + u (c - h_{t-1}), u = i / (f + i);
// otherwise h_t = f h_{t-1} + i c.
#define LEAST_SUM 1e-12f
__device__ __forceinline__ float minlstm(float f, float i, float c, float h) {
  f = sigmoid(f);
  i = sigmoid(i);
#if NORMALIZED
  return fmaf(divide(i, f + i + LEAST_SUM), candidate(c) - h, h);
#else
  return fmaf(f, h, i * candidate(c));
#endif
}
extern "C" __global__ void minlstm_forward(const float* __restrict__ sums, float* __restrict__ states, int frames) {
  UNIT
  float h = j < H ? states[at] : 0.0f;
#pragma unroll 4
  for (int t = 0; t < frames; t++) {
    const float* gates = sums + ((size_t)t * batch + b) * 3 * HP + j;
    h = minlstm(gates[0], gates[HP], gates[2 * HP], h);
    states[(t + 1) * block + at] = padded(j, h);
  }
}
extern "C" __global__ void minlstm_backward(float* __restrict__ sums, const float* __restrict__ states,
    const float* __restrict__ d_output, float* __restrict__ carried, int frames) {
  UNIT
  float carry = carried[at];
#pragma unroll 4
  for (int t = frames - 1; t >= 0; t--) {
    float* gates = sums + ((size_t)t * batch + b) * 3 * HP + j;
    const float f = sigmoid(gates[0]), i = sigmoid(gates[HP]), c = candidate(gates[2 * HP]);
    const float before = j < H ? states[t * block + at] : 0.0f;
    const float d = j < H ? carry + d_output[t * block + at] : 0.0f;
#if NORMALIZED
    const float inverse = divide(1.0f, f + i + LEAST_SUM), u = i * inverse, du = d * (c - before) * inverse;
    const float df = -du * u, di = du * (1.0f - u), dc = d * u;
    carry = d * (1.0f - u);
#else
    const float df = d * before, di = d * c, dc = d * i;
    carry = d * f;
#endif
    gates[0] = df * f * (1.0f - f);
    gates[HP] = di * i * (1.0f - i);
    gates[2 * HP] = dc * candidate_slope(gates[2 * HP]);
  }
  carried[at] = carry;
}

// GRU as PyTorch has it, one frame: r = sigmoid(i_r + h_r), z = sigmoid(i_z + h_z), n = tanh(i_n + r h_n),
// h_t = (1 - z) n + z h_{t-1}. `inputs` become r, z, n; `recurrent` keeps h_n.
extern "C" __global__ void gru_forward(float* __restrict__ inputs, const float* __restrict__ recurrent, float* __restrict__ states) {
  UNIT
  float* x = inputs + (size_t)b * 3 * HP + j;
  const float* y = recurrent + (size_t)b * 3 * HP + j;
  const float r = sigmoid(x[0] + y[0]), z = sigmoid(x[HP] + y[HP]);
  const float n = hyperbolic_tangent(fmaf(r, y[2 * HP], x[2 * HP])), before = j < H ? states[at] : 0.0f;
  states[block + at] = padded(j, fmaf(z, before - n, n));
  x[0] = r;
  x[HP] = z;
  x[2 * HP] = n;
}
// `carried` holds the gradient by the state, that through the product with W_hh included; it leaves without the
// product's part of this frame.
extern "C" __global__ void gru_backward(float* __restrict__ inputs, float* __restrict__ recurrent, const float* __restrict__ states,
    const float* __restrict__ d_output, float* __restrict__ carried) {
  UNIT
  float* x = inputs + (size_t)b * 3 * HP + j;
  float* y = recurrent + (size_t)b * 3 * HP + j;
  const float r = x[0], z = x[HP], n = x[2 * HP], before = states[at];
  const float d = j < H ? carried[at] + d_output[at] : 0.0f;
  const float dn = d * (1.0f - z) * (1.0f - n * n), dz = d * (before - n) * z * (1.0f - z);
  const float dr = dn * y[2 * HP] * r * (1.0f - r);
  x[0] = y[0] = dr;
  x[HP] = y[HP] = dz;
  x[2 * HP] = dn;
  y[2 * HP] = dn * r;
  carried[at] = d * z;
}

// LSTM as PyTorch has it, one frame: c_t = sigmoid(f) c_{t-1} + sigmoid(i) tanh(g), h_t = sigmoid(o) tanh(c_t).
// `sums` (i, f, g, o) become the gates; `cells` is like `states`.
extern "C" __global__ void lstm_forward(float* __restrict__ sums, float* __restrict__ states, float* __restrict__ cells) {
  UNIT
  float* gates = sums + (size_t)b * 4 * HP + j;
  const float i = sigmoid(gates[0]), f = sigmoid(gates[HP]), g = hyperbolic_tangent(gates[2 * HP]), o = sigmoid(gates[3 * HP]);
  const float c = j < H ? fmaf(f, cells[at], i * g) : 0.0f;
  cells[block + at] = c;
  states[block + at] = padded(j, o * hyperbolic_tangent(c));
  gates[0] = i;
  gates[HP] = f;
  gates[2 * HP] = g;
  gates[3 * HP] = o;
}
extern "C" __global__ void lstm_backward(float* __restrict__ sums, const float* __restrict__ cells, const float* __restrict__ d_output,
    float* __restrict__ carried, float* __restrict__ carried_cell) {
  UNIT
  float* gates = sums + (size_t)b * 4 * HP + j;
  const float i = gates[0], f = gates[HP], g = gates[2 * HP], o = gates[3 * HP];
  const float before = cells[at], t = hyperbolic_tangent(cells[block + at]);
  const float d = j < H ? carried[at] + d_output[at] : 0.0f;
  const float dc = j < H ? fmaf(d * o, 1.0f - t * t, carried_cell[at]) : 0.0f;
  gates[0] = dc * g * i * (1.0f - i);
  gates[HP] = dc * before * f * (1.0f - f);
  gates[2 * HP] = dc * i * (1.0f - g * g);
  gates[3 * HP] = d * t * o * (1.0f - o);
  carried_cell[at] = dc * f;
}

// The activation in place, and its gradient. grid (ceil(HP / 128), batch, frames), block 128
extern "C" __global__ void activation_forward(float* __restrict__ y) {
  const int j = blockIdx.x * blockDim.x + threadIdx.x;
  if (j >= HP) return;
  const size_t i = ((size_t)blockIdx.z * gridDim.y + blockIdx.y) * HP + j;
  y[i] = padded(j, activate(y[i]));
}
extern "C" __global__ void activation_backward(float* __restrict__ d, const float* __restrict__ y) {
  const int j = blockIdx.x * blockDim.x + threadIdx.x;
  if (j >= HP) return;
  const size_t i = ((size_t)blockIdx.z * gridDim.y + blockIdx.y) * HP + j;
  d[i] = j < H ? d[i] * activation_slope(y[i]) : 0.0f;
}
// No gradient where the ones are. grid ceil(rows / 128), block 128
extern "C" __global__ void clear_padding(float* __restrict__ d, int rows) {
  const int r = blockIdx.x * blockDim.x + threadIdx.x;
  if (r < rows)
    for (int j = H; j < HP; j++) d[(size_t)r * HP + j] = 0.0f;
}

// Dropout: number i of [rows, H] (without the padding) has word `first + i` of the step's generator, and is kept,
// divided by the share that is kept, unless the word is below the rate. Forwards, and backwards on gradients
// (`ones` 0, `from` is `to`). grid ceil((rows * H / 16 + 1) / 128), block 128: a thread has the 16 words of a block.
extern "C" __global__ void dropout(const float* from, float* to, const Schedule* __restrict__ schedule,
    const Progress* __restrict__ progress, u64 first, int rows, float rate, float ones) {
  const u64 block = first / 16 + blockIdx.x * blockDim.x + threadIdx.x, last = first + (u64)rows * H;
  if (block * 16 >= last) return;
  u32 words[16];
  chacha8(schedule[progress->step].dropout, block, words);
  const float kept = 1.0f / (1.0f - rate);
#pragma unroll
  for (int w = 0; w < 16; w++) {
    const u64 word = block * 16 + w;
    if (word >= first && word < last) {
      const u64 i = word - first, row = i / H, j = i % H, at = row * HP + j;
      to[at] = from[at] * (unit(words[w]) < rate ? 0.0f : kept);
      if (j == H - 1)
        for (int pad = H; pad < HP; pad++) to[row * HP + pad] = pad == H ? ones : 0.0f;
    }
  }
}
