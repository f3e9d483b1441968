// The MLS-MPM solver (crate eddy-mpm) for many scenes side by side. Two launches a substep:
//
//   solver_particles  a block has a tile of TILE x TILE cells: gather from the nodes, move, deform, stress, scatter to the
//                     tile's patch of nodes in shared memory
//   solver_nodes      a block has the nodes of a tile: sum of the patches that cover them, forces, walls
//
// Particles are sorted by tiles every few dozen substeps and when one has drifted further than a cell out of its tile: a
// patch reaches MARGIN cells further. Everything of a scene is computed from its own particles. Sums over particles are sums
// of integers, which have no order: the same bits come out of every run, however particles are sorted, and beside whatever
// other scenes.
//
// Constants: LIQUID, SNOW, JELLY, ROPE, SAND (numbers of the materials), MATERIALS (how many there are), and `CONSTANTS` of the crate eddy-mpm as bits of floats.
#define TILE 8
#define MARGIN 2
#define PATCH (TILE + 2 * MARGIN + 2)
#define PATCH_NODES (PATCH * PATCH)
#define ROW 24              // from a row of sums in shared memory to the next: 4 rows of 8 lie in different banks
#define SUMS (PATCH * ROW)
#define NODE_SUMS 5         // of a node: mass, momentum along x and y; with the law settling mass of solids, mass times J of liquids
#define CELLS (TILE * TILE) // of a tile
#define THREADS 128        // of a block of solver_particles
#define NONE 0xffffffffu

// A sum of numbers below 2^LIMIT_BITS as integers: `high` in units of 2^-HIGH_BITS, `low` in units of 2^-LOW_BITS of those.
// Neither overflows within BATCH numbers; after as many, both go into one of 64 bits.
#define HIGH_BITS 14
#define LOW_BITS 20
#define LIMIT_BITS 6
#define BATCH 2048
// Rounds |v| < 2^22 to an integer: the bits of v + ROUND are those of ROUND plus that integer.
#define ROUND 12582912.0f
#define ROUND_BITS 0x4b400000u

#ifdef EMULATED
static u32 bits_of(float v) { u32 bits; std::memcpy(&bits, &v, 4); return bits; }
static float real(u32 bits) { float v; std::memcpy(&v, &bits, 4); return v; }
#else
#define bits_of(v) __float_as_uint(v)
#define real(bits) __uint_as_float(bits)
#endif

// The settings of a scene, and where its part of the lists is.
struct Scene {
  u32 first, particles;        // in the lists of particles
  u32 first_tile, tiles[2];    // in the lists of tiles; tiles along x and y
  u32 first_node, sides[2];    // in the list of nodes; nodes along x and y
  u32 cells[2];
  u32 substeps;                // to be done
  float dx, inverse_dx;        // of a cell (domain lengths)
  float dt, gravity;
  float impulse;               // -dt 4 / (dx^2 rho)
  float per_cell;              // particles of a cell in an undeformed body
  float mu, lambda, viscosity; // before hardening; of liquids
  u32 water;                   // 1: the laws of water, 0: Taichi's
  u32 settling;                // 1: the law of this name, one of water's
  float relaxing, following;   // of it (`Settling` of eddy-mpm)
  float unit;                  // a power of two: velocities times this are below about 1 for a cell in a substep
  u32 attracted;               // 1: there is an attractor
  float centre[2], strength, period; // period 0: a single point
  float friction;              // at the walls
  float sand_slope;            // `Moduli` of eddy-mpm
};

// How far a scene is: substep `done` begins with a gather (but for the first), and ends with a scatter (but for the last,
// `substeps`). Stopped until particles are sorted, or for good when one is lost.
struct Status { u32 done, stopped; };

struct Tile { u32 scene, x, y; };

// The state of all particles, as lists of `n`: 14 numbers a particle.
struct State {
  float2* position;    // domain lengths
  float2* velocity;    // domain lengths per s
  float4* affine;      // C: xx, xy, yx, yy (1/s)
  float4* deformation; // F: xx, xy, yx, yy
  float* plastic;      // Jp of snow
  u32* identity;       // index in its scene times MATERIALS, and its material; in the order of the solvers the material only
};
__device__ __forceinline__ State state_at(float* base, u32 n) {
  return {(float2*)base, (float2*)(base + 2 * (u64)n), (float4*)(base + 4 * (u64)n), (float4*)(base + 8 * (u64)n),
          base + 12 * (u64)n, (u32*)(base + 13 * (u64)n)};
}
__device__ __forceinline__ void copy_particle(const State& to, u32 k, const State& from, u32 p) {
  to.position[k] = from.position[p];
  to.velocity[k] = from.velocity[p];
  to.affine[k] = from.affine[p];
  to.deformation[k] = from.deformation[p];
  to.plastic[k] = from.plastic[p];
}

// The lowest node of a stencil on an axis; false for NaN and where not all three nodes exist (`GridShape::contains`).
__device__ __forceinline__ bool lowest_node(const Scene& s, float position, int axis, float* cell, int* lowest) {
  *cell = multiply_rounded(position, s.inverse_dx);
  const bool inside = *cell >= 0.5f && *cell < (float)s.cells[axis] - 0.5f;
  *lowest = inside ? (int)(*cell - 0.5f) : 0;
  return inside;
}

// Particles in the order of the solvers, scene by scene, to those of the solver.
// grid (ceil(largest scene / 256), scenes), block 256
extern "C" __global__ void __launch_bounds__(256) solver_load(const Scene* __restrict__ scenes, float* listed, float* base, u32 n) {
  const Scene& s = scenes[blockIdx.y];
  const u32 k = blockIdx.x * 256 + threadIdx.x;
  if (k >= s.particles) return;
  const State to = state_at(base, n), from = state_at(listed, n);
  const u32 p = s.first + k;
  copy_particle(to, p, from, p);
  to.identity[p] = MATERIALS * k + from.identity[p];
}

// The same way back.
extern "C" __global__ void __launch_bounds__(256) solver_store(const Scene* __restrict__ scenes, float* listed, float* base, const u32* __restrict__ places, u32 n) {
  const Scene& s = scenes[blockIdx.y];
  const u32 k = blockIdx.x * 256 + threadIdx.x;
  if (k >= s.particles) return;
  copy_particle(state_at(listed, n), s.first + k, state_at(base, n), places[s.first + k]);
}

// Counts the particles of each cell of each tile; each learns how many in its cell came before, in any order.
// grid and block as above
extern "C" __global__ void __launch_bounds__(256) solver_count(const Scene* __restrict__ scenes, float* base, u32* __restrict__ keys, u32* __restrict__ arrivals, u32* __restrict__ counts, u32 n) {
  const Scene& s = scenes[blockIdx.y];
  const u32 k = blockIdx.x * 256 + threadIdx.x;
  if (k >= s.particles) return;
  const u32 p = s.first + k;
  const float2 position = state_at(base, n).position[p];
  float cell;
  int x, y;
  // One that is lost goes anywhere: its scene is not computed any more.
  const bool inside = lowest_node(s, position.x, 0, &cell, &x) & lowest_node(s, position.y, 1, &cell, &y);
  const u32 tile = s.first_tile + (inside ? (u32)x / TILE * s.tiles[1] + (u32)y / TILE : 0);
  const u32 key = tile * CELLS + (inside ? (u32)x % TILE * TILE + (u32)y % TILE : 0);
  keys[p] = key;
  arrivals[p] = atomicAdd(&counts[key], 1u);
}

// Numbers of tiles, found when particles are sorted.
struct Sorted {
  u32 active;  // tiles with particles
  u32 touched; // tiles with nodes in patches of those
};

// Places for the particles of each tile, and for its patch. Scenes that had to wait for this go on. The lists are in any
// order, on which no result depends.
// grid ceil(tiles / 256), block 256
extern "C" __global__ void __launch_bounds__(256) solver_tiles(const Scene* __restrict__ scenes, const Tile* __restrict__ tiles, const uint4* __restrict__ counts, u32* __restrict__ taken, u32* __restrict__ starts, u32* __restrict__ ends, u32* __restrict__ slots, u32* __restrict__ list, Sorted* __restrict__ sorted, u32 tile_count, Status* __restrict__ status, u32* __restrict__ drifted, const u32* __restrict__ lost, u32 scene_count) {
  const u32 k = blockIdx.x * 256 + threadIdx.x;
  for (u32 scene = k; scene < scene_count; scene += gridDim.x * 256) {
    drifted[scene] = 0;
    status[scene].stopped = lost[scene] != NONE;
  }
  if (k >= tile_count) return;
  u32 count = 0;
  for (u32 i = 0; i < CELLS / 4; i++) {
    const uint4 four = counts[k * (CELLS / 4) + i];
    count += four.x + four.y + four.z + four.w;
  }
  slots[k] = NONE;
  if (count == 0) return;
  starts[k] = scenes[tiles[k].scene].first + atomicAdd(&taken[tiles[k].scene], count);
  ends[k] = starts[k] + count;
  slots[k] = atomicAdd(&sorted->active, 1u);
  list[slots[k]] = k;
}

// The slot of the tile beside another one; NONE where it has no particles or is outside.
__device__ __forceinline__ u32 slot_beside(const Scene& s, const Tile& tile, const u32* slots, int across, int along) {
  const int x = (int)tile.x + across, y = (int)tile.y + along;
  if (x < 0 || y < 0 || x >= (int)s.tiles[0] || y >= (int)s.tiles[1]) return NONE;
  return slots[s.first_tile + (u32)x * s.tiles[1] + (u32)y];
}

// Lists the tiles with nodes in patches, in any order.
// grid and block as above
extern "C" __global__ void __launch_bounds__(256) solver_touch(const Scene* __restrict__ scenes, const Tile* __restrict__ tiles, const u32* __restrict__ slots, u32* __restrict__ touched, Sorted* __restrict__ sorted, u32 tile_count) {
  const u32 k = blockIdx.x * 256 + threadIdx.x;
  if (k >= tile_count) return;
  const Tile tile = tiles[k];
  const Scene& s = scenes[tile.scene];
  bool any = false;
  for (int across = -1; across <= 1; across++)
    for (int along = -1; along <= 1; along++) any = any || slot_beside(s, tile, slots, across, along) != NONE;
  if (any) touched[atomicAdd(&sorted->touched, 1u)] = k;
}

// Particles by tiles: the first of each cell, then the second of each, and so on, so that the threads of a warp add to
// different nodes.
// grid (ceil(largest scene / 256), scenes), block 256
extern "C" __global__ void __launch_bounds__(256) solver_move(const Scene* __restrict__ scenes, float* from_base, float* to_base, const u32* __restrict__ keys, const u32* __restrict__ arrivals, const u32* __restrict__ starts, const uint4* __restrict__ counts, u32* __restrict__ places, u32 n) {
  const Scene& s = scenes[blockIdx.y];
  const u32 k = blockIdx.x * 256 + threadIdx.x;
  if (k >= s.particles) return;
  const State from = state_at(from_base, n), to = state_at(to_base, n);
  const u32 p = s.first + k, key = keys[p], tile = key / CELLS, own = key % CELLS, arrival = arrivals[p];
  u32 place = starts[tile];
  for (u32 i = 0; i < CELLS / 4; i++) {
    const uint4 four = counts[tile * (CELLS / 4) + i];
    const u32 count[4] = {four.x, four.y, four.z, four.w};
#pragma unroll
    for (u32 j = 0; j < 4; j++) place += min(count[j], arrival) + (4 * i + j < own && count[j] > arrival);
  }
  copy_particle(to, place, from, p);
  to.identity[place] = from.identity[p];
  places[s.first + from.identity[p] / MATERIALS] = place;
}

__device__ __forceinline__ float clamped(float v, float lowest, float highest) {
  return v < lowest ? lowest : (highest < v ? highest : v);
}

// The smaller one; NaN where `v` is.
__device__ __forceinline__ float at_most(float v, float most) {
  return most < v ? most : v;
}

// Kirchhoff stress: xx, xy, yy (density x velocity^2).
struct Stress { float xx, xy, yy; };

// The law of liquids (`water` and `constitutive` of eddy-mpm), from the trial deformation.
__device__ __forceinline__ Stress liquid(const Scene& s, float4 c, float4* f) {
  float area = f->x * f->w - f->y * f->z;
  Stress stress;
  if (s.water) {
    area = at_most(area, s.settling ? 1.0f : real(MAX_AREA));
    const float packed = 1.0f / area, squared = packed * packed;
    float pressure = s.lambda / 7.0f * (squared * squared * squared * packed - 1.0f);
    pressure = area * (pressure < 0.0f ? 0.0f : pressure);
    const float viscous = 2.0f * s.viscosity * area;
    const float stretch = viscous * (0.5f * (c.x - c.w));
    stress = {stretch - pressure, viscous * (0.5f * (c.y + c.z)), -stretch - pressure};
  } else {
    const float tension = s.lambda * area * (area - 1.0f);
    stress = {tension, 0.0f, tension};
  }
  const float side = sqrtf(area);
  *f = {side, 0.0f, 0.0f, side};
  return stress;
}

// As `exponential` of eddy-mpm.
__device__ __forceinline__ float exponential(float x) {
  x *= 0.125f;
  float eighth = 1.0f / 720.0f;
  eighth = 1.0f / 120.0f + x * eighth;
  eighth = 1.0f / 24.0f + x * eighth;
  eighth = 1.0f / 6.0f + x * eighth;
  eighth = 0.5f + x * eighth;
  eighth = 1.0f + x * eighth;
  eighth = 1.0f + x * eighth;
  const float fourth = eighth * eighth, half = fourth * fourth;
  return half * half;
}

// As `logarithm` of eddy-mpm.
__device__ __forceinline__ float logarithm(float x) {
  const float root = sqrtf(sqrtf(x)), z = (root - 1.0f) / (root + 1.0f), square = z * z;
  float series = 8.0f / 9.0f;
  series = 8.0f / 7.0f + square * series;
  series = 8.0f / 5.0f + square * series;
  series = 8.0f / 3.0f + square * series;
  return z * (8.0f + square * series);
}

// `exp(10 (1 - Jp))` within bounds, as `snow_hardening` of eddy-mpm.
__device__ __forceinline__ float snow_hardening(float plastic) {
  const float exponent = clamped(real(SNOW_HARDENING) * (1.0f - plastic), real(SNOW_LEAST_EXPONENT), real(SNOW_MOST_EXPONENT));
  return clamped(exponential(exponent), real(SNOW_SOFTEST), real(SNOW_HARDEST));
}

// `sand` of eddy-mpm: Hencky's law with the friction of Drucker and Prager; `plastic` is 1 and the logarithm of the area gained.
__device__ __forceinline__ Stress grains(const Scene& s, float4* f, float* plastic) {
  const float a = 0.5f * (f->x + f->w), b = 0.5f * (f->z - f->y), c = 0.5f * (f->x - f->w), d = 0.5f * (f->z + f->y);
  const float q = sqrtf(a * a + b * b), r = sqrtf(c * c + d * d);
  const float cosine = q < 1e-12f ? 1.0f : a / q, sine = q < 1e-12f ? 0.0f : b / q;
  const float along = r < 1e-12f ? 1.0f : c / r, across = r < 1e-12f ? 0.0f : d / r;
  const float gained = *plastic - 1.0f;
  const float large = logarithm(clamped(q + r, real(SAND_LEAST), real(SAND_MOST))), small = logarithm(clamped(q - r, real(SAND_LEAST), real(SAND_MOST)));
  const float mean = 0.5f * (large + small + gained), shear = 0.5f * (large - small);
  if (mean >= 0.0f) {
    *plastic = 1.0f + 2.0f * mean;
    *f = {cosine, -sine, sine, cosine};
    return {0.0f, 0.0f, 0.0f};
  }
  const float mu = s.mu * real(SAND_STIFFNESS), lambda = s.lambda * real(SAND_STIFFNESS);
  const float kept = fminf(shear, s.sand_slope * -mean);
  if (kept < shear || gained > 0.0f) {
    *plastic = 1.0f;
    const float first = exponential(mean + kept), second = exponential(mean - kept);
    const float p = 0.5f * (first + second), t = 0.5f * (first - second);
    *f = {p * cosine + t * along, t * across - p * sine, p * sine + t * across, p * cosine - t * along};
  }
  const float pressure = 2.0f * (lambda + mu) * mean, tangent = 2.0f * mu * kept;
  const bool directed = q >= 1e-12f && r >= 1e-12f;
  const float axis_cosine = directed ? cosine * along - sine * across : 1.0f, axis_sine = directed ? cosine * across + sine * along : 0.0f;
  return {pressure + tangent * axis_cosine, tangent * axis_sine, pressure - tangent * axis_cosine};
}

// Solids (`constitutive` and `polar` of eddy-mpm): snow is projected onto its yield surface; fixed-corotated stress.
__device__ __forceinline__ Stress solid(const Scene& s, u32 material, float4* f, float* plastic) {
  const float a = 0.5f * (f->x + f->w), b = 0.5f * (f->z - f->y);
  const float q = sqrtf(a * a + b * b);
  const float cosine = q < 1e-12f ? 1.0f : a / q, sine = q < 1e-12f ? 0.0f : b / q;
  float factor = material == ROPE ? real(ROPE_STIFFNESS) : real(JELLY_STIFFNESS);
  if (material == SNOW) {
    factor = snow_hardening(*plastic);
    const float c = 0.5f * (f->x - f->w), d = 0.5f * (f->z + f->y);
    const float r = sqrtf(c * c + d * d);
    const float large = q + r, small = q - r;
    if (small < real(SNOW_LOWEST) || real(SNOW_HIGHEST) < large) {
      const float large_kept = clamped(large, real(SNOW_LOWEST), real(SNOW_HIGHEST)), small_kept = clamped(small, real(SNOW_LOWEST), real(SNOW_HIGHEST));
      *plastic *= large / large_kept * (small / small_kept);
      const float mean = 0.5f * (large_kept + small_kept);
      // Without a direction of the stretch there is none: both singular values are the same.
      const float stretch = r < 1e-12f ? 0.0f : 0.5f * (large_kept - small_kept) / r;
      const float e = mean * cosine, g = mean * sine;
      *f = {e + stretch * c, stretch * d - g, g + stretch * d, e - stretch * c};
    }
  }
  const float area = f->x * f->w - f->y * f->z;
  const float shear = 2.0f * s.mu * factor, tension = s.lambda * factor * area * (area - 1.0f);
  const float xx = f->x - cosine, xy = f->y + sine, yx = f->z - sine, yy = f->w - cosine;
  return {shear * (xx * f->x + xy * f->y) + tension, shear * (xx * f->z + xy * f->w), shear * (yx * f->z + yy * f->w) + tension};
}

// Adds a number below 2^(LIMIT_BITS + HIGH_BITS), in units of `high`, to a sum.
__device__ __forceinline__ void add(u32* high, u32* low, float v) {
  const float shifted = v + ROUND;
  const float rest = v - (shifted - ROUND); // exact
  atomicAdd(high, bits_of(shifted) - ROUND_BITS);
  atomicAdd(low, bits_of(rest * (float)(1 << LOW_BITS) + ROUND) - ROUND_BITS);
}

// Gather, motion, law and scatter of the particles of a tile.
// grid about the number of tiles with particles, block THREADS
extern "C" __global__ void __launch_bounds__(THREADS, 8) solver_particles(const Scene* __restrict__ scenes, const Tile* __restrict__ tiles, const u32* __restrict__ list, const Sorted* __restrict__ sorted, const u32* __restrict__ starts, const u32* __restrict__ ends, float* base, u32 n, const float4* __restrict__ nodes, long long* __restrict__ patches, const Status* __restrict__ status, u32* __restrict__ drifted, u32* __restrict__ lost) {
  __shared__ float4 near[PATCH_NODES]; // velocity (domain lengths per s), mass and J of the nodes before the substep
  __shared__ uint4 sums[2 * NODE_SUMS * SUMS / 4]; // high and low part of each sum
  u32 *const high = (u32*)sums, *const low = high + SUMS;
  const State state = state_at(base, n);
  const u32 t = threadIdx.x;
  for (u32 slot = blockIdx.x; slot < sorted->active; slot += gridDim.x) {
    const u32 number = list[slot];
    const Tile tile = tiles[number];
    const Scene& s = scenes[tile.scene];
    const Status now = status[tile.scene];
    if (now.stopped || now.done > s.substeps) continue;
    const bool gathers = now.done > 0, scatters = now.done < s.substeps;
    const int origin_x = (int)(tile.x * TILE) - MARGIN, origin_y = (int)(tile.y * TILE) - MARGIN;
    __syncthreads(); // the tile before is done
    for (u32 row = t / 16; row < PATCH; row += THREADS / 16) {
      if (t % 16 >= PATCH || !gathers) continue;
      const int x = origin_x + (int)row, y = origin_y + (int)(t % 16);
      const bool there = x >= 0 && y >= 0 && x < (int)s.sides[0] && y < (int)s.sides[1];
      near[row * PATCH + t % 16] = there ? nodes[s.first_node + (u32)x * s.sides[1] + (u32)y] : float4{0.0f, 0.0f, 0.0f, 0.0f};
    }
    const u32 node_sums = s.settling ? NODE_SUMS : 3;
    for (u32 k = t; k < 2 * node_sums * SUMS / 4; k += THREADS) sums[k] = uint4{0, 0, 0, 0};
    __syncthreads();
    long long* patch = patches + (u64)slot * NODE_SUMS * PATCH_NODES;
    const u32 end = ends[number];
    u32 added = 0;
    bool first_batch = true;
    for (u32 first = starts[number]; first < end; first += THREADS) {
      const u32 p = first + t;
      if (p < end) {
        float2 x = state.position[p], v;
        float4 c, f = state.deformation[p];
        const u32 identity = state.identity[p], material = identity % MATERIALS;
        float cell_x, cell_y, wx[3], wy[3];
        int i, j;
        bool inside = true;
        if (gathers) {
          lowest_node(s, x.x, 0, &cell_x, &i);
          lowest_node(s, x.y, 1, &cell_y, &j);
          const float fx = cell_x - (float)i, fy = cell_y - (float)j;
          spline_weights(fx, wx);
          spline_weights(fy, wy);
          const u32 at = (u32)(i - origin_x) * PATCH + (u32)(j - origin_y);
          float mass = 0.0f, grid_area = 0.0f;
          v = {0.0f, 0.0f};
          c = {0.0f, 0.0f, 0.0f, 0.0f};
#pragma unroll
          for (int a = 0; a < 3; a++)
#pragma unroll
            for (int b = 0; b < 3; b++) {
              const float4 node = near[at + a * PATCH + b];
              const float w = wx[a] * wy[b], dx = (float)a - fx, dy = (float)b - fy;
              const float vx = w * node.x, vy = w * node.y;
              v.x += vx;
              v.y += vy;
              c.x += vx * dx;
              c.y += vx * dy;
              c.z += vy * dx;
              c.w += vy * dy;
              mass += w * node.z;
              grid_area += w * node.w;
            }
          const float scale = 4.0f * s.inverse_dx;
          c = {c.x * scale, c.y * scale, c.z * scale, c.w * scale};
          x.x += s.dt * v.x;
          x.y += s.dt * v.y;
          state.position[p] = x;
          // Nobody reads them before the next gather.
          if (!scatters) {
            state.velocity[p] = v;
            state.affine[p] = c;
          }
          if (material == LIQUID && s.water) {
            float area = f.x * f.w;
            if (s.settling) {
              // It follows the area of the grid (`Settling::followed`).
              area = at_most(area + (grid_area - area) * s.following, 1.0f);
            } else {
              // It relaxes towards the density of the grid (`water::corrected`).
              const float target = at_most(s.per_cell / mass, real(MAX_AREA));
              area += (target - area) * fminf(s.dt / real(RELAXATION_TIME), 1.0f);
            }
            f.x = f.w = sqrtf(area);
          }
        } else {
          v = state.velocity[p];
          c = state.affine[p];
        }
        inside = lowest_node(s, x.x, 0, &cell_x, &i) & lowest_node(s, x.y, 1, &cell_y, &j);
        // Within the patch, and within the patch without the outermost cell of its margin.
        const int px = i - origin_x, py = j - origin_y;
        inside = inside && px >= 0 && py >= 0 && px < TILE + 2 * MARGIN && py < TILE + 2 * MARGIN;
        if (px < 1 || py < 1 || px >= TILE + 2 * MARGIN - 1 || py >= TILE + 2 * MARGIN - 1) drifted[tile.scene] = 1;
        if (scatters && inside) {
          // (I + dt C) F
          const float one_x = 1.0f + s.dt * c.x, one_y = 1.0f + s.dt * c.w, cross_x = s.dt * c.y, cross_y = s.dt * c.z;
          float4 trial = {one_x * f.x + cross_x * f.z, one_x * f.y + cross_x * f.w, cross_y * f.x + one_y * f.z, cross_y * f.y + one_y * f.w};
          const bool is_plastic = material == SNOW || material == SAND;
          float plastic = is_plastic ? state.plastic[p] : 1.0f;
          const Stress stress = material == LIQUID ? liquid(s, c, &trial) : material == SAND ? grains(s, &trial, &plastic) : solid(s, material, &trial, &plastic);
          f = trial;
          if (is_plastic) state.plastic[p] = plastic;
          // Momentum per mass at the particle, and its change from cell to cell.
          const float xx = (s.impulse * stress.xx + c.x) * s.dx, xy = (s.impulse * stress.xy + c.y) * s.dx;
          const float yx = (s.impulse * stress.xy + c.z) * s.dx, yy = (s.impulse * stress.yy + c.w) * s.dx;
          const float largest = fmaxf(fabsf(v.x), fabsf(v.y)) + 1.5f * (fabsf(xx) + fabsf(xy) + fabsf(yx) + fabsf(yy));
          inside = largest * s.unit < (float)(1 << LIMIT_BITS); // false for NaN
          if (inside) {
            const float fx = cell_x - (float)i, fy = cell_y - (float)j;
            spline_weights(fx, wx);
            spline_weights(fy, wy);
            // Both factors are powers of two: nothing is rounded here that would not be without them.
            const float mass = (float)(1 << HIGH_BITS), unit = s.unit;
            const u32 at = (u32)px * ROW + (u32)py;
#pragma unroll
            for (int a = 0; a < 3; a++) {
              const float across = (float)a - fx, w = mass * wx[a];
              const float row_x = unit * (v.x + xx * across), row_y = unit * (v.y + yx * across);
#pragma unroll
              for (int b = 0; b < 3; b++) {
                const float along = unit * ((float)b - fy), weight = w * wy[b];
                const u32 node = at + a * ROW + b;
                add(high + node, low + node, weight);
                add(high + 2 * SUMS + node, low + 2 * SUMS + node, weight * (row_x + xy * along));
                add(high + 4 * SUMS + node, low + 4 * SUMS + node, weight * (row_y + yy * along));
                if (s.settling) {
                  const bool is_liquid = material == LIQUID;
                  const u32 sum = node + (is_liquid ? 8 : 6) * SUMS;
                  add(high + sum, low + sum, is_liquid ? weight * (f.x * f.w) : weight);
                }
              }
            }
          }
        }
        state.deformation[p] = f;
        if (!inside) atomicMin(&lost[tile.scene], identity / MATERIALS);
      }
      added += THREADS;
      if (scatters && (added == BATCH || first + THREADS >= end)) {
        __syncthreads();
        // 16 threads have a row of nodes.
        for (u32 row = t / 16; row < node_sums * PATCH; row += THREADS / 16) {
          if (t % 16 >= PATCH) continue;
          const u32 at = (row + row / PATCH * PATCH) * ROW + t % 16, k = row * PATCH + t % 16;
          const long long sum = (long long)(int)high[at] * (1 << LOW_BITS) + (int)low[at];
          patch[k] = first_batch ? sum : patch[k] + sum;
          high[at] = low[at] = 0;
        }
        first_batch = false;
        added = 0;
        __syncthreads();
      }
    }
  }
}

// Acceleration by the attractor (`Attractor::acceleration`).
__device__ __forceinline__ float2 pull(const Scene& s, float x, float y) {
  float towards_x = s.centre[0] - x;
  const float towards_y = s.centre[1] - y;
  if (s.period > 0.0f) towards_x -= s.period * roundf(towards_x / s.period);
  const float scale = s.strength / (real(CORE) + sqrtf(towards_x * towards_x + towards_y * towards_y));
  return {towards_x * scale, towards_y * scale};
}
// A velocity at node `index` of an axis beside separating slip walls.
__device__ __forceinline__ float walled(float velocity, u32 index, u32 side) {
  const u32 wall = (u32)real(WALL_CELLS);
  if (index < wall) return fmaxf(velocity, 0.0f);
  return index + wall >= side ? fminf(velocity, 0.0f) : velocity;
}

// A velocity along a wall of which friction takes at most this.
__device__ __forceinline__ float rubbed(float velocity, float most) { return copysignf(fmaxf(fabsf(velocity) - most, 0.0f), velocity); }

// The share of a node's kernel that lies between the walls, along one axis; none inside the walls (`grid::open_along`).
__device__ __forceinline__ float open_along(u32 index, u32 side) {
  const u32 surface = (u32)real(WALL_CELLS) - 1, nearest = min(index, side - 1 - index);
  if (nearest > surface + 1) return 1.0f;
  return nearest > surface ? 47.0f / 48.0f : (nearest == surface ? 0.5f : 0.0f);
}

// Velocities of the nodes; what the scenes have done.
// grid about the number of tiles, block CELLS
extern "C" __global__ void __launch_bounds__(CELLS) solver_nodes(const Scene* __restrict__ scenes, const Tile* __restrict__ tiles, const u32* __restrict__ slots, const u32* __restrict__ touched, const Sorted* __restrict__ sorted, const long long* __restrict__ patches, float4* __restrict__ nodes, const Status* __restrict__ status, Status* __restrict__ next, const u32* __restrict__ drifted, const u32* __restrict__ lost, u32 scene_count) {
  const u32 t = threadIdx.x;
  if (blockIdx.x == 0)
    for (u32 k = t; k < scene_count; k += CELLS) {
      const Status now = status[k];
      const bool runs = !now.stopped && now.done <= scenes[k].substeps;
      next[k] = {now.done + (runs ? 1u : 0u), now.stopped || drifted[k] || lost[k] != NONE};
    }
  const int i = (int)(t / TILE), j = (int)(t % TILE);
  // The patches of this tile and of the one that is nearer on each axis, if its patch reaches this far, cover the node.
  const int across = i < PATCH - TILE - MARGIN ? -1 : (i >= TILE - MARGIN ? 1 : 0);
  const int along = j < PATCH - TILE - MARGIN ? -1 : (j >= TILE - MARGIN ? 1 : 0);
  for (u32 k = blockIdx.x; k < sorted->touched; k += gridDim.x) {
    const Tile tile = tiles[touched[k]];
    const Scene& s = scenes[tile.scene];
    const Status now = status[tile.scene];
    if (now.stopped || now.done >= s.substeps) continue;
    long long sum = 0, sum_x = 0, sum_y = 0, sum_solid = 0, sum_area = 0;
#pragma unroll
    for (int patch = 0; patch < 4; patch++) {
      const int a = patch / 2 * across, b = patch % 2 * along;
      if ((patch / 2 && !across) || (patch % 2 && !along)) continue;
      const u32 slot = slot_beside(s, tile, slots, a, b);
      if (slot == NONE) continue;
      // The patch begins MARGIN nodes before its tile.
      const long long* sums = patches + (u64)slot * NODE_SUMS * PATCH_NODES + (i - TILE * a + MARGIN) * PATCH + j - TILE * b + MARGIN;
      sum += sums[0];
      sum_x += sums[PATCH_NODES];
      sum_y += sums[2 * PATCH_NODES];
      if (s.settling) {
        sum_solid += sums[3 * PATCH_NODES];
        sum_area += sums[4 * PATCH_NODES];
      }
    }
    const u32 gx = tile.x * TILE + (u32)i, gy = tile.y * TILE + (u32)j;
    if (sum <= 0 || gx >= s.sides[0] || gy >= s.sides[1]) continue;
    const float mass = (float)sum * (1.0f / (float)(1ll << (HIGH_BITS + LOW_BITS)));
    const float unit = (float)sum * s.unit;
    float vx = (float)sum_x / unit, vy = (float)sum_y / unit + s.dt * s.gravity;
    if (s.attracted) {
      const float2 pulled = pull(s, (float)gx * s.dx, (float)gy * s.dx);
      vx += s.dt * pulled.x;
      vy += s.dt * pulled.y;
    }
    float area = 0.0f;
    if (s.settling) {
      const float open = fmaxf(open_along(gx, s.sides[0]) * open_along(gy, s.sides[1]), real(LEAST_OPEN));
      // That of its liquid, relaxed towards its density (`Settling::of_node`).
      const float liquid = (float)(sum - sum_solid);
      area = liquid > real(LEAST_LIQUID) * (float)sum ? (float)sum_area / liquid : 1.0f;
      area += (at_most(s.per_cell * open / mass, real(MAX_AREA)) - area) * s.relaxing;
    }
    // `at_walls` of eddy-mpm.
    const float kept_x = walled(vx, gx, s.sides[0]), kept_y = walled(vy, gy, s.sides[1]);
    const float by_x = s.friction * fabsf(vx - kept_x), by_y = s.friction * fabsf(vy - kept_y);
    nodes[s.first_node + gx * s.sides[1] + gy] = {rubbed(kept_x, by_y), rubbed(kept_y, by_x), mass, area};
  }
}
