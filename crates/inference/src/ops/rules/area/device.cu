// Area: as `mod.rs`, with the grid that the table of streams has for it. The fill is summed in units of 2^-40, so that the sums are
// exact and have the same bits in any order.
#define FILL_UNIT 1099511627776.0
#define LIQUID 0
// Place in the area's grid (cells).
__device__ __forceinline__ float area_place(const Stream& s, const AreaConstants& rules, float x, int axis) {
  const float cells = (x - s.lower[axis]) / rules.width;
  return fminf(fmaxf(cells, 0.0f), (float)(s.area_extent[axis] - 2 * AREA_MARGIN)) + (float)AREA_MARGIN;
}
// grid (ceil(n / 256), B), block 256
extern "C" __global__ void __launch_bounds__(256) area_fill(const Stream* __restrict__ streams, const float* __restrict__ constants, int rule, int step) {
  const Stream& s = streams[blockIdx.y];
  const AreaConstants rules = *(const AreaConstants*)constants;
  for (u32 p = first_thread(); p < s.particles; p += all_threads()) {
    float weights[2][3];
    u32 first[2];
#pragma unroll
    for (int a = 0; a < 2; a++) {
      const float place = area_place(s, rules, s.next[p].x[a], a), base = floorf(place - 0.5f);
      first[a] = (u32)base;
      spline_weights(place - base, weights[a]);
    }
    const bool wet = s.material[p] == LIQUID;
#pragma unroll
    for (int j = 0; j < 3; j++)
#pragma unroll
      for (int i = 0; i < 3; i++) {
        u64* fill = s.fill + 2 * ((size_t)(first[1] + j) * s.area_extent[0] + first[0] + i);
        const u64 mass = (u64)((double)(rules.share * weights[1][j] * weights[0][i]) * FILL_UNIT);
        atomicAdd(fill, mass);
        if (wet) atomicAdd(fill + 1, mass);
      }
  }
}
__device__ __forceinline__ float spline_tail(float x) {
  const float t = fmaxf(1.5f - x, 0.0f);
  return t * t * t / 6.0f;
}
__device__ __forceinline__ float spline_until(float x) {
  return x > 0.5f ? 1.0f - spline_tail(x) : (x < -0.5f ? spline_tail(-x) : 0.5f + 0.75f * x - x * x * x / 3.0f);
}
// The excess of a node and 1 / its neighbours between the walls; clears the fill.
__device__ __forceinline__ float2 area_excess(const Stream& s, const AreaConstants& rules, u32 node) {
  const int at[2] = {(int)(node % s.area_extent[0]), (int)(node / s.area_extent[0])};
  const float found = (float)((double)s.fill[2 * (size_t)node] * (1.0 / FILL_UNIT)), liquid = (float)((double)s.fill[2 * (size_t)node + 1] * (1.0 / FILL_UNIT));
  if (found > 0.0f) s.fill[2 * (size_t)node] = s.fill[2 * (size_t)node + 1] = 0;
  float2 result = {0.0f, 0.0f};
  float open = 1.0f;
  int neighbours = 0;
#pragma unroll
  for (int a = 0; a < 2; a++) {
    if (at[a] < s.area_inside[a][0] || at[a] >= s.area_inside[a][1]) return result;
    neighbours += (at[a] > s.area_inside[a][0] ? 1 : 0) + (at[a] + 1 < s.area_inside[a][1] ? 1 : 0);
    open *= spline_until(s.area_walls[a][1] + rules.beyond - (float)at[a]) - spline_until(s.area_walls[a][0] - rules.beyond - (float)at[a]);
  }
  const float fill = found / open;
  if (!(found > 0.0f) || fill < rules.surface_fill || neighbours == 0) return result;
  result.y = 1.0f / (float)neighbours;
  if (fill > rules.fill_limit) result.x = rules.rate * (fill - rules.fill_limit) * liquid / found;
  return result;
}
// A node's pressure after a sweep, from its own, its neighbours' and its excess.
__device__ __forceinline__ float relaxed(float here, float left, float right, float below, float above, float2 node, float factor) {
  const float sum = left + right + below + above + node.x;
  const float moved = here + factor * (sum * node.y - here);
  return moved > 0.0f ? moved : 0.0f;
}
// The pressure where each stream's nodes fit into shared memory: a block has a stream. grid (1, B), block 512,
// shared memory: 3 numbers a node
extern "C" __global__ void __launch_bounds__(512) area_solve(const Stream* __restrict__ streams, const float* __restrict__ constants, int rule, int step) {
  DYNAMIC_SHARED(float, pressure);
  const Stream& s = streams[blockIdx.y];
  const AreaConstants rules = *(const AreaConstants*)constants;
  const u32 across = s.area_extent[0], total = across * s.area_extent[1];
  float2* nodes = (float2*)(pressure + (total + 1) / 2 * 2);
  __shared__ u32 acts;
  if (threadIdx.x == 0) acts = 0;
  __syncthreads();
  for (u32 node = threadIdx.x; node < total; node += 512) {
    const float2 excess = area_excess(s, rules, node);
    nodes[node] = excess;
    pressure[node] = 0.0f;
    if (excess.x > 0.0f) acts = 1;
  }
  __syncthreads();
  if (acts) {
    const u32 left = s.area_inside[0][0], wide = s.area_inside[0][1] - left, low = s.area_inside[1][0], high = s.area_inside[1][1] - low;
    const u32 half = (wide + 1) / 2;
    for (int sweep = 0; sweep < 2 * (int)rules.sweeps; sweep++) {
      for (u32 i = threadIdx.x; i < half * high; i += 512) {
        const u32 j = low + i / half, odd = (left + j + (sweep & 1)) & 1, column = left + 2 * (i % half) + odd;
        if (column >= left + wide) continue;
        const u32 at = j * across + column;
        const float2 own = nodes[at];
        if (own.y > 0.0f) pressure[at] = relaxed(pressure[at], pressure[at - 1], pressure[at + 1], pressure[at - across], pressure[at + across], own, rules.relaxation);
      }
      __syncthreads();
    }
  }
  for (u32 node = threadIdx.x; node < total; node += 512) s.pressure[node] = pressure[node];
}
// The same in the memory of the device; a sweep is for the nodes of colour `step`. grid (.., B), block 256
extern "C" __global__ void __launch_bounds__(256) area_mark(const Stream* __restrict__ streams, const float* __restrict__ constants, int rule, int step) {
  const Stream& s = streams[blockIdx.y];
  const AreaConstants rules = *(const AreaConstants*)constants;
  for (u32 node = first_thread(); node < s.area_extent[0] * s.area_extent[1]; node += all_threads()) {
    ((float2*)s.excess)[node] = area_excess(s, rules, node);
    s.pressure[node] = 0.0f;
  }
}
extern "C" __global__ void __launch_bounds__(256) area_sweep(const Stream* __restrict__ streams, const float* __restrict__ constants, int rule, int step) {
  const Stream& s = streams[blockIdx.y];
  const float factor = ((const AreaConstants*)constants)->relaxation;
  const u32 across = s.area_extent[0], left = s.area_inside[0][0], wide = s.area_inside[0][1] - left, low = s.area_inside[1][0];
  const u32 half = (wide + 1) / 2, total = half * (s.area_inside[1][1] - low);
  float* pressure = s.pressure;
  for (u32 i = first_thread(); i < total; i += all_threads()) {
    const u32 j = low + i / half, odd = (left + j + step) & 1, column = left + 2 * (i % half) + odd;
    if (column >= left + wide) continue;
    const size_t at = (size_t)j * across + column;
    const float2 own = ((const float2*)s.excess)[at];
    if (own.y > 0.0f) pressure[at] = relaxed(pressure[at], pressure[at - 1], pressure[at + 1], pressure[at - across], pressure[at + across], own, factor);
  }
}
// Liquid particles move down the gradient of the pressure. Beyond walls it is that at the wall. grid (ceil(n / 256), B), block 256
extern "C" __global__ void __launch_bounds__(256) area_shift(const Stream* __restrict__ streams, const float* __restrict__ constants, int rule, int step) {
  const Stream& s = streams[blockIdx.y];
  const AreaConstants rules = *(const AreaConstants*)constants;
  if (s.area_inside[0][0] >= s.area_inside[0][1] || s.area_inside[1][0] >= s.area_inside[1][1]) return;
  for (u32 p = first_thread(); p < s.particles; p += all_threads()) {
    if (s.material[p] != LIQUID) continue;
    Body body = s.next[p];
    float weights[2][3], slopes[2][3];
    int first[2];
#pragma unroll
    for (int a = 0; a < 2; a++) {
      const float place = area_place(s, rules, body.x[a], a), base = floorf(place - 0.5f), x = place - base;
      first[a] = (int)base;
      spline_weights(x, weights[a]);
      slopes[a][0] = x - 1.5f;
      slopes[a][1] = 2.0f - 2.0f * x;
      slopes[a][2] = x - 0.5f;
    }
    float slope[2] = {0.0f, 0.0f};
#pragma unroll
    for (int j = 0; j < 3; j++) {
      const int row = min(max(first[1] + j, s.area_inside[1][0]), s.area_inside[1][1] - 1);
      float sums[2] = {0.0f, 0.0f};
#pragma unroll
      for (int i = 0; i < 3; i++) {
        const int column = min(max(first[0] + i, s.area_inside[0][0]), s.area_inside[0][1] - 1);
        const float pressure = s.pressure[(size_t)row * s.area_extent[0] + column];
        sums[0] += slopes[0][i] * pressure;
        sums[1] += weights[0][i] * pressure;
      }
      slope[0] += weights[1][j] * sums[0];
      slope[1] += slopes[1][j] * sums[1];
    }
#pragma unroll
    for (int a = 0; a < 2; a++) {
      const float way = fminf(fmaxf(-slope[a], -rules.longest_shift), rules.longest_shift) * rules.width;
      const float shifted = clamp_axis(s, a, body.x[a] + way);
      body.v[a] += (shifted - body.x[a]) / s.dt;
      body.x[a] = shifted;
    }
    s.next[p] = body;
  }
}
