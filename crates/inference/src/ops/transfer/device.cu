// Transfers between particles and the finest nodes, as `mod.rs`; `s` is a stream or the plan of a training, with the columns and rows of
// its maps.

__device__ __forceinline__ void add_scaled(float4& sum, float scale, const float4& quad) {
  sum.x = fmaf(scale, quad.x, sum.x);
  sum.y = fmaf(scale, quad.y, sum.y);
  sum.z = fmaf(scale, quad.z, sum.z);
  sum.w = fmaf(scale, quad.w, sum.w);
}
// The weight of a row of a stencil, from the weights of the other axes.
__device__ __forceinline__ float row_weight(const float (*weights)[3], int row) {
  float product = 1.0f;
#pragma unroll
  for (int a = 1; a < DIM; a++) {
    product *= weights[a][row % 3];
    row /= 3;
  }
  return product;
}
// From the first node of a stencil to the first one of a row of it, in a map.
template <class S> __device__ __forceinline__ int map_row(const S& s, int row) {
  int step = 0;
#pragma unroll
  for (int a = 1; a < DIM; a++) {
    step += row % 3 * map_step(s, 0, a);
    row /= 3;
  }
  return step;
}

// Sums over the particles around a node (P2G), `mass` that of the weights. A block has 32 items, one in each lane. A warp adds up one of
// SHARES shares of a row of stencils; all have the sums of the whole. `starts` are the first slots of cells, `slot_weights` those of the
// particle in a slot, and `values(slot)` has its four numbers, or none. All threads of a block call it, and wait for each other before they
// call it again.
struct NodeSum { float4 sum; float mass; };
template <int SHARES, class S, class Values>
__device__ __forceinline__ NodeSum sum_around(const S& s, u32 entry, const u32* starts, const float* slot_weights, Values values) {
  __shared__ NodeSum sums[SHARES * STENCIL_ROWS][WARP];
  const int warp = threadIdx.x / WARP, row = warp / SHARES, share = warp % SHARES;
  NodeSum found = {{0.0f, 0.0f, 0.0f, 0.0f}, 0.0f};
  if (entry != MISSING) {
    // This is node (i, row) of the stencil of the cell i further left.
    const u32 last = entry - map_row(s, row);
    const u32 begin = starts[last - 2], middle = starts[last - 1], right = starts[last], end = starts[last + 1];
    const u32 from = begin + (end - begin) * share / SHARES, until = begin + (end - begin) * (share + 1) / SHARES;
#pragma unroll 8
    for (u32 slot = from; slot < until; slot++) {
      const float (*weights)[3] = (const float (*)[3])(slot_weights + (size_t)slot * (3 * DIM));
      const float weight = weights[0][slot < middle ? 2 : (slot < right ? 1 : 0)] * row_weight(weights, row);
      found.mass += weight;
      const float* own = values(slot);
      if (own) add_scaled(found.sum, weight, *(const float4*)own);
    }
  }
  sums[warp][lane_of()] = found;
  __syncthreads();
  found = {{0.0f, 0.0f, 0.0f, 0.0f}, 0.0f};
#pragma unroll
  for (int other = 0; other < SHARES * STENCIL_ROWS; other++) {
    const NodeSum part = sums[other][lane_of()];
    add_scaled(found.sum, 1.0f, part.sum);
    found.mass += part.mass;
  }
  return found;
}

// A particle's stencil: weights of its nodes along each axis, and the first node of each of its rows.
struct Stencil { float weights[DIM][3]; u32 rows[STENCIL_ROWS]; };
static_assert(sizeof(Stencil) == STENCIL_BYTES, "of eddy-cuda's particle/layout.rs");
// Sets the rows from the entry of its cell in a map.
template <class S> __device__ __forceinline__ void set_rows(const S& s, const u32* map, u32 cell, Stencil& own) {
#pragma unroll
  for (int row = 0; row < STENCIL_ROWS; row++) own.rows[row] = map[cell + map_row(s, row)];
}
// Four numbers that a particle gathers (G2P) from a list of rows of `width` numbers at the nodes.
__device__ __forceinline__ float4 gathered_quad(const Stencil& own, const float* field, int width, int quad) {
  float4 sum = {0.0f, 0.0f, 0.0f, 0.0f};
#pragma unroll
  for (int row = 0; row < STENCIL_ROWS; row++)
#pragma unroll
    for (int column = 0; column < 3; column++) {
      const float weight = own.weights[0][column] * row_weight(own.weights, row);
      add_scaled(sum, weight, *(const float4*)(field + (size_t)(own.rows[row] + column) * width + 4 * quad));
    }
  return sum;
}
