// From the decoder's output to predicted frames, what they cost, and the gradient by the output. Frame t predicts frame t + 1. Frames from warm_up - 1 on predict freely ("free"), earlier
// ones predict the warm-up's own frames ("observed").
//
// weights: [unroll, B, MATERIALS] bodies, of squared errors; observed frames have those of the first free one,
// times `even`. `output` is [frames from `decoded` on, B, OP].

struct Frames {
  int batch, warm_up, unroll;
  int decoded;      // the first frame that the decoder runs on
  int weights_step; // bodies of `weights` from a step to the next one, 0 if all have the same
  float sides, even;
  Motion motion;
};

__device__ __forceinline__ Body predict(const Body* states, const float* output, const Frames& f, int t, int b, int p) {
  const float* row = output + ((size_t)(t - f.decoded) * f.batch + b) * OP;
  return next_body(states[((size_t)t * f.batch + b) * N + p], row + DIM * p, f.motion);
}
// What frame t is to predict; of an observed frame, what the network is shown.
__device__ __forceinline__ Body truth_of(const Body* states, const Body* store, const Window& window, const Frames& f, int t, int b, int p) {
  if (t + 1 < f.warm_up) return states[((size_t)(t + 1) * f.batch + b) * N + p];
  return mirror(store[window.first + (u64)(t + 1) * N + p], window, f.sides);
}
__device__ __forceinline__ Body weight_of(const Body* weights, const Frames& f, u32 step, int t, int b, int material) {
  const int k = max(t - (f.warm_up - 1), 0);
  Body weight = weights[(size_t)step * f.weights_step + ((size_t)k * f.batch + b) * MATERIALS + material];
  if (t < f.warm_up - 1)
#pragma unroll
    for (int a = 0; a < DIM; a++) {
      weight.x[a] *= f.even;
      weight.v[a] *= f.even;
    }
  return weight;
}

// Predictions of frames from `first` on: sums of weighted squares, [T, B, gridDim.x], and the next frame's state where
// the network goes on from it. grid (ceil(N / 256), B, frames), block 256
extern "C" __global__ void __launch_bounds__(256) advance(Body* __restrict__ states, const float* __restrict__ output, const Body* __restrict__ store,
    const Window* __restrict__ windows, const Progress* __restrict__ progress, const unsigned char* __restrict__ material,
    const Body* __restrict__ weights, float* __restrict__ squares, Frames f, int first) {
  const int p = blockIdx.x * 256 + threadIdx.x, t = first + blockIdx.z, b = blockIdx.y;
  float sum = 0.0f;
  if (p < N) {
    const Window& window = windows[(size_t)progress->step * f.batch + b];
    const Body found = predict(states, output, f, t, b, p);
    if (t + 1 >= f.warm_up && t + 1 < f.warm_up + f.unroll - 1) states[((size_t)(t + 1) * f.batch + b) * N + p] = found;
    const Body truth = truth_of(states, store, window, f, t, b, p);
    const Body weight = weight_of(weights, f, progress->step, t, b, material[(size_t)window.stream * N + p]);
#pragma unroll
    for (int a = 0; a < DIM; a++) {
      const float dx = found.x[a] - truth.x[a], dv = found.v[a] - truth.v[a];
      sum += weight.x[a] * dx * dx + weight.v[a] * dv * dv;
    }
  }
  sum = block_sum(sum);
  if (threadIdx.x == 0) squares[((size_t)t * f.batch + b) * gridDim.x + blockIdx.x] = sum;
}

// Gradient by the output of frames from `first` on, in its place. `carried` [B, N] is the gradient by the state of frame
// t + 1, where the network went on from it; it leaves as the one by the state of frame t, but for the part through the
// network, where that was predicted as well. `density` is [unroll, B, N, DIM] or null.
// grid (ceil(N / 256), B, frames), block 256
extern "C" __global__ void __launch_bounds__(256) loss_gradient(const Body* __restrict__ states, float* __restrict__ output, const Body* __restrict__ store,
    const Window* __restrict__ windows, const Progress* __restrict__ progress, const unsigned char* __restrict__ material,
    const Body* __restrict__ weights, const float* __restrict__ scales, const float* __restrict__ density,
    Body* __restrict__ carried, Frames f, int first) {
  const int p = blockIdx.x * 256 + threadIdx.x, t = first + blockIdx.z, b = blockIdx.y;
  float* row = output + ((size_t)(t - f.decoded) * f.batch + b) * OP;
  if (p >= N) return;
  const Window& window = windows[(size_t)progress->step * f.batch + b];
  const Body before = states[((size_t)t * f.batch + b) * N + p], found = next_body(before, row + DIM * p, f.motion);
  const Body truth = truth_of(states, store, window, f, t, b, p);
  const Body weight = weight_of(weights, f, progress->step, t, b, material[(size_t)window.stream * N + p]);
  const bool free = t >= f.warm_up - 1, goes_on = free && t + 1 < f.warm_up + f.unroll - 1;
  const float scale = 2.0f * scales[(free ? 0 : f.batch) + b];
  Body& carry = carried[(size_t)b * N + p];
#pragma unroll
  for (int a = 0; a < DIM; a++) {
    float gx = scale * weight.x[a] * (found.x[a] - truth.x[a]), gv = scale * weight.v[a] * (found.v[a] - truth.v[a]);
    if (free && density) gx += density[(((size_t)(t - (f.warm_up - 1)) * f.batch + b) * N + p) * DIM + a];
    if (goes_on) {
      gx += carry.x[a];
      gv += carry.v[a];
    }
    row[DIM * p + a] = gradient_of_next(before, gx, gv, f.motion, a);
    if (t >= f.warm_up) {
      carry.x[a] = gx;
      carry.v[a] = gv;
    }
  }
}

// Density maps: each particle is spread linearly over the 2^DIM nearest of `nodes` nodes an axis (outermost nodes on
// the walls); the map of a predicted frame minus the true frame's. Sums are of integers, so that their order does not
// matter. densities [unroll, B]: sums of squares, in units of particles spread evenly; `gradient` [unroll, B, N, DIM]
// by the positions, of `factor` times their sum. grid (unroll, B), block 256, dynamic shared memory: nodes^DIM * 8 bytes
struct Grid { float least[DIM]; float inverse_cell[DIM]; int nodes; };
#define FIXED_POINT 1073741824.0f

__device__ __forceinline__ int corner(const Grid& grid, int number, const int* cell) {
  int node = 0, stride = 1;
#pragma unroll
  for (int a = 0; a < DIM; a++) {
    const int up = (number >> a) & 1;
    node += (cell[a] + up) * stride;
    stride *= grid.nodes;
  }
  return node;
}
__device__ __forceinline__ void locate(const Grid& grid, const float* x, int* cell, float* share, bool* inside) {
#pragma unroll
  for (int a = 0; a < DIM; a++) {
    const float along = (x[a] - grid.least[a]) * grid.inverse_cell[a], most = (float)(grid.nodes - 1);
    const float held = fminf(fmaxf(along, 0.0f), most);
    inside[a] = held == along;
    cell[a] = min((int)held, grid.nodes - 2);
    share[a] = held - (float)cell[a];
  }
}
extern "C" __global__ void __launch_bounds__(256) density(const Body* __restrict__ states, const float* __restrict__ output, const Body* __restrict__ store,
    const Window* __restrict__ windows, const Progress* __restrict__ progress, float* __restrict__ densities,
    float* __restrict__ gradient, Frames f, Grid grid, float factor) {
  DYNAMIC_SHARED(long long, map);
  const int k = blockIdx.x, t = k + f.warm_up - 1, b = blockIdx.y;
  const Window& window = windows[(size_t)progress->step * f.batch + b];
  int nodes = 1;
#pragma unroll
  for (int a = 0; a < DIM; a++) nodes *= grid.nodes;
  const float even = (float)N / nodes, to_units = 1.0f / (FIXED_POINT * even);
  for (int i = threadIdx.x; i < nodes; i += 256) map[i] = 0;
  __syncthreads();
  for (int p = threadIdx.x; p < N; p += 256)
    for (int side = 0; side < 2; side++) {
      const Body body = side ? mirror(store[window.first + (u64)(t + 1) * N + p], window, f.sides) : predict(states, output, f, t, b, p);
      int cell[DIM];
      float share[DIM];
      bool inside[DIM];
      locate(grid, body.x, cell, share, inside);
      for (int number = 0; number < 1 << DIM; number++) {
        float part = side ? -FIXED_POINT : FIXED_POINT;
#pragma unroll
        for (int a = 0; a < DIM; a++) part *= (number >> a) & 1 ? share[a] : 1.0f - share[a];
        atomicAdd((u64*)&map[corner(grid, number, cell)], (u64)(long long)part);
      }
    }
  __syncthreads();
  float sum = 0.0f;
  for (int i = threadIdx.x; i < nodes; i += 256) {
    const float difference = (float)map[i] * to_units;
    sum += difference * difference;
  }
  sum = block_sum(sum);
  if (threadIdx.x == 0) densities[(size_t)k * f.batch + b] = sum;
  for (int p = threadIdx.x; p < N; p += 256) {
    const Body body = predict(states, output, f, t, b, p);
    int cell[DIM];
    float share[DIM], slope[DIM];
    bool inside[DIM];
    locate(grid, body.x, cell, share, inside);
#pragma unroll
    for (int a = 0; a < DIM; a++) slope[a] = 0.0f;
    for (int number = 0; number < 1 << DIM; number++) {
      const float difference = (float)map[corner(grid, number, cell)] * to_units;
#pragma unroll
      for (int a = 0; a < DIM; a++) {
        float part = (number >> a) & 1 ? 1.0f : -1.0f;
#pragma unroll
        for (int other = 0; other < DIM; other++)
          if (other != a) part *= (number >> other) & 1 ? share[other] : 1.0f - share[other];
        slope[a] += part * difference;
      }
    }
#pragma unroll
    for (int a = 0; a < DIM; a++)
      gradient[(((size_t)k * f.batch + b) * N + p) * DIM + a] = inside[a] ? 2.0f * factor / even * slope[a] * grid.inverse_cell[a] : 0.0f;
  }
}
