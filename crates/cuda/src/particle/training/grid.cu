// Windows, and the grids of their frames.

// The observed frames, with noise on the last one. grid (ceil(most / 256), warm_up B), block 256
extern "C" __global__ void __launch_bounds__(256) train_observe(const Plan* __restrict__ plan, float positions, float velocities) {
  const Plan& s = *plan;
  const int sheet = blockIdx.y, t = sheet / s.batch, b = sheet % s.batch;
  const u32 p = blockIdx.x * 256 + threadIdx.x, n = particles_of(s, b);
  if (p >= n) return;
  const Window& window = window_of(s, b);
  Body body = mirror(s.store[window.first + (u64)t * n + p], window, s.sides);
  if (t + 1 == s.warm_up && window.disturbed) body = disturbed(body, window, (int)n, (int)p, positions, velocities);
  s.states[particle_row(s, sheet, p)] = body;
}

// Running sums of a list by a block, `each` numbers a thread; calls take(at, value, sum before it). Returns the sum of all.
#define CELL_THREADS 1024
template <class Take> __device__ __forceinline__ u32 running_sums(const u32* from, u32 size, u32 (*sums)[CELL_THREADS], Take take) {
  const u32 each = (size + CELL_THREADS - 1) / CELL_THREADS, begin = threadIdx.x * each, end = min(begin + each, size);
  u32 own = 0;
  for (u32 at = begin; at < end; at++) own += from[at];
  int side = 0;
  sums[0][threadIdx.x] = own;
  __syncthreads();
  for (u32 m = 1; m < CELL_THREADS; m *= 2) {
    sums[side ^ 1][threadIdx.x] = sums[side][threadIdx.x] + (threadIdx.x >= m ? sums[side][threadIdx.x - m] : 0u);
    side ^= 1;
    __syncthreads();
  }
  u32 running = sums[side][threadIdx.x] - own;
  const u32 total = sums[side][CELL_THREADS - 1];
  for (u32 at = begin; at < end; at++) {
    const u32 value = from[at];
    take(at, value, running);
    running += value;
  }
  __syncthreads();
  return total;
}

// The cells and nodes of sheets from `first` on (`kernels/nodes` of eddy-inference). grid (1, sheets), block CELL_THREADS
extern "C" __global__ void __launch_bounds__(CELL_THREADS) train_cells(const Plan* __restrict__ plan, int first) {
  __shared__ u32 sums[2][CELL_THREADS];
  const Plan& s = *plan;
  const int sheet = first + blockIdx.y;
  const u32 n = particles_of(s, sheet % s.batch), cells = s.entries[0];
  const Body* bodies = s.states + particle_row(s, sheet, 0);
  u32* counts = s.cell_counts + (size_t)blockIdx.y * cells;
  u32* starts = s.starts + (size_t)sheet * (cells + 1);
  u32* cell_of = s.cell_of + particle_row(s, blockIdx.y, 0);
  u32* arrivals = s.arrivals + particle_row(s, blockIdx.y, 0);
  u32* unsorted = s.unsorted + particle_row(s, blockIdx.y, 0);
  for (u32 at = threadIdx.x; at < cells; at += CELL_THREADS) counts[at] = 0;
  for (int level = 0; level < LEVELS; level++)
    for (u32 at = threadIdx.x; at < s.entries[level]; at += CELL_THREADS) s.maps[level][(size_t)sheet * s.entries[level] + at] = 0;
  __syncthreads();
  for (u32 p = threadIdx.x; p < n; p += CELL_THREADS) {
    const Body body = bodies[p];
    int base[DIM];
#pragma unroll
    for (int a = 0; a < DIM; a++) base[a] = (int)stencil(cell_place(s, body, a));
    const u32 cell = cell_entry(s, base);
    cell_of[p] = cell;
    arrivals[p] = atomicAdd(counts + cell, 1u);
    if (arrivals[p]) continue;
    for (int level = 0; level < LEVELS; level++)
      for (int place = 0; place < STENCIL; place++) {
        u32 entry = 0;
        for (int a = DIM - 1, rest = place; a >= 0; a--) {
          int digit = rest;
          for (int lower = 0; lower < a; lower++) digit /= 3;
          entry = entry * (s.across[a] >> level) + ((u32)(base[a] + ORIGIN + digit % 3) >> level);
        }
        s.maps[level][(size_t)sheet * s.entries[level] + entry] = 1u;
      }
  }
  __syncthreads();
  running_sums(counts, cells, sums, [=](u32 at, u32, u32 before) { starts[at] = before; });
  if (threadIdx.x == 0) starts[cells] = n;
  for (int level = 0; level < LEVELS; level++) {
    u32* map = s.maps[level] + (size_t)sheet * s.entries[level];
    u32* list = s.lists[level] + (size_t)sheet * s.nodes[level];
    const u32 total = running_sums(map, s.entries[level], sums, [=](u32 at, u32 value, u32 before) {
      if (value) list[before] = at;
      map[at] = value ? before : MISSING;
    });
    if (threadIdx.x == 0) s.totals[sheet * LEVELS + level] = total;
  }
  for (u32 p = threadIdx.x; p < n; p += CELL_THREADS) unsorted[starts[cell_of[p]] + arrivals[p]] = p;
  __syncthreads();
  for (int level = 0; level < LEVELS; level++) {
    const u32 *list = s.lists[level] + (size_t)sheet * s.nodes[level], *map = s.maps[level] + (size_t)sheet * s.entries[level];
    const u32 total = s.totals[sheet * LEVELS + level];
    u32* around = s.around[level] + (size_t)sheet * s.nodes[level] * STENCIL;
#pragma unroll 4
    for (u32 i = threadIdx.x; i < total * STENCIL; i += CELL_THREADS) around[i] = map[list[i / STENCIL] + neighbour_step(s, level, i % STENCIL)];
    if (!level) continue;
    const u32* finer = s.maps[level - 1] + (size_t)sheet * s.entries[level - 1];
    u32* children = s.children[level] + (size_t)sheet * s.nodes[level] * CHILDREN;
#pragma unroll 4
    for (u32 i = threadIdx.x; i < total * CHILDREN; i += CELL_THREADS) children[i] = finer[child_entry(s, level, list[i / CHILDREN], i % CHILDREN)];
  }
  // By their number: each counts those of its cell with a smaller one.
  for (u32 from = threadIdx.x; from < n; from += CELL_THREADS) {
    const u32 p = unsorted[from], begin = starts[cell_of[p]], end = starts[cell_of[p] + 1];
    u32 slot = begin;
    for (u32 other = begin; other < end; other++) slot += unsorted[other] < p ? 1u : 0u;
    s.order[particle_row(s, sheet, slot)] = p;
    const Body body = bodies[p];
#pragma unroll
    for (int a = 0; a < DIM; a++) {
      const float place = cell_place(s, body, a);
      spline_weights(place - stencil(place), s.weights + particle_row(s, sheet, slot) * (3 * DIM) + 3 * a);
    }
  }
}

// Sums over the particles around a node of a sheet, from rows of `stride` numbers in the order of particles: the quadruple `quad`, or, where
// it is negative, the mass alone.
#define SUM_SHARES 2
#define SUM_THREADS (SUM_SHARES * STENCIL_ROWS * WARP)
__device__ __forceinline__ NodeSum sum_of_sheet(const Plan& s, int sheet, u32 entry, const float* values, int stride, int quad) {
  const size_t begin = particle_row(s, sheet, 0);
  const u32 *starts = s.starts + (size_t)sheet * (s.entries[0] + 1), *order = s.order + begin;
  return sum_around<SUM_SHARES>(s, entry, starts, s.weights + begin * (3 * DIM),
      [=](u32 slot) { return quad < 0 ? nullptr : values + (size_t)order[slot] * stride + 4 * quad; });
}
// A node of a sheet in the map of level 0, or MISSING.
__device__ __forceinline__ u32 entry_of(const Plan& s, int sheet, u32 node) {
  return node < s.totals[sheet * LEVELS] ? s.lists[0][(size_t)sheet * s.nodes[0] + node] : MISSING;
}
// Whether a block with so many items a node has none.
__device__ __forceinline__ bool is_beyond(const Plan& s, int sheet, u32 items) { return blockIdx.x * WARP / items >= s.totals[sheet * LEVELS]; }

// Means of the encoder's outputs on the nodes of sheets from `first` on, then mass and proximity to walls: four numbers of a node at
// a time. grid (ceil(nodes (C04 / 4 + 1) / WARP), sheets), block SUM_THREADS
extern "C" __global__ void __launch_bounds__(SUM_THREADS) train_to_nodes(const Plan* __restrict__ plan, int first) {
  const Plan& s = *plan;
  const int sheet = first + blockIdx.y, item = blockIdx.x * WARP + lane_of(), quad = item % (QUADS + 1);
  const u32 node = item / (QUADS + 1), entry = entry_of(s, sheet, node);
  if (is_beyond(s, sheet, QUADS + 1)) return;
  const float* encoded = s.encoded + particle_row(s, sheet, 0) * C04;
  const NodeSum found = sum_of_sheet(s, sheet, entry, encoded, C04, quad < QUADS ? quad : -1);
  if (threadIdx.x >= WARP || entry == MISSING) return;
  float* to = s.fields[0] + ((size_t)sheet * s.nodes[0] + node) * INPUT4;
  write_node_inputs(s, entry, quad, found, to);
}
// The gradient by what particles gather: sums over the particles around each node. grid (ceil(nodes C04 / 4 / WARP), sheets), block
// SUM_THREADS
extern "C" __global__ void __launch_bounds__(SUM_THREADS) train_gather_gradient(const Plan* __restrict__ plan, int first) {
  const Plan& s = *plan;
  const int sheet = first + blockIdx.y, item = blockIdx.x * WARP + lane_of(), quad = item % QUADS;
  const u32 node = item / QUADS, entry = entry_of(s, sheet, node);
  if (is_beyond(s, sheet, QUADS)) return;
  const float* by_gathered = s.by_inputs + particle_row(s, blockIdx.y, 0) * CONCAT + F4;
  const NodeSum found = sum_of_sheet(s, sheet, entry, by_gathered, CONCAT, quad);
  if (threadIdx.x >= WARP || entry == MISSING) return;
  *(float4*)(s.slopes[FIELDS - 1] + ((size_t)sheet * s.nodes[0] + node) * C04 + 4 * quad) = found.sum;
}
// From the gradient by what layers read of the nodes to the ones by the sums over particles, and by the mass in the place of its
// share, in place. Eight threads have a node. grid (ceil(nodes / 16), sheets), block 128
extern "C" __global__ void __launch_bounds__(128) train_means_gradient(const Plan* __restrict__ plan, int first) {
  const Plan& s = *plan;
  const int sheet = first + blockIdx.y, member = threadIdx.x % 8;
  const u32 node = blockIdx.x * 16 + threadIdx.x / 8;
  const bool is = node < s.totals[sheet * LEVELS];
  const size_t at = ((size_t)sheet * s.nodes[0] + node) * INPUT4;
  const float* means = s.fields[0] + at;
  float* by = s.slopes[0] + at;
  const float scale = is ? 1.0f / (multiply_rounded(means[C0], FULL_MASS) + MIN_MASS) : 0.0f;
  float sum = 0.0f;
  if (is)
    for (int c = member; c < C0; c += 8) {
      sum = fmaf(by[c], means[c], sum);
      by[c] *= scale;
    }
  for (int mask = 4; mask; mask /= 2) sum += shuffle_xor(sum, mask);
  if (is && member == 0) by[C0] = by[C0] / FULL_MASS - scale * sum;
}
