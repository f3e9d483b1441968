// Bodies: groups of particles whose nodes are connected. The body of a node is the smallest node connected
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
extern "C" __global__ void __launch_bounds__(256) bodies_join(const Stream* __restrict__ streams, const float* __restrict__ constants, int rule, int step) {
  const Stream& s = streams[blockIdx.y];
  for (u32 node = first_thread(); node < s.totals[0]; node += all_threads()) {
    const u32 entry = s.lists[0][node];
    const u32 before[4] = {entry - 1, entry - s.across[0] - 1, entry - s.across[0], entry - s.across[0] + 1};
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
enum Quantity { COUNT, X, V = X + 2, NEXT_X = V + 2, NEXT_V = NEXT_X + 2, SQUARE = NEXT_V + 2, NEXT_SQUARE, TURN_XV, TURN_XX, TURN_NEXT, STRETCH, OBSERVED_V, QUANTITIES = OBSERVED_V + 2 };
struct BodySums {
  u64 sums[QUANTITIES][2];
  u64 fastest;          // bits of the largest mean squared speed of a cell
  u32 lower[2], upper[2]; // in the order of integers
  u32 invalid, unused;
};
static_assert(sizeof(BodySums) == 4 * BODY_NUMBERS, "DEVICE_NUMBERS of mod.rs");
__device__ __forceinline__ BodySums& sums_of(const Stream& s, u32 number) { return ((BodySums*)s.body_sums)[number]; }
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
extern "C" __global__ void __launch_bounds__(256) bodies_number(const Stream* __restrict__ streams, const float* __restrict__ constants, int rule, int step) {
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
    BodySums& body = sums_of(s, number);
    for (int i = 0; i < QUANTITIES; i++) body.sums[i][0] = body.sums[i][1] = 0;
    body.fastest = 0;
    body.invalid = 0;
    for (int a = 0; a < 2; a++) {
      body.lower[a] = 0xffffffffu;
      body.upper[a] = 0;
    }
  }
}
__device__ __forceinline__ BodySums& body_of(const Stream& s, u32 cell) { return sums_of(s, s.numbers[s.parents[s.maps[0][cell]]]); }

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
extern "C" __global__ void __launch_bounds__(128) bodies_sum(const Stream* __restrict__ streams, const float* __restrict__ constants, int rule, int step) {
  const Stream& s = streams[blockIdx.y];
  const u32 cells = s.across[0] * s.across[1];
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
      if (filled && !valid) sums_of(s, number).invalid = 1;
      const double whole = valid ? floor(sums[i]) : 0.0;
      u64 parts[2] = {(u64)(long long)whole, valid ? (u64)((sums[i] - whole) * FRACTION_UNIT) : 0};
      for (int k = 0; k < 2; k++) {
        if (together) parts[k] = warp_sum(parts[k]);
        if (adds) atomicAdd(&sums_of(s, to).sums[i][k], parts[k]);
      }
    }
    for (int a = 0; a < 2; a++) {
      u32 low = filled ? ordered(lower[a]) : 0xffffffffu, high = filled ? ordered(upper[a]) : 0;
      if (together) {
        low = warp_least(low);
        high = warp_largest(high);
      }
      if (adds) {
        atomicMin(&sums_of(s, to).lower[a], low);
        atomicMax(&sums_of(s, to).upper[a], high);
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

