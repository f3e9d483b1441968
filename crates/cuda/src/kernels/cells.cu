// The recurrent cells. `states` is [frames + 1, B, HP], the state before the first frame first; sums are
// [frames, B, gates * HP], gates side by side. `d_output` is the gradient by the outputs of these frames,
// `carried` [B, HP] the gradient by the last state from later frames; it leaves as the gradient by the state
// before the first frame. Gradients by the sums replace the sums.
// A thread has a unit of a window: grid (ceil(HP / 128), B), block 128.

#define UNIT                                                           \
  const int j = blockIdx.x * blockDim.x + threadIdx.x, b = blockIdx.y, batch = gridDim.y; \
  if (j >= HP) return;                                                 \
  const size_t block = (size_t)batch * HP, at = (size_t)b * HP + j;

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
    const float d = j < H ? carry + d_output[t * block + at] : 0.0f;
    carry = mingru_gradient(gates[0], gates[HP], states[t * block + at], d);
  }
  carried[at] = carry;
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
    const float before = j < H ? states[t * block + at] : 0.0f;
    const float d = j < H ? carry + d_output[t * block + at] : 0.0f;
    carry = minlstm_gradient(gates[0], gates[HP], gates[2 * HP], before, d);
  }
  carried[at] = carry;
}

// One frame: `inputs` become r, z, n; `recurrent` keeps n_h.
extern "C" __global__ void gru_forward(float* __restrict__ inputs, const float* __restrict__ recurrent, float* __restrict__ states) {
  UNIT
  float* x = inputs + (size_t)b * 3 * HP + j;
  const float* y = recurrent + (size_t)b * 3 * HP + j;
  x[0] += y[0];
  x[HP] += y[HP];
  states[block + at] = padded(j, gru(x[0], x[HP], x[2 * HP], y[2 * HP], j < H ? states[at] : 0.0f));
}
// `carried` holds the gradient by the state, that through the product with W_hh included; it leaves without the
// product's part of this frame.
extern "C" __global__ void gru_backward(float* __restrict__ inputs, float* __restrict__ recurrent, const float* __restrict__ states,
    const float* __restrict__ d_output, float* __restrict__ carried) {
  UNIT
  float* x = inputs + (size_t)b * 3 * HP + j;
  float* y = recurrent + (size_t)b * 3 * HP + j;
  carried[at] = gru_gradient(x[0], x[HP], x[2 * HP], y[2 * HP], states[at], j < H ? carried[at] + d_output[at] : 0.0f);
  y[0] = x[0];
  y[HP] = x[HP];
}

// One frame: `sums` (i, f, g, o) become the gates; `cells` is like `states`.
extern "C" __global__ void lstm_forward(float* __restrict__ sums, float* __restrict__ states, float* __restrict__ cells) {
  UNIT
  float* gates = sums + (size_t)b * 4 * HP + j;
  float cell = cells[at];
  const float h = lstm(gates[0], gates[HP], gates[2 * HP], gates[3 * HP], cell);
  cells[block + at] = j < H ? cell : 0.0f;
  states[block + at] = padded(j, h);
}
extern "C" __global__ void lstm_backward(float* __restrict__ sums, const float* __restrict__ cells, const float* __restrict__ d_output,
    float* __restrict__ carried, float* __restrict__ carried_cell) {
  UNIT
  float* gates = sums + (size_t)b * 4 * HP + j;
  float by_cell = j < H ? carried_cell[at] : 0.0f;
  const float d = j < H ? carried[at] + d_output[at] : 0.0f;
  lstm_gradient(gates[0], gates[HP], gates[2 * HP], gates[3 * HP], cells[at], cells[block + at], d, by_cell);
  carried_cell[at] = by_cell;
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
