// A layer on nodes (`ops/convolution` of eddy-inference), for predictions and for both passes of a training: a linear layer on tensor cores,
// whose rows are gathered as they are needed.

// What makes up a row of a layer's input: the 3 x 3 around a node, its children; itself, from where a layer goes to the children.
#define NEIGHBOURS 0
#define FROM_CHILDREN 1
#define TO_CHILDREN 2
#define ITSELF 3
__device__ __forceinline__ int places_of(int stencil) { return stencil == NEIGHBOURS ? STENCIL : (stencil == FROM_CHILDREN ? CHILDREN : 1); }

struct NodeLayer {
  const float* weights; // [outputs, places, width], of TO_CHILDREN [CHILDREN outputs, width]
  const float* bias;    // or none
  const float* from;    // [.., width]
  float* to;            // [.., outputs]
  const float* add;     // a list like `to` that is added, or none
  const float* mask;    // a list like `to`: where it is not positive, there is no gradient; or none
  int stencil, level;   // level of the nodes that rows are made for
  int width, outputs;   // padded widths of the lists
  int rectified;
  int row_step, place_step; // numbers from an output's weights to the next one's, from a place's to the next one's
  int unused;
};

// A block has a tile of 16 nodes and 16 columns, each of its warps a share of the numbers of a row.
#define TILE_COLUMNS 16
#define FRAGMENTS (TILE_COLUMNS / 8)
#define NODE_LAYER_WARPS 4
#define NODE_LAYER_THREADS (NODE_LAYER_WARPS * WARP)
__device__ __forceinline__ int columns_of(const NodeLayer& layer) { return (layer.stencil == TO_CHILDREN ? CHILDREN : 1) * layer.outputs; }
__device__ __forceinline__ u32 tiles_of(const NodeLayer& layer, u32 nodes) {
  return (nodes + WARP_ROWS - 1) / WARP_ROWS * ((columns_of(layer) + TILE_COLUMNS - 1) / TILE_COLUMNS);
}
// Writes a pair of sums.
__device__ __forceinline__ void write_pair(const NodeLayer& layer, u32 target, int at, float* pair) {
  const size_t to = (size_t)target * layer.outputs + at;
#pragma unroll
  for (int u = 0; u < 2; u++) {
    if (layer.bias) pair[u] += layer.bias[at + u];
    if (layer.add) pair[u] += layer.add[to + u];
    if (layer.mask && !(layer.mask[to + u] > 0.0f)) pair[u] = 0.0f;
    if (layer.rectified && pair[u] < 0.0f) pair[u] = 0.0f;
  }
  *(float2*)(layer.to + to) = float2{pair[0], pair[1]};
}
// Steps of 16 numbers that a warp reads before it needs them: more take too many registers.
#define AHEAD 3
// `node_at(stencil, node, place)` is the node at a place of a node's row, or MISSING. All threads of a block call it, and wait for each other
// before they call it again.
template <class At> __device__ __forceinline__ void layer_tile(const NodeLayer& layer, u32 nodes, u32 tile, At node_at) {
  __shared__ u32 around[WARP_ROWS * STENCIL];
  __shared__ float4 shares[NODE_LAYER_WARPS][FRAGMENTS][WARP];
  const int warp = threadIdx.x / WARP, row = fragment_row(), total = (int)nodes, places = places_of(layer.stencil), columns = columns_of(layer);
  const int wide = (columns + TILE_COLUMNS - 1) / TILE_COLUMNS, begin = tile / wide * WARP_ROWS, column = tile % wide * TILE_COLUMNS;
  for (int i = threadIdx.x; i < WARP_ROWS * places; i += NODE_LAYER_THREADS)
    around[i] = begin + i / places < total ? node_at(layer.stencil, begin + i / places, i % places) : MISSING;
  __syncthreads();
  const int width = layer.width, four = width / 4, quads = places * four, place_step = layer.place_step;
  const float *from = layer.from, *weights = layer.weights + (column + row) * layer.row_step;
  Fragment sums[FRAGMENTS];
#pragma unroll
  for (int c = 0; c < FRAGMENTS; c++) sums[c] = no_sums();
  int place = (4 * warp + fragment_quad()) / four, quad = (4 * warp + fragment_quad()) % four;
  for (int k = 4 * warp; k < quads; k += 4 * NODE_LAYER_WARPS * AHEAD) {
    float4 upper[AHEAD], lower[AHEAD], right[AHEAD][FRAGMENTS];
#pragma unroll
    for (int j = 0; j < AHEAD; j++) {
      const bool is = place < places;
      const u32 one = is ? around[row * places + place] : MISSING, other = is ? around[(row + 8) * places + place] : MISSING;
      upper[j] = quad_of(from + (size_t)one * width + 4 * quad, one != MISSING);
      lower[j] = quad_of(from + (size_t)other * width + 4 * quad, other != MISSING);
#pragma unroll
      for (int c = 0; c < FRAGMENTS; c++)
        right[j][c] = quad_of(weights + 8 * c * layer.row_step + place * place_step + 4 * quad, is && column + 8 * c + row < columns);
      for (quad += 4 * NODE_LAYER_WARPS; quad >= four; quad -= four) place++;
    }
#pragma unroll
    for (int j = 0; j < AHEAD; j++)
      if (k + 4 * NODE_LAYER_WARPS * j < quads)
#pragma unroll
        for (int c = 0; c < FRAGMENTS; c++) add_quads(sums[c], upper[j], lower[j], right[j][c]);
  }
#pragma unroll
  for (int c = 0; c < FRAGMENTS; c++) shares[warp][c][lane_of()] = float4{sum_of(sums[c], 0), sum_of(sums[c], 1), sum_of(sums[c], 2), sum_of(sums[c], 3)};
  __syncthreads();
  for (int c = warp; c < FRAGMENTS; c += NODE_LAYER_WARPS) {
    float4 all = shares[0][c][lane_of()];
#pragma unroll
    for (int other = 1; other < NODE_LAYER_WARPS; other++) add_scaled(all, 1.0f, shares[other][c][lane_of()]);
    // A thread has two columns of two rows.
    const int own = column + 8 * c + 2 * fragment_quad();
    if (own >= columns) continue;
    float found[2][2] = {{all.x, all.y}, {all.z, all.w}};
#pragma unroll
    for (int half = 0; half < 2; half++) {
      const int node = begin + row + 8 * half;
      if (node >= total) continue;
      const u32 target = layer.stencil == TO_CHILDREN ? node_at(FROM_CHILDREN, node, own / layer.outputs) : node;
      if (target != MISSING) write_pair(layer, target, own % layer.outputs, found[half]);
    }
  }
}

// A layer of a step: its lists by their numbers in a stream, its first weight. grid (tiles, B), block NODE_LAYER_THREADS
struct StreamLayer { int stencil, level, from, to, skip, width, outputs, rectified, weights; };
extern "C" __global__ void __launch_bounds__(NODE_LAYER_THREADS) particle_layer(const Stream* __restrict__ streams, const float* __restrict__ w, StreamLayer layer) {
  const Stream& s = streams[blockIdx.y];
  const int level = layer.level, inner = places_of(layer.stencil) * layer.width;
  const int columns = (layer.stencil == TO_CHILDREN ? CHILDREN : 1) * layer.outputs;
  const float* weights = w + layer.weights;
  const NodeLayer own = {weights, weights + inner * columns, s.fields[layer.from], s.fields[layer.to], layer.stencil == TO_CHILDREN ? s.fields[layer.skip] : nullptr, nullptr,
                   layer.stencil, level, layer.width, layer.outputs, layer.rectified, inner, layer.width, 0};
  // A block has tiles that follow each other, mostly columns of the same nodes: their rows are in the nearest cache.
  const u32 total = s.totals[level], tiles = tiles_of(own, total), each = (tiles + gridDim.x - 1) / gridDim.x;
  for (u32 tile = blockIdx.x * each; tile < min(tiles, (blockIdx.x + 1) * each); tile++) {
    layer_tile(own, total, tile, [&](int stencil, u32 node, int place) {
      if (stencil == NEIGHBOURS) return s.maps[level][(int)s.lists[level][node] + neighbour_step(s, level, place)];
      return stencil == FROM_CHILDREN ? s.maps[level - 1][child_entry(s, level, s.lists[level][node], place)] : node;
    });
    __syncthreads();
  }
}
