// The rules after the network's predictions (`engine/rules` of eddy-inference). Sums over particles that are not in the order of
// cells are of integers, so that their order does not matter.

#ifdef EMULATED
static u32 float_bits(float v) { u32 bits; std::memcpy(&bits, &v, 4); return bits; }
static float bits_float(u32 bits) { float v; std::memcpy(&v, &bits, 4); return v; }
static u64 double_bits(double v) { u64 bits; std::memcpy(&bits, &v, 8); return bits; }
static double bits_double(u64 bits) { double v; std::memcpy(&v, &bits, 8); return v; }
#else
#define float_bits __float_as_uint
#define bits_float __uint_as_float
#define double_bits(v) ((u64)__double_as_longlong(v))
#define bits_double(v) __longlong_as_double((long long)(v))
#endif

// Constants of the rules in a checkpoint; `checkpoint/rules.rs` of eddy-inference says what they are.
struct Rules {
  float area_width, fill_limit, surface_fill, relaxation, longest_shift, rate, share, beyond; // share: area of a particle in a cell
  float strain_limit;
  float flight_distance, rest_distance; // domain lengths; negative where the rule is off
  float asleep_below, awake_from;
  float gain;                           // speed gained in a frame of free fall
  u32 unused[2];
};

__device__ __forceinline__ float clamp_axis(const Stream& s, int axis, float x) {
  const float raised = x < s.wall_lower[axis] ? s.wall_lower[axis] : x;
  return raised > s.wall_upper[axis] ? s.wall_upper[axis] : raised;
}

// Area (`rules/area.rs`). The fill is summed in units of 2^-40, so that the sums are exact and have the same bits in any order.
#define FILL_UNIT 1099511627776.0
#define MARGIN 2
#define LIQUID 0
// Place in the area's grid (cells).
__device__ __forceinline__ float area_place(const Stream& s, const Rules& rules, float x, int axis) {
  const float cells = (x - s.lower[axis]) / rules.area_width;
  return fminf(fmaxf(cells, 0.0f), (float)(s.area_extent[axis] - 2 * MARGIN)) + (float)MARGIN;
}
// grid (ceil(n / 256), B), block 256
extern "C" __global__ void __launch_bounds__(256) particle_area_fill(const Stream* __restrict__ streams, const Rules* __restrict__ constants) {
  const Stream& s = streams[blockIdx.y];
  const Rules rules = *constants;
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
__device__ __forceinline__ float2 area_excess(const Stream& s, const Rules& rules, u32 node) {
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
// The pressure where each stream's nodes fit into shared memory: a block has a stream. grid B, block 512,
// shared memory: 3 numbers a node
extern "C" __global__ void __launch_bounds__(512) particle_area_solve(const Stream* __restrict__ streams, const Rules* __restrict__ constants, int sweeps) {
  DYNAMIC_SHARED(float, pressure);
  const Stream& s = streams[blockIdx.x];
  const Rules rules = *constants;
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
    for (int sweep = 0; sweep < 2 * sweeps; sweep++) {
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
// The same in the memory of the device. grid (.., B), block 256
extern "C" __global__ void __launch_bounds__(256) particle_area_mark(const Stream* __restrict__ streams, const Rules* __restrict__ constants) {
  const Stream& s = streams[blockIdx.y];
  const Rules rules = *constants;
  for (u32 node = first_thread(); node < s.area_extent[0] * s.area_extent[1]; node += all_threads()) {
    ((float2*)s.excess)[node] = area_excess(s, rules, node);
    s.pressure[node] = 0.0f;
  }
}
extern "C" __global__ void __launch_bounds__(256) particle_area_sweep(const Stream* __restrict__ streams, const Rules* __restrict__ constants, int colour) {
  const Stream& s = streams[blockIdx.y];
  const float factor = constants->relaxation;
  const u32 across = s.area_extent[0], left = s.area_inside[0][0], wide = s.area_inside[0][1] - left, low = s.area_inside[1][0];
  const u32 half = (wide + 1) / 2, total = half * (s.area_inside[1][1] - low);
  float* pressure = s.pressure;
  for (u32 i = first_thread(); i < total; i += all_threads()) {
    const u32 j = low + i / half, odd = (left + j + colour) & 1, column = left + 2 * (i % half) + odd;
    if (column >= left + wide) continue;
    const size_t at = (size_t)j * across + column;
    const float2 own = ((const float2*)s.excess)[at];
    if (own.y > 0.0f) pressure[at] = relaxed(pressure[at], pressure[at - 1], pressure[at + 1], pressure[at - across], pressure[at + across], own, factor);
  }
}
// Liquid particles move down the gradient of the pressure. Beyond walls it is that at the wall. grid (ceil(n / 256), B), block 256
extern "C" __global__ void __launch_bounds__(256) particle_area_shift(const Stream* __restrict__ streams, const Rules* __restrict__ constants) {
  const Stream& s = streams[blockIdx.y];
  const Rules rules = *constants;
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
      const float way = fminf(fmaxf(-slope[a], -rules.longest_shift), rules.longest_shift) * rules.area_width;
      const float shifted = clamp_axis(s, a, body.x[a] + way);
      body.v[a] += (shifted - body.x[a]) / s.dt;
      body.x[a] = shifted;
    }
    s.next[p] = body;
  }
}

// Shape (`rules/shape.rs`): the deformation of each particle with limited stretches. grid (ceil(n / 256), B), block 256
extern "C" __global__ void __launch_bounds__(256) particle_shape_limit(const Stream* __restrict__ streams, const Rules* __restrict__ constants) {
  const Stream& s = streams[blockIdx.y];
  const float strain = constants->strain_limit;
  if (!s.first) return;
  for (u32 p = first_thread(); p < s.particles; p += all_threads()) {
    const Body body = s.next[p];
    const u32 begin = s.first[p], end = s.first[p + 1];
    // Particles without a rest shape keep their position in both lists.
#pragma unroll
    for (int a = 0; a < 2; a++) s.shapes[0][2 * p + a] = s.shapes[1][2 * p + a] = body.x[a];
    float4 result = {1.0f, 0.0f, 0.0f, 1.0f};
    if (begin < end) {
      float f[2][2] = {{0.0f, 0.0f}, {0.0f, 0.0f}};
#pragma unroll 4
      for (u32 i = begin; i < end; i++) {
        const Link link = s.links[i];
        const Body other = s.next[link.particle];
#pragma unroll
        for (int a = 0; a < 2; a++) {
          const float apart = other.x[a] - body.x[a];
          f[a][0] = fmaf(apart, link.coefficient[0], f[a][0]);
          f[a][1] = fmaf(apart, link.coefficient[1], f[a][1]);
        }
      }
      // Scaled rotation and scaled reflection: the singular values are the sum and the difference of the scales.
      const float u = 0.5f * (f[0][0] + f[1][1]), w = 0.5f * (f[1][0] - f[0][1]), r = 0.5f * (f[0][0] - f[1][1]), t = 0.5f * (f[1][0] + f[0][1]);
      const float rotation = sqrtf(u * u + w * w), reflection = sqrtf(r * r + t * t), low = 1.0f - strain, high = 1.0f + strain;
      const float sum = rotation + reflection, difference = rotation - reflection;
      const float most = sum < low ? low : (sum > high ? high : sum), least = difference < low ? low : (difference > high ? high : difference);
      const float turn = 0.5f * (most + least) / fmaxf(rotation, 1.17549435e-38f), flip = 0.5f * (most - least) / fmaxf(reflection, 1.17549435e-38f);
      result = {u * turn + r * flip, t * flip - w * turn, t * flip + w * turn, u * turn - r * flip};
    }
    ((float4*)s.limited)[p] = result;
  }
}
// A sweep: each particle moves to its neighbours' mean and the offset that the rest shape implies, which the first sweep
// computes. The last one writes the prediction. grid and block as above
extern "C" __global__ void __launch_bounds__(256) particle_shape_relax(const Stream* __restrict__ streams, int sweep, int last) {
  const Stream& s = streams[blockIdx.y];
  if (!s.first) return;
  const float* from = s.shapes[sweep & 1];
  float* to = s.shapes[(sweep & 1) ^ 1];
  for (u32 p = first_thread(); p < s.particles; p += all_threads()) {
    const u32 begin = s.first[p], end = s.first[p + 1];
    if (begin == end) continue;
    float offset[2] = {0.0f, 0.0f};
    if (sweep == 0) {
      const float4 own = ((const float4*)s.limited)[p];
#pragma unroll 4
      for (u32 i = begin; i < end; i++) {
        const Neighbour near = s.neighbours[i];
        const float4 theirs = ((const float4*)s.limited)[near.particle];
        offset[0] -= 0.5f * near.share * ((own.x + theirs.x) * near.offset[0] + (own.y + theirs.y) * near.offset[1]);
        offset[1] -= 0.5f * near.share * ((own.z + theirs.z) * near.offset[0] + (own.w + theirs.w) * near.offset[1]);
      }
#pragma unroll
      for (int a = 0; a < 2; a++) s.offsets[2 * p + a] = offset[a];
    }
    float place[2] = {s.offsets[2 * p], s.offsets[2 * p + 1]};
#pragma unroll 4
    for (u32 i = begin; i < end; i++) {
      const Neighbour near = s.neighbours[i];
#pragma unroll
      for (int a = 0; a < 2; a++) place[a] = fmaf(near.share, from[2 * near.particle + a], place[a]);
    }
    Body body = s.next[p];
#pragma unroll
    for (int a = 0; a < 2; a++) {
      place[a] = clamp_axis(s, a, place[a]);
      to[2 * p + a] = place[a];
      body.v[a] += (place[a] - body.x[a]) / s.dt;
      body.x[a] = place[a];
    }
    if (last) s.next[p] = body;
  }
}

// Bodies (`rules/bodies.rs`): groups of particles whose nodes are connected. The body of a node is the smallest node connected
// with it; trees of nodes are joined until there is one for each body (Playne and Hawick 2018). On the way to a root, each node
// is moved to the parent of its parent, which keeps the ways short (Jaiganesh and Burtscher 2018).
__device__ __forceinline__ u32 root_of(volatile u32* parents, u32 node) {
  for (u32 parent = parents[node]; parent != node;) {
    const u32 above = parents[parent];
    if (above != parent) parents[node] = above;
    node = parent;
    parent = above;
  }
  return node;
}
// grid (.., B), block 256
extern "C" __global__ void __launch_bounds__(256) particle_bodies_join(const Stream* __restrict__ streams) {
  const Stream& s = streams[blockIdx.y];
  for (u32 node = first_thread(); node < s.totals[0]; node += all_threads()) {
    const u32 entry = s.lists[0][node];
    const u32 before[4] = {entry - 1, entry - s.across - 1, entry - s.across, entry - s.across + 1};
#pragma unroll
    for (int i = 0; i < 4; i++) {
      u32 other = s.maps[0][before[i]], own = node;
      if (other == MISSING) continue;
      for (;;) {
        own = root_of(s.parents, own);
        other = root_of(s.parents, other);
        if (own == other) break;
        const u32 larger = max(own, other), smaller = min(own, other), found = atomicMin(s.parents + larger, smaller);
        if (found == larger) break;
        own = found;
        other = smaller;
      }
    }
  }
}

// Sums over the particles of a body. A number is the sum of whole parts and of fractions in units of 2^-32: as integers, the
// sums of cells give the same bits in any order.
#define QUANTITIES 17
enum Quantity { COUNT, X, V = X + 2, NEXT_X = V + 2, NEXT_V = NEXT_X + 2, SQUARE = NEXT_V + 2, NEXT_SQUARE, TURN_XV, TURN_XX, TURN_NEXT, STRETCH, OBSERVED_V, LAST = OBSERVED_V + 1 };
static_assert(LAST + 1 == QUANTITIES, "a place for each quantity");
struct BodySums {
  u64 sums[QUANTITIES][2];
  u64 fastest;          // bits of the largest mean squared speed of a cell
  u32 lower[2], upper[2]; // in the order of integers
  u32 invalid, unused;
};
#define FRACTION_UNIT 4294967296.0
#define LARGEST_SUM 1e9
__device__ __forceinline__ u32 ordered(float v) {
  const u32 bits = float_bits(v);
  return bits >> 31 ? ~bits : bits | 0x80000000u;
}
__device__ __forceinline__ float unordered(u32 key) { return bits_float(key >> 31 ? key & 0x7fffffffu : ~key); }
__device__ __forceinline__ double sum_of(const BodySums& body, int quantity) {
  return (double)(long long)body.sums[quantity][0] + (double)body.sums[quantity][1] * (1.0 / FRACTION_UNIT);
}
// The tree of each node becomes flat; bodies get a place for their sums, in any order. grid and block as above
extern "C" __global__ void __launch_bounds__(256) particle_bodies_number(const Stream* __restrict__ streams) {
  const Stream& s = streams[blockIdx.y];
  for (u32 node = first_thread(); node < s.totals[0]; node += all_threads()) {
    // Each thread writes the parent of its own node only: `root_of` also moves the nodes on its way, and one moved with an old parent in
    // hand after its own thread had found the root would lie below the root again.
    const volatile u32* parents = s.parents;
    u32 root = parents[node];
    for (u32 above = parents[root]; above != root; above = parents[root]) root = above;
    s.parents[node] = root;
    if (root != node) continue;
    const u32 number = atomicAdd(s.totals + LEVELS, 1u);
    s.numbers[node] = number;
    BodySums& body = s.sums[number];
    for (int i = 0; i < QUANTITIES; i++) body.sums[i][0] = body.sums[i][1] = 0;
    body.fastest = 0;
    body.invalid = 0;
    for (int a = 0; a < 2; a++) {
      body.lower[a] = 0xffffffffu;
      body.upper[a] = 0;
    }
  }
}
__device__ __forceinline__ BodySums& body_of(const Stream& s, u32 cell) { return s.sums[s.numbers[s.parents[s.maps[0][cell]]]]; }

// Free fall without walls (`Ballistic::free`).
__device__ __forceinline__ Body free_fall(const Stream& s, const Body& body) {
  Body free;
#pragma unroll
  for (int a = 0; a < 2; a++) {
    free.v[a] = body.v[a] + s.fall[a];
    free.x[a] = body.x[a] + multiply_rounded(multiply_rounded(0.5f, body.v[a] + free.v[a]), s.dt);
  }
  return free;
}
#define DOT(a, b) ((double)(a)[0] * (double)(b)[0] + (double)(a)[1] * (double)(b)[1])
#define CROSS(a, b) ((double)(a)[0] * (double)(b)[1] - (double)(a)[1] * (double)(b)[0])

// Over the threads of a warp; each has it.
__device__ __forceinline__ u64 warp_sum(u64 v) {
#pragma unroll
  for (int m = 16; m; m /= 2) v += shuffle_xor(v, m);
  return v;
}
__device__ __forceinline__ u32 warp_least(u32 v) {
#pragma unroll
  for (int m = 16; m; m /= 2) v = min(v, shuffle_xor(v, m));
  return v;
}
__device__ __forceinline__ u32 warp_largest(u32 v) { return ~warp_least(~v); }

// Sums over each cell, then over the cells of each body. A thread has a cell. The cells of a warp are mostly of one body: they are added
// up first, since additions to the same number wait for each other. grid (.., B), block 128
extern "C" __global__ void __launch_bounds__(128) particle_bodies_sum(const Stream* __restrict__ streams) {
  const Stream& s = streams[blockIdx.y];
  const u32 cells = s.across * s.down;
  for (u32 first = blockIdx.x * blockDim.x; first < cells; first += all_threads()) {
    const u32 cell = first + threadIdx.x, begin = cell < cells ? s.starts[cell] : 0, end = cell < cells ? s.starts[cell + 1] : 0;
    double sums[QUANTITIES];
    float lower[2], upper[2];
    for (int i = 0; i < QUANTITIES; i++) sums[i] = 0.0;
    for (u32 slot = begin; slot < end; slot++) {
      const u32 p = s.order[slot];
      const Body seen = s.bodies[p], free = free_fall(s, seen), next = s.next[p];
#pragma unroll
      for (int a = 0; a < 2; a++) {
        lower[a] = slot == begin ? seen.x[a] : fminf(lower[a], seen.x[a]);
        upper[a] = slot == begin ? seen.x[a] : fmaxf(upper[a], seen.x[a]);
        sums[X + a] += free.x[a];
        sums[V + a] += free.v[a];
        sums[NEXT_X + a] += next.x[a];
        sums[NEXT_V + a] += next.v[a];
        sums[OBSERVED_V + a] += seen.v[a];
      }
      sums[COUNT] += 1.0;
      sums[SQUARE] += DOT(free.x, free.x);
      sums[NEXT_SQUARE] += DOT(next.x, next.x);
      sums[TURN_XV] += CROSS(free.x, free.v);
      sums[TURN_XX] += CROSS(free.x, next.x);
      sums[TURN_NEXT] += CROSS(next.x, next.v);
      sums[STRETCH] += DOT(free.x, next.v);
    }
    const bool filled = begin < end;
    const u32 number = filled ? s.numbers[s.parents[s.maps[0][cell]]] : MISSING, least = warp_least(number);
    const bool together = least == warp_largest(filled ? number : 0), adds = together ? threadIdx.x % 32 == 0 : filled;
    const u32 to = together ? least : number;
    for (int i = 0; i < QUANTITIES; i++) {
      // Written so that NaN is invalid.
      const bool valid = fabs(sums[i]) < LARGEST_SUM;
      if (filled && !valid) s.sums[number].invalid = 1;
      const double whole = valid ? floor(sums[i]) : 0.0;
      u64 parts[2] = {(u64)(long long)whole, valid ? (u64)((sums[i] - whole) * FRACTION_UNIT) : 0};
      for (int k = 0; k < 2; k++) {
        if (together) parts[k] = warp_sum(parts[k]);
        if (adds) atomicAdd(&s.sums[to].sums[i][k], parts[k]);
      }
    }
    for (int a = 0; a < 2; a++) {
      u32 low = filled ? ordered(lower[a]) : 0xffffffffu, high = filled ? ordered(upper[a]) : 0;
      if (together) {
        low = warp_least(low);
        high = warp_largest(high);
      }
      if (adds) {
        atomicMin(&s.sums[to].lower[a], low);
        atomicMax(&s.sums[to].upper[a], high);
      }
    }
  }
}

// Whether a body keeps a distance from walls, now and after a frame of free fall.
__device__ __forceinline__ bool is_clear(const Stream& s, const BodySums& body, float distance) {
  bool clear = true;
#pragma unroll
  for (int a = 0; a < 2; a++) {
    const float v = (float)(sum_of(body, OBSERVED_V + a) / fmax(sum_of(body, COUNT), 1.0));
    const float way = multiply_rounded(multiply_rounded(0.5f, v + (v + s.fall[a])), s.dt);
    clear = clear && unordered(body.lower[a]) + fminf(way, 0.0f) >= s.wall_lower[a] + distance &&
            unordered(body.upper[a]) + fmaxf(way, 0.0f) <= s.wall_upper[a] - distance;
  }
  return clear;
}
// By which rigid motion a body's prediction differs from free fall (`rules/flight.rs`).
struct RigidError { double centre[2], next_centre[2], velocity[2], angle, spin; };
#define POINT 1e-10
__device__ __forceinline__ bool rigid_error(const BodySums& body, RigidError& error) {
  const double count = fmax(sum_of(body, COUNT), 1.0);
  double v[2], speed[2];
  for (int a = 0; a < 2; a++) {
    error.centre[a] = sum_of(body, X + a) / count;
    error.next_centre[a] = sum_of(body, NEXT_X + a) / count;
    v[a] = sum_of(body, V + a) / count;
    speed[a] = sum_of(body, NEXT_V + a) / count;
    error.velocity[a] = speed[a] - v[a];
  }
  const double rr = sum_of(body, SQUARE) - count * DOT(error.centre, error.centre);
  const double pp = sum_of(body, NEXT_SQUARE) - count * DOT(error.next_centre, error.next_centre);
  const double rw = sum_of(body, TURN_XV) - count * CROSS(error.centre, v);
  const double rp = sum_of(body, TURN_XX) - count * CROSS(error.centre, error.next_centre);
  const double pq = sum_of(body, TURN_NEXT) - count * CROSS(error.next_centre, speed);
  const double rq = sum_of(body, STRETCH) - count * DOT(error.centre, speed);
  error.angle = rr > POINT * count ? rp / rr : 0.0;
  const double inertia = pp - error.angle * error.angle * rr;
  error.spin = inertia > POINT * count ? (pq + error.angle * rq - rw) / inertia : 0.0;
  return !body.invalid;
}
// Bodies in flight keep their momentum and angular momentum; then the speed of each cell for the last rule. A thread has a cell.
// grid (.., B), block 128
extern "C" __global__ void __launch_bounds__(128) particle_bodies_flight(const Stream* __restrict__ streams, const Rules* __restrict__ constants) {
  const Stream& s = streams[blockIdx.y];
  const Rules rules = *constants;
  for (u32 cell = first_thread(); cell < s.across * s.down; cell += all_threads()) {
    const u32 begin = s.starts[cell], end = s.starts[cell + 1];
    if (begin == end) continue;
    BodySums& body = body_of(s, cell);
    RigidError error;
    const bool flies = rules.flight_distance >= 0.0f && is_clear(s, body, rules.flight_distance) && rigid_error(body, error);
    double observed = 0.0, predicted = 0.0;
    for (u32 slot = begin; slot < end; slot++) {
      const u32 p = s.order[slot];
      const Body seen = s.bodies[p];
      Body next = s.next[p];
      if (flies) {
        const Body free = free_fall(s, seen);
        const double r[2] = {(double)free.x[0] - error.centre[0], (double)free.x[1] - error.centre[1]};
        const double arm[2] = {(double)next.x[0] - error.next_centre[0] + error.angle * r[1], (double)next.x[1] - error.next_centre[1] - error.angle * r[0]};
        const double turned[2] = {-arm[1], arm[0]};
#pragma unroll
        for (int a = 0; a < 2; a++) {
          next.x[a] = clamp_axis(s, a, (float)(error.centre[a] + arm[a]));
          next.v[a] = (float)((double)next.v[a] - error.velocity[a] - error.spin * turned[a]);
        }
        s.next[p] = next;
      }
      observed += (double)(seen.v[0] * seen.v[0] + seen.v[1] * seen.v[1]);
      predicted += (double)(next.v[0] * next.v[0] + next.v[1] * next.v[1]);
    }
    const double fastest = fmax(observed, predicted) / (double)(end - begin);
    if (fastest >= 0.0) atomicMax(&body.fastest, double_bits(fastest));
  }
}
// Bodies at walls that hardly move come to rest (`rules/rest.rs`). grid (ceil(n / 256), B), block 256
extern "C" __global__ void __launch_bounds__(256) particle_bodies_rest(const Stream* __restrict__ streams, const Rules* __restrict__ constants) {
  const Stream& s = streams[blockIdx.y];
  const Rules rules = *constants;
  for (u32 p = first_thread(); p < s.particles; p += all_threads()) {
    const BodySums& body = body_of(s, s.cells[p]);
    const float awake = ((float)sqrt(bits_double(body.fastest)) / rules.gain - rules.asleep_below) / (rules.awake_from - rules.asleep_below);
    const float share = awake < 0.0f ? 0.0f : awake;
    // Not finite without gravity.
    if (!(share < 1.0f) || !(fabsf(awake) <= 3.4e38f) || is_clear(s, body, rules.rest_distance)) continue;
    const Body seen = s.bodies[p];
    Body next = s.next[p];
#pragma unroll
    for (int a = 0; a < 2; a++) {
      next.x[a] = seen.x[a] + share * (next.x[a] - seen.x[a]);
      next.v[a] *= share;
    }
    s.next[p] = next;
  }
}
