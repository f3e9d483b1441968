// Windows out of the store of trajectories. Frames are [T, B, N]: the windows of a frame side by side.

// The windows of the step `ahead` steps from now, out of trajectories in the memory of the host: window b goes to place
// (step % 2) * B + b of `staged`, while the windows of the step before lie at the other places. `sources` are the number of
// steps whose windows are known, and for each of their windows its first body. grid at most B, block 256
extern "C" __global__ void __launch_bounds__(256) fetch(const Body* __restrict__ host, const u64* __restrict__ sources,
    const Progress* __restrict__ progress, Body* __restrict__ staged, int ahead, int bodies, int batch) {
  const u64 step = (u64)progress->step + ahead;
  if (step >= sources[0]) return;
  for (int b = blockIdx.x; b < batch; b += gridDim.x) {
    const Body* from = host + sources[1 + step * batch + b];
    Body* to = staged + ((step & 1) * batch + b) * bodies;
#pragma unroll 4
    for (int i = threadIdx.x; i < bodies; i += 256) to[i] = from[i];
  }
}

// The observed frames. grid (ceil(N / 256), batch, warm_up), block 256
extern "C" __global__ void __launch_bounds__(256) observe(const Body* __restrict__ store, const Window* __restrict__ windows,
    const Progress* __restrict__ progress, Body* __restrict__ states, int batch, float sides) {
  const int p = blockIdx.x * 256 + threadIdx.x, b = blockIdx.y, t = blockIdx.z, row = t * batch + b;
  if (p >= N) return;
  const Window& window = windows[(size_t)progress->step * batch + b];
  states[(size_t)row * N + p] = mirror(store[window.first + (u64)t * N + p], window, sides);
}

// Noise on the last observed frame, `states` [B, N]. grid (ceil(N / 256), batch), block 256
extern "C" __global__ void __launch_bounds__(256) disturb(const Window* __restrict__ windows, const Progress* __restrict__ progress,
    Body* __restrict__ states, float positions, float velocities) {
  const int p = blockIdx.x * 256 + threadIdx.x, b = blockIdx.y, batch = gridDim.y;
  const Window& window = windows[(size_t)progress->step * batch + b];
  if (p >= N || !window.disturbed) return;
  Body& body = states[(size_t)b * N + p];
  body = disturbed(body, window, N, p, positions, velocities);
}
