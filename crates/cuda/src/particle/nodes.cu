// The particle model's sparse grid (`kernels/nodes` of eddy-inference), for B streams of any sizes side by side: a block's y
// is its stream. Everything of a stream is computed from its own frame in an order of its own, so that its bits do not
// depend on the other streams. Sums of floating-point numbers have a fixed order; only integers are counted atomically.
//
// Constants beside those of common.cu (W4 is W rounded up to 4; lists of numbers are padded so):
//   F, E, C0   input features, width of the encoder, channels of the finest level of the grid
//   LEVELS     levels of the grid; MAX_LEVELS, MAX_LISTS: the most levels, and lists of features at nodes, of any grid
//   ORIGIN     index of node 0 in the maps of level 0
//   LAYERS     layers of the core
//   TILE       particles of a block
#define ROUND4(n) (((n) + 3) / 4 * 4)
#define F4 ROUND4(F)
#define E4 ROUND4(E)
#define C04 ROUND4(C0)
#define H4 ROUND4(H)
#define INPUT4 ROUND4(C0 + NODE_FEATURES)
#define QUADS (C04 / 4)
#define MISSING 0xffffffffu
// Nodes of a stencil, nodes of it behind each other, children of a node.
#if DIM == 2
#define STENCIL 9
#else
#define STENCIL 27
#endif
#define STENCIL_ROWS (STENCIL / 3)
#define CHILDREN (1 << DIM)
#define THREADS 128 // of a block that has a tile of particles
#define ROWS 4      // that a thread multiplies
#define WARP 32
__device__ __forceinline__ int lane_of() { return threadIdx.x % WARP; }

// A neighbour at rest (`Link` of eddy-inference).
struct __align__(16) Link {
  u32 particle;
  float coefficient[2];
  float share;
};

// A neighbour at rest: its weight among the particle's neighbours, and its position relative to the particle (domain lengths).
struct __align__(16) Neighbour {
  u32 particle;
  float share;
  float offset[2];
};
struct Lattice;

// A stream in a step; n is its number of particles. Lists by cells and nodes have an entry for every cell of the domain's map
// at that level, lists by nodes are as long as there can be nodes.
struct Stream {
  // What is remembered.
  float* hidden;                 // [LAYERS, n, H4]; of LSTM also the cells, after all outputs
  float* expected;               // [n, 2] velocities that the ballistic step expects
  float* lattice_places;         // [nodes of all lattices, 2] where they are expected
  float* lattice_errors;         // [lattices] largest sum of mass x squared distance from there with which a lattice moves its body
  const u32* first;              // [n + 1] first link of each particle; none where no particle has a rest shape
  const Link* links;
  const Neighbour* neighbours;   // as many as links
  const unsigned char* material; // [n]
  // Memory of the host.
  const Body* observed;
  Body* predicted;
  // Zero between two steps.
  u32* counts;                   // particles of each cell
  u32* marks[MAX_LEVELS];        // whether there is a node
  u64* fill;                     // [area nodes, 2] area of all particles and of liquid
  // Scratch memory.
  u32* starts;                   // [cells + 1] first slot of each cell
  u32* maps[MAX_LEVELS];         // number of each node
  u32* lists[MAX_LEVELS];        // entry of each node
  u32* totals;                   // [LEVELS + 1] nodes, bodies
  u32* chunks;                   // [1 + LEVELS, chunks] sums of the maps' parts
  Body* bodies;                  // [n]
  u32* cells;                    // [n]
  u32* arrivals;                 // [n] place among the particles of the cell, in any order
  u32* unsorted;                 // [n] particles by cells, in any order within a cell
  u32* order;                    // [n] particle of each slot: by cells, then by number
  float* weights;                // [n, 6] weights of the particle in a slot on three columns and three rows of nodes
  float* features;               // [n, F4]
  float* encoded;                // [n, C04]
  float* fields[MAX_LISTS];      // `grid_lists` of eddy-inference
  Body* next;                    // [n]
  // Scratch memory of the rules; nowhere where a rule is off.
  float* excess;                 // [area nodes, 2] with 1 / neighbours
  float* pressure;               // [area nodes]
  float* scratch[RULES];         // of each rule, as many numbers a particle as it asks for
  u32* parents;                  // [nodes] a node of the same body, in the end the smallest
  u32* numbers;                  // [nodes] of the body with this smallest node
  u64* body_sums;                // [bodies, BODY_NUMBERS / 2]
  // The lattices of bodies of jelly; none where the rule `elastic` is off.
  const Lattice* lattices;
  u64 lattice_count;
  const u32* body_of;            // [n] number of the particle's body
  Body* residuals;               // [n]
  Body* lattice_nodes;           // [2, their nodes]
  float* lattice_forces;         // [8 (their points and parts)]
  // The frame.
  u32 particles;
  u32 begun;
  u32 across[DIM];               // of the map of level 0
  float lower[2], extent[2];     // the domain's lower corner, its size (cells)
  float width;                   // of a cell
  float wall_lower[2], wall_upper[2], fall[2], dt;
  float unit;                    // of velocities
  float slowest[2], fastest[2];
  u32 area_extent[2];            // nodes of the area's grid
  int area_inside[2][2];         // first node between the walls and end, on each axis
  float area_walls[2][2];        // lower and upper wall on each axis (nodes)
  float stiffness;               // its feature
};

__device__ __forceinline__ u32 first_thread() { return blockIdx.x * blockDim.x + threadIdx.x; }
__device__ __forceinline__ u32 all_threads() { return gridDim.x * blockDim.x; }

// Position in the domain (cells) of a stream, or of the windows of a training; outside of it that of the nearest edge, NaN
// becomes the lower corner.
template <class S> __device__ __forceinline__ float cell_place(const S& s, const Body& body, int axis) {
  return fminf(fmaxf((body.x[axis] - s.lower[axis]) / s.width, 0.0f), s.extent[axis]);
}
// The first node of the stencil on an axis, from there on.
__device__ __forceinline__ float stencil(float place) { return floorf(place - 0.5f); }
// Column or row of a particle's cell in the map of level 0.
template <class S> __device__ __forceinline__ u32 cell_along(const S& s, const Body& body, int axis) {
  return (u32)((int)stencil(cell_place(s, body, axis)) + ORIGIN);
}

// Maps of a stream, or of the windows of a training. Distance between nodes that are neighbours along an axis, in a map.
template <class S> __device__ __forceinline__ int map_step(const S& s, int level, int axis) {
  int step = 1;
  for (int a = 0; a < axis; a++) step *= (int)(s.across[a] >> level);
  return step;
}
// Entry of the cell with the lowest node of a particle's stencil at `base`.
template <class S> __device__ __forceinline__ u32 cell_entry(const S& s, const int* base) {
  int entry = 0;
#pragma unroll
  for (int a = DIM - 1; a >= 0; a--) entry = entry * (int)s.across[a] + base[a] + ORIGIN;
  return (u32)entry;
}
// From the entry of a node to the one at digit `place` (base 3 for each axis from -1 on; base 2 from 0 on).
template <class S> __device__ __forceinline__ int neighbour_step(const S& s, int level, int place) {
  int step = 0;
#pragma unroll
  for (int a = 0; a < DIM; a++) {
    step += (place % 3 - 1) * map_step(s, level, a);
    place /= 3;
  }
  return step;
}
// Entry of a child in the map of the next finer level.
template <class S> __device__ __forceinline__ u32 child_entry(const S& s, int level, u32 entry, int place) {
  u32 child = 0;
#pragma unroll
  for (int a = 0; a < DIM; a++) {
    const u32 across = s.across[a] >> level, at = a + 1 < DIM ? entry % across : entry;
    child += (2 * at + ((place >> a) & 1)) * (u32)map_step(s, level - 1, a);
    entry /= across;
  }
  return child;
}

// Frames from the memory of the host; the particles of each cell; marks for the nodes they touch.
// grid (ceil(n / 256), B), block 256
extern "C" __global__ void __launch_bounds__(256) particle_load(const Stream* __restrict__ host_streams, Stream* __restrict__ streams) {
  const Stream& s = host_streams[blockIdx.y];
  if (blockIdx.x == 0)
    for (u32 i = threadIdx.x; i < sizeof(Stream) / 4; i += 256) ((u32*)(streams + blockIdx.y))[i] = ((const u32*)(host_streams + blockIdx.y))[i];
  const u32 n = s.particles, across = s.across[0];
  for (u32 p = first_thread(); p < n; p += all_threads()) {
    const Body body = s.observed[p];
    s.bodies[p] = body;
    u32 at[2];
#pragma unroll
    for (int a = 0; a < 2; a++) at[a] = cell_along(s, body, a);
    const u32 cell = at[1] * across + at[0], arrival = atomicAdd(s.counts + cell, 1u);
    s.cells[p] = cell;
    s.arrivals[p] = arrival;
    if (arrival) continue;
#pragma unroll
    for (int level = 0; level < LEVELS; level++) {
      const u32 wide = across >> level;
      for (u32 j = at[1] >> level; j <= (at[1] + 2) >> level; j++)
        for (u32 i = at[0] >> level; i <= (at[0] + 2) >> level; i++) s.marks[level][j * wide + i] = 1u;
    }
  }
}

// Running sums over maps: y = 0 the slots of cells, y = 1 + level the numbers of nodes. A block has a chunk of the map, and
// adds up the sums of those before. grid (chunks, 1 + LEVELS, B), block SCAN_THREADS
#define SCAN_THREADS 512
#define SCAN_EACH 16
#define CHUNK (SCAN_THREADS * SCAN_EACH)
#define SCANNED                                                                                                          \
  const Stream& s = streams[blockIdx.z];                                                                                 \
  const int level = (int)blockIdx.y - 1;                                                                                 \
  const u32 size = level < 0 ? s.across[0] * s.across[1] : (s.across[0] >> level) * (s.across[1] >> level), chunks = (size + CHUNK - 1) / CHUNK; \
  u32* from = level < 0 ? s.counts : s.marks[level];                                                                     \
  u32* parts = s.chunks + blockIdx.y * ((s.across[0] * s.across[1] + CHUNK - 1) / CHUNK);
// Sum over a block.
__device__ __forceinline__ u32 scan_total(u32 v, u32* sums) {
  sums[threadIdx.x] = v;
  __syncthreads();
  for (u32 m = SCAN_THREADS / 2; m; m /= 2) {
    if (threadIdx.x < m) sums[threadIdx.x] += sums[threadIdx.x + m];
    __syncthreads();
  }
  const u32 total = sums[0];
  __syncthreads();
  return total;
}
// The sums of chunks, where there are several.
extern "C" __global__ void __launch_bounds__(SCAN_THREADS) particle_chunks(const Stream* __restrict__ streams) {
  __shared__ u32 sums[SCAN_THREADS];
  SCANNED
  for (u32 chunk = blockIdx.x; chunk < chunks; chunk += gridDim.x) {
    u32 sum = 0;
    for (u32 at = chunk * CHUNK + threadIdx.x; at < min(size, (chunk + 1) * CHUNK); at += SCAN_THREADS) sum += from[at];
    sum = scan_total(sum, sums);
    if (threadIdx.x == 0) parts[chunk] = sum;
  }
}
// Clears counts and marks.
extern "C" __global__ void __launch_bounds__(SCAN_THREADS) particle_scan(const Stream* __restrict__ streams) {
  __shared__ u32 sums[2][SCAN_THREADS];
  SCANNED
  for (u32 chunk = blockIdx.x; chunk < chunks; chunk += gridDim.x) {
    u32 before = 0;
    for (u32 other = threadIdx.x; other < chunk; other += SCAN_THREADS) before += parts[other];
    if (chunk) before = scan_total(before, sums[0]);
    const u32 own = chunk * CHUNK + threadIdx.x * SCAN_EACH;
    u32 values[SCAN_EACH], sum = 0;
#pragma unroll
    for (int i = 0; i < SCAN_EACH; i++) {
      values[i] = own + i < size ? from[own + i] : 0u;
      sum += values[i];
    }
    int side = 0;
    sums[0][threadIdx.x] = sum;
    __syncthreads();
    for (u32 m = 1; m < SCAN_THREADS; m *= 2) {
      sums[side ^ 1][threadIdx.x] = sums[side][threadIdx.x] + (threadIdx.x >= m ? sums[side][threadIdx.x - m] : 0u);
      side ^= 1;
      __syncthreads();
    }
    u32 running = before + sums[side][threadIdx.x] - sum;
    if (chunk + 1 == chunks && threadIdx.x == 0) {
      const u32 total = before + sums[side][SCAN_THREADS - 1];
      if (level >= 0) {
        s.totals[level] = total;
      } else {
        s.starts[size] = total;
        s.totals[LEVELS] = 0;
      }
    }
#pragma unroll
    for (int i = 0; i < SCAN_EACH; i++) {
      const u32 at = own + i;
      if (at >= size) break;
      if (level < 0) {
        s.starts[at] = running;
      } else {
        s.maps[level][at] = values[i] ? running : MISSING;
        if (values[i]) s.lists[level][running] = at;
      }
      if (values[i]) from[at] = 0u;
      running += values[i];
    }
    __syncthreads();
  }
}

// Particles by cells, in the order of their arrival. grid (ceil(n / 256), B), block 256
extern "C" __global__ void __launch_bounds__(256) particle_scatter(const Stream* __restrict__ streams) {
  const Stream& s = streams[blockIdx.y];
  for (u32 p = first_thread(); p < s.particles; p += all_threads()) s.unsorted[s.starts[s.cells[p]] + s.arrivals[p]] = p;
}
// The same by their number: each counts those of its cell with a smaller one. Cells have some 16 particles; with all in one
// place the time is quadratic, but the threads of a warp read the same numbers. grid and block as above
extern "C" __global__ void __launch_bounds__(256) particle_rank(const Stream* __restrict__ streams) {
  const Stream& s = streams[blockIdx.y];
  for (u32 from = first_thread(); from < s.particles; from += all_threads()) {
    const u32 p = s.unsorted[from], cell = s.cells[p], begin = s.starts[cell], end = s.starts[cell + 1];
    u32 slot = begin;
#pragma unroll 4
    for (u32 other = begin; other < end; other++) slot += s.unsorted[other] < p ? 1u : 0u;
    s.order[slot] = p;
    const Body body = s.bodies[p];
#pragma unroll
    for (int a = 0; a < 2; a++) {
      const float place = cell_place(s, body, a);
      spline_weights(place - stencil(place), s.weights + 3 * DIM * (size_t)slot + 3 * a);
    }
  }
}
