// What is done to the particles of a window, of either network.

__device__ __forceinline__ Body mirror(Body body, const Window& window, float sides) {
  if (window.mirrored) {
    body.x[0] = sides - body.x[0];
    body.v[0] = -body.v[0];
  }
  return body;
}

// Noise on particle p of n: evenly distributed, of the standard deviations `positions` and `velocities`; word i of a window's
// generator belongs to its i-th number, positions first.
__device__ __forceinline__ Body disturbed(Body body, const Window& window, int n, int p, float positions, float velocities) {
  u32 words[16];
  u64 block = ~0ull;
#pragma unroll
  for (int i = 0; i < FEATURES; i++) {
    const u64 word = (u64)(i / DIM) * DIM * n + (u64)p * DIM + i % DIM;
    if (word / 16 != block) {
      block = word / 16;
      chacha8(window.key, block, words);
    }
    u32 found = 0; // a dynamic index would put the words into local memory
#pragma unroll
    for (int w = 0; w < 16; w++) found = (int)(word % 16) == w ? words[w] : found;
    const float half = 1.7320508f * (i < DIM ? positions : velocities);
    const float add = half * (2.0f * unit(found) - 1.0f);
    if (i < DIM) body.x[i] += add; else body.v[i - DIM] += add;
  }
  return body;
}
