// A layer of the core over `frames` frames, or one frame at a time if it has recurrent weights. `states` points to the state before the
// first of these frames, in [STATES, T + 1, B, HP]; `list` is the distance from outputs to cells; sums are [frames, B, GATES * HP], gates side by side, and so is `recurrent`: the products of
// the last outputs. `d_output` is the gradient by the outputs of these frames, `carried` [STATES, B, HP] the gradient by the last state from
// later frames, that through the products included; it leaves as the gradient by the state before the first frame, without the
// products' part of this frame. Gradients by the sums replace the sums and the products.
// A thread has a unit of a window: grid (ceil(HP / 128), B), block 128.

#define UNIT                                                           \
  const int j = blockIdx.x * blockDim.x + threadIdx.x, b = blockIdx.y, batch = gridDim.y; \
  if (j >= HP) return;                                                 \
  const size_t block = (size_t)batch * HP, at = (size_t)b * HP + j;

// Forwards, gates that the gradient needs take the place of their sums.
extern "C" __global__ void cells_forward(float* __restrict__ sums, const float* __restrict__ recurrent, float* __restrict__ states, u64 list, int frames) {
  UNIT
  float state[STATES];
#pragma unroll
  for (int i = 0; i < STATES; i++) state[i] = j < H ? states[i * list + at] : 0.0f;
#pragma unroll 4
  for (int t = 0; t < frames; t++) {
    const size_t first = ((size_t)t * batch + b) * GATES * HP + j;
    float own[GATE_SUMS];
#pragma unroll
    for (int gate = 0; gate < GATES; gate++) {
      own[gate] = sums[first + gate * HP];
#if RECURRENT
      if (gate == SPLIT_GATE) own[GATE_SUMS - 1] = recurrent[first + gate * HP];
      else own[gate] += recurrent[first + gate * HP];
#endif
    }
    cell_forward(own, state);
#if RECURRENT
#pragma unroll
    for (int gate = 0; gate < GATES; gate++) sums[first + gate * HP] = own[gate];
#endif
    states[(t + 1) * block + at] = padded(j, state[0]);
#pragma unroll
    for (int i = 1; i < STATES; i++) states[i * list + (t + 1) * block + at] = j < H ? state[i] : 0.0f;
  }
}
extern "C" __global__ void cells_backward(float* __restrict__ sums, float* __restrict__ recurrent, const float* __restrict__ states, u64 list,
    const float* __restrict__ d_output, float* __restrict__ carried, int frames) {
  UNIT
  float by[STATES];
#pragma unroll
  for (int i = 0; i < STATES; i++) by[i] = j < H ? carried[i * block + at] : 0.0f;
#pragma unroll 4
  for (int t = frames - 1; t >= 0; t--) {
    const size_t first = ((size_t)t * batch + b) * GATES * HP + j;
    float own[GATE_SUMS], last[STATES], next[STATES];
#pragma unroll
    for (int gate = 0; gate < GATES; gate++) own[gate] = sums[first + gate * HP];
#if RECURRENT
    if (SPLIT_GATE < GATES) own[GATE_SUMS - 1] = recurrent[first + SPLIT_GATE * HP];
#endif
#pragma unroll
    for (int i = 0; i < STATES; i++) {
      last[i] = states[i * list + t * block + at];
      next[i] = states[i * list + (t + 1) * block + at];
    }
    by[0] = j < H ? by[0] + d_output[t * block + at] : 0.0f;
    cell_gradient(own, last, next, by);
#pragma unroll
    for (int gate = 0; gate < GATES; gate++) {
      sums[first + gate * HP] = own[gate];
#if RECURRENT
      recurrent[first + gate * HP] = own[gate == SPLIT_GATE ? GATE_SUMS - 1 : gate];
#endif
    }
  }
#pragma unroll
  for (int i = 0; i < STATES; i++) carried[i * block + at] = by[i];
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
