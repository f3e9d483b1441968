// Layers on nodes, forwards and backwards, and the gradients by all weights.

// What a layer gathers: the 3 x 3 around a node, its children, itself; that is written to the node, or to its children.
#define NEIGHBOURS 0
#define FROM_CHILDREN 1
#define TO_CHILDREN 2

struct NodeLayer {
  const float* weights; // [inner, outputs], of TO_CHILDREN [inner, CHILDREN outputs]
  const float* bias;    // or none
  const float* from;    // [.., width]
  float* to;            // [.., outputs]
  const float* add;     // a list like `to` that is added, or none
  const float* mask;    // a list like `to`: where it is not positive, there is no gradient; or none
  int stencil, level;   // level of the blocks' nodes
  int width, outputs;   // padded widths of the lists
  int rectified, parts; // threads that share a sum
};
__device__ __forceinline__ int places_of(int stencil) { return stencil == NEIGHBOURS ? STENCIL : (stencil == FROM_CHILDREN ? CHILDREN : 1); }
// The node at a place around a node of a sheet, or MISSING.
__device__ __forceinline__ u32 node_at(const Plan& s, int sheet, int stencil, int level, u32 node, int place) {
  if (stencil == TO_CHILDREN) return node;
  const u32 entry = s.lists[level][(size_t)sheet * s.nodes[level] + node];
  if (stencil == NEIGHBOURS) return s.maps[level][(size_t)sheet * s.entries[level] + entry + neighbour_step(s, level, place)];
  return s.maps[level - 1][(size_t)sheet * s.entries[level - 1] + child_entry(s, level, entry, place)];
}

// A layer on sheets from `first` on. grid (ceil(nodes / LEARN_NODES), sheets), block 256, shared memory: LEARN_NODES rows of the
// gathered numbers; the parts of the sums
extern "C" __global__ void __launch_bounds__(256) train_layer(const Plan* __restrict__ plan, NodeLayer layer, int first) {
  DYNAMIC_SHARED(float, x);
  __shared__ u32 gathered[LEARN_NODES * STENCIL];
  const Plan& s = *plan;
  const int sheet = first + blockIdx.y, level = layer.level, quarter = LEARN_NODES / ROWS;
  const int places = places_of(layer.stencil), spread = layer.stencil == TO_CHILDREN;
  const int source = layer.stencil == FROM_CHILDREN ? level - 1 : level, target_level = spread ? level - 1 : level;
  const u32 total = s.totals[sheet * LEVELS + level], begin = blockIdx.x * LEARN_NODES;
  if (begin >= total) return;
  const int count = (int)min((u32)LEARN_NODES, total - begin), four = layer.width / 4, inner = places * layer.width, stride = ODD4(inner);
  const int columns = (spread ? CHILDREN : 1) * layer.outputs, items = quarter * (columns / 4), parts = layer.parts;
  const float* from = layer.from + (size_t)sheet * s.nodes[source] * layer.width;
  for (int i = threadIdx.x; i < LEARN_NODES * places; i += 256)
    gathered[i] = i / places < count ? node_at(s, sheet, layer.stencil, level, begin + i / places, i % places) : MISSING;
  __syncthreads();
#pragma unroll 4
  for (int i = threadIdx.x; i < LEARN_NODES * places * four; i += 256) {
    const int number = i / four, k = i % four, row = number / places, place = number % places;
    const u32 node = gathered[number];
    *(float4*)(x + row * stride + (place * four + k) * 4) =
        node == MISSING ? float4{0.0f, 0.0f, 0.0f, 0.0f} : ((const float4*)from)[(size_t)node * four + k];
  }
  __syncthreads();
  for (int item = threadIdx.x; item < items * parts || parts > 1; item += 256) {
    const int part = item / items, own = item % items, row = own % quarter, column = own / quarter * 4, at = column % layer.outputs;
    float sums[1][ROWS][4];
    if (part < parts) {
      // The numbers in quadruples, shared out as evenly as they can be.
      const int begun = inner / 4 * part / parts * 4, end = inner / 4 * (part + 1) / parts * 4;
#pragma unroll
      for (int r = 0; r < ROWS; r++)
#pragma unroll
        for (int u = 0; u < 4; u++) sums[0][r][u] = part || !layer.bias ? 0.0f : layer.bias[at + u];
      add_products<1, 1, 4, -1>(sums, x + row * stride + begun, quarter * stride, layer.weights + (size_t)begun * columns + column, columns, 0, end - begun);
    }
    if (parts > 1) {
      // Shared out, every thread has one item at most.
      __syncthreads();
      if (part > 0 && part < parts)
#pragma unroll
        for (int r = 0; r < ROWS; r++) *(float4*)(x + ((part - 1) * items + own) * 4 * ROWS + 4 * r) = float4{sums[0][r][0], sums[0][r][1], sums[0][r][2], sums[0][r][3]};
      __syncthreads();
      if (part == 0)
        for (int other = 0; other < parts - 1; other++)
#pragma unroll
          for (int r = 0; r < ROWS; r++)
#pragma unroll
            for (int u = 0; u < 4; u++) sums[0][r][u] += x[(other * items + own) * 4 * ROWS + 4 * r + u];
    }
    if (part == 0) {
#pragma unroll
      for (int r = 0; r < ROWS; r++) {
        const int node = row + r * quarter;
        if (node >= count) continue;
        u32 target = begin + node;
        if (spread) target = node_at(s, sheet, FROM_CHILDREN, level, target, column / layer.outputs);
        if (target == MISSING) continue;
        const size_t place = ((size_t)sheet * s.nodes[target_level] + target) * layer.outputs + at;
#pragma unroll
        for (int u = 0; u < 4; u++) {
          float sum = sums[0][r][u];
          if (layer.add) sum += layer.add[place + u];
          if (layer.mask && !(layer.mask[place + u] > 0.0f)) sum = 0.0f;
          layer.to[place + u] = layer.rectified && sum < 0.0f ? 0.0f : sum;
        }
      }
    }
    if (parts > 1) break;
  }
}

// Matrices for the way back: [columns, inner] from [inner, columns]; of a 3 x 3 around a node, which is neighbour 8 - k of its
// neighbour k, [places, columns, inner / places] with the last place first. grid (x, matrices), block 256
struct Turn { int first, inner, columns, places; };
extern "C" __global__ void __launch_bounds__(256) train_turn(const Turn* __restrict__ turns, const float* __restrict__ w, float* __restrict__ turned) {
  const Turn turn = turns[blockIdx.y];
  const int width = turn.inner / turn.places;
  for (int i = blockIdx.x * 256 + threadIdx.x; i < turn.inner * turn.columns; i += gridDim.x * 256) {
    const int row = i / turn.columns, column = i % turn.columns, place = turn.places - 1 - row / width;
    turned[turn.first + (place * turn.columns + column) * width + row % width] = w[turn.first + i];
  }
}

// The gradient by a matrix: sums over rows of `x` times rows of `by`, of the windows' frames. The rows are particles, or nodes
// whose surroundings make up a row.
struct Outer {
  const float* x;   // [.., width]
  const float* by;  // [.., stride]
  int first;        // of the matrix in a part
  int stencil, level; // of nodes; level -1: particles
  int width, x_stride; // of x: numbers that enter, numbers from a row to the next
  int outputs, stride; // the same of `by`
  int gap;          // numbers left out before the last third of `by`
  int parts;        // threads that share a sum
  int rows;         // that a block has at a time, of nodes at most LEARN_NODES
  int begun;        // squares of the matrix that other blocks have
};
#define OUTER_THREADS 256
// parts [B, splits, size] has the sums of so many shares of each window's frames. A thread has a square of 4 x 4 numbers, and
// behind the matrix four of its bias. grid (B splits, outers), block 256, shared memory: as many rows of both as a block has
extern "C" __global__ void __launch_bounds__(OUTER_THREADS) train_outer(const Plan* __restrict__ plan, const Outer* __restrict__ outers, float* __restrict__ parts, int splits, int size) {
  DYNAMIC_SHARED(float, shared);
  __shared__ u32 at_x[LEARN_NODES * STENCIL], at_by[LEARN_NODES * CHILDREN];
  const Plan& s = *plan;
  const Outer& o = outers[blockIdx.y];
  const int b = blockIdx.x / splits, split = blockIdx.x % splits, frames = frames_of(s);
  const bool of_nodes = o.level >= 0, spread = of_nodes && o.stencil == TO_CHILDREN;
  const int places = of_nodes ? places_of(o.stencil) : 1, targets = spread ? CHILDREN : 1;
  const int inner = places * o.width, columns = targets * o.outputs, x_stride = ODD4(inner), by_stride = ODD4(columns);
  const int wide = columns / 4, squares = (inner / 4 + 1) * wide;
  float *x = shared, *by = x + o.rows * x_stride;
  const int item = o.begun + threadIdx.x, own = item % squares, part = item / squares;
  const bool is = part < o.parts, is_bias = own / wide * 4 == inner;
  const int i = own / wide * 4, j = own % wide * 4;
  float sums[4][4];
#pragma unroll
  for (int r = 0; r < 4; r++)
#pragma unroll
    for (int u = 0; u < 4; u++) sums[r][u] = 0.0f;
  for (int t = frames * split / splits; t < frames * (split + 1) / splits; t++) {
    const int sheet = t * s.batch + b, source = o.stencil == FROM_CHILDREN ? o.level - 1 : o.level;
    const u32 total = of_nodes ? s.totals[sheet * LEVELS + o.level] : particles_of(s, b);
    const size_t x_first = (size_t)sheet * (of_nodes ? s.nodes[source] : (u32)s.most);
    const size_t by_first = (size_t)sheet * (of_nodes ? s.nodes[spread ? o.level - 1 : o.level] : (u32)s.most);
    for (u32 begin = 0; begin < total; begin += o.rows) {
      const int count = (int)min((u32)o.rows, total - begin);
      __syncthreads();
      if (of_nodes) {
        for (int k = threadIdx.x; k < count * places; k += OUTER_THREADS) at_x[k] = node_at(s, sheet, o.stencil, o.level, begin + k / places, k % places);
        for (int k = threadIdx.x; k < count * targets; k += OUTER_THREADS)
          at_by[k] = spread ? node_at(s, sheet, FROM_CHILDREN, o.level, begin + k / targets, k % targets) : begin + k;
        __syncthreads();
      }
      const int four = o.width / 4, by_four = o.outputs / 4;
#pragma unroll 4
      for (int k = threadIdx.x; k < count * places * four; k += OUTER_THREADS) {
        const u32 row = of_nodes ? at_x[k / four] : begin + k / four;
        *(float4*)(x + k / four / places * x_stride + k / four % places * o.width + k % four * 4) =
            row == MISSING ? float4{0.0f, 0.0f, 0.0f, 0.0f} : *(const float4*)(o.x + (x_first + row) * o.x_stride + k % four * 4);
      }
#pragma unroll 4
      for (int k = threadIdx.x; k < count * targets * by_four; k += OUTER_THREADS) {
        const u32 row = of_nodes ? at_by[k / by_four] : begin + k / by_four;
        const int column = k % by_four * 4, skipped = 3 * column >= 2 * o.outputs ? o.gap : 0;
        *(float4*)(by + k / by_four / targets * by_stride + k / by_four % targets * o.outputs + column) =
            row == MISSING ? float4{0.0f, 0.0f, 0.0f, 0.0f} : *(const float4*)(o.by + (by_first + row) * o.stride + skipped + column);
      }
      __syncthreads();
      if (is && !is_bias)
        for (int row = part; row < count; row += o.parts) {
          const float4 left = *(const float4*)(x + row * x_stride + i), right = *(const float4*)(by + row * by_stride + j);
          const float l[4] = {left.x, left.y, left.z, left.w}, g[4] = {right.x, right.y, right.z, right.w};
#pragma unroll
          for (int r = 0; r < 4; r++)
#pragma unroll
            for (int u = 0; u < 4; u++) sums[r][u] = fmaf(l[r], g[u], sums[r][u]);
        }
      // The children of a node share the bias: it is where the first one's would be.
      if (is && is_bias && j < o.outputs)
        for (int row = part; row < count; row += o.parts)
          for (int target = 0; target < targets; target++)
#pragma unroll
            for (int u = 0; u < 4; u++) sums[0][u] += by[row * by_stride + target * o.outputs + j + u];
    }
  }
  if (o.parts > 1) {
    __syncthreads();
    if (is && part > 0)
#pragma unroll
      for (int r = 0; r < 4; r++)
#pragma unroll
        for (int u = 0; u < 4; u++) shared[((part - 1) * squares + own) * 16 + 4 * r + u] = sums[r][u];
    __syncthreads();
    if (part == 0)
      for (int other = 0; other < o.parts - 1; other++)
#pragma unroll
        for (int r = 0; r < 4; r++)
#pragma unroll
          for (int u = 0; u < 4; u++) sums[r][u] += shared[(other * squares + own) * 16 + 4 * r + u];
  }
  if (part > 0) return;
  float* to = parts + (size_t)blockIdx.x * size + o.first;
#pragma unroll
  for (int r = 0; r < 4; r++)
    if (i + r <= inner)
#pragma unroll
      for (int u = 0; u < 4; u++) to[(size_t)(i + r) * columns + j + u] = sums[r][u];
}

// Marks windows whose gradient is not finite. grid (x, B splits), block 256
extern "C" __global__ void __launch_bounds__(256) train_finite(const float* __restrict__ parts, u32* __restrict__ broken, int splits, int size) {
  bool finite = true;
  for (int i = blockIdx.x * 256 + threadIdx.x; i < size; i += gridDim.x * 256) finite &= fabsf(parts[(size_t)blockIdx.y * size + i]) <= 3.4e38f;
  if (!finite) broken[blockIdx.y / splits] = 1u;
}
// The gradient by all weights: a window whose prediction diverges has no direction, and is left out.
// grid ceil(size / 256), block 256
extern "C" __global__ void __launch_bounds__(256) train_sum(const float* __restrict__ parts, const u32* __restrict__ broken, float* __restrict__ gradients, int windows,
    int splits, int size) {
  const int i = blockIdx.x * 256 + threadIdx.x;
  if (i >= size) return;
  float sum = 0.0f;
  for (int b = 0; b < windows; b++)
    if (!broken[b])
#pragma unroll 4
      for (int split = 0; split < splits; split++) sum += parts[((size_t)b * splits + split) * size + i];
  gradients[i] = sum;
}
