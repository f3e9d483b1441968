// Matrices as the passes read them, and the gradients by all weights.

// Transposed matrices for the forward pass, [columns, inner] from [inner, columns], and their biases. grid (x, matrices), block 256
struct Transposed { int first, inner, columns; };
extern "C" __global__ void __launch_bounds__(256) train_transpose(const Transposed* __restrict__ matrices, const float* __restrict__ w, float* __restrict__ transposed) {
  const Transposed matrix = matrices[blockIdx.y];
  const int size = matrix.inner * matrix.columns;
  for (int i = blockIdx.x * 256 + threadIdx.x; i < size + matrix.columns; i += gridDim.x * 256)
    transposed[matrix.first + (i < size ? i % matrix.columns * matrix.inner + i / matrix.columns : i)] = w[matrix.first + i];
}

// Part of the gradient by a matrix: sums over rows of `x` times rows of `by`, of the windows' frames. The rows are particles, or nodes
// whose surroundings make up a row.
struct Outer {
  const float* x;   // [.., width]
  const float* by;  // [.., stride]
  int first;        // of the matrix in a part
  int stencil, level; // of nodes; level -1: particles
  int width, x_stride; // of x: numbers that enter, numbers from a row to the next
  int outputs, stride; // the same of `by`
  int gap;          // numbers left out before the columns of the split gate in `by`
  int rows;         // that a block has at a time, a multiple of 8
  int left, left_end; // rows of the matrix: those behind `x` are for its bias
  int right, right_end; // columns
  int unused;
};
#define OUTER_THREADS 256
#define OUTER_WARPS (OUTER_THREADS / WARP)
// 16 x 8 numbers of the matrix are a tile; a warp has at most so many.
#define OUTER_TILES 8
// Length of a row in shared memory: neighbouring rows 8 banks apart.
__device__ __forceinline__ int outer_stride(int width) { return (width + 23) / 32 * 32 + 8; }
// A thread's share of rows of so many quadruples: one of them, of every so many rows.
struct Share { int quad, row, step; };
__device__ __forceinline__ Share share_of(int quads) {
  if (!quads) return {0, 0, 0};
  const int step = OUTER_THREADS / quads, row = threadIdx.x / quads;
  return {(int)threadIdx.x % quads, row, row < step ? step : 0};
}
// parts [B, splits, size] has the sums of so many shares of each window's frames; these are those from `first` on. While a block
// multiplies rows, the next ones are on their way. grid (B shares, outers), block OUTER_THREADS, shared memory: twice as many rows of
// both as a block has at a time; 16 x 8 sums of each warp
extern "C" __global__ void __launch_bounds__(OUTER_THREADS) train_outer(const Plan* __restrict__ plan, const Outer* __restrict__ outers, float* __restrict__ parts, int splits, int first, int size) {
  DYNAMIC_SHARED(float, shared);
  const Plan& s = *plan;
  const Outer& o = outers[blockIdx.y];
  const int b = blockIdx.x % s.batch, split = first + blockIdx.x / s.batch, frames = frames_of(s), last = frames * (split + 1) / splits;
  const bool of_nodes = o.level >= 0, spread = of_nodes && o.stencil == TO_CHILDREN;
  const int inner = (of_nodes ? places_of(o.stencil) : 1) * o.width, columns = (spread ? CHILDREN : 1) * o.outputs;
  const int high = (o.left_end - o.left + 15) / 16, wide = (o.right_end - o.right + 7) / 8, tiles = high * wide;
  const int x_stride = outer_stride(16 * high), by_stride = outer_stride(8 * wide), rows = o.rows, length = rows * (x_stride + by_stride);
  // Warps that share a tile take groups of 8 rows in turn.
  const int sharing = tiles < OUTER_WARPS ? OUTER_WARPS / tiles : 1, warp = threadIdx.x / WARP;
  const int part = warp % sharing, begun = warp / sharing, step = OUTER_WARPS / sharing;
  float sums[OUTER_TILES][4];
  int at_left[OUTER_TILES], at_right[OUTER_TILES];
#pragma unroll
  for (int tile = 0; tile < OUTER_TILES; tile++) {
    at_left[tile] = (begun + tile * step) / wide * 16;
    at_right[tile] = (begun + tile * step) % wide * 8;
#pragma unroll
    for (int i = 0; i < 4; i++) sums[tile][i] = 0.0f;
  }
  if (o.left_end > inner)
    for (int row = threadIdx.x; row < 2 * rows; row += OUTER_THREADS) shared[row / rows * length + row % rows * x_stride + inner - o.left] = 1.0f;
  // What this thread copies: a quadruple of a place of `x`, and one of a child's `by`.
  const u32 most = of_nodes ? s.nodes[o.stencil == FROM_CHILDREN ? o.level - 1 : o.level] : (u32)s.most;
  const u32 most_by = of_nodes ? s.nodes[spread ? o.level - 1 : o.level] : (u32)s.most;
  const Share x_share = share_of((min(o.left_end, inner) - o.left) / 4), by_share = share_of((o.right_end - o.right) / 4);
  const int x_number = o.left + 4 * x_share.quad, place = o.width ? x_number / o.width : 0, x_column = o.width ? x_number % o.width : 0;
  const int by_number = o.right + 4 * by_share.quad, target = by_number / o.outputs, column = by_number % o.outputs;
  const int by_column = column + (column >= SPLIT_GATE * H4 ? o.gap : 0);
  const auto total_of = [&](int t) { return of_nodes ? s.totals[(t * s.batch + b) * LEVELS + o.level] : particles_of(s, b); };
  // The first rows of a frame that has any.
  const auto settle = [&](int& t, u32& begin) {
    while (t < last && begin >= total_of(t)) {
      t++;
      begin = 0;
    }
  };
  const auto copy = [&](int t, u32 begin, float* to) {
    const int sheet = t * s.batch + b, count = (int)min((u32)rows, total_of(t) - begin), filled = (count + 7) / 8 * 8;
    if (x_share.step)
#pragma unroll 4
      for (int row = x_share.row; row < filled; row += x_share.step) {
        u32 from = begin + row;
        if (row >= count) from = MISSING;
        else if (of_nodes) from = node_at(s, sheet, o.stencil, o.level, from, place);
        const bool is = from != MISSING;
        copy_quad(to + row * x_stride + 4 * x_share.quad, o.x + (is ? ((size_t)sheet * most + from) * o.x_stride + x_column : 0), is);
      }
    if (by_share.step)
#pragma unroll 4
      for (int row = by_share.row; row < filled; row += by_share.step) {
        u32 from = begin + row;
        if (row >= count) from = MISSING;
        else if (spread) from = node_at(s, sheet, FROM_CHILDREN, o.level, from, target);
        const bool is = from != MISSING;
        copy_quad(to + rows * x_stride + row * by_stride + 4 * by_share.quad, o.by + (is ? ((size_t)sheet * most_by + from) * o.stride + by_column : 0), is);
      }
  };
  int t = frames * split / splits;
  u32 begin = 0;
  settle(t, begin);
  if (t < last) copy(t, begin, shared);
  end_copies();
  for (int turn = 0; t < last; turn ^= 1) {
    const int filled = ((int)min((u32)rows, total_of(t) - begin) + 7) / 8 * 8;
    begin += rows;
    settle(t, begin);
    if (t < last) copy(t, begin, shared + (turn ^ 1) * length);
    end_copies();
    wait_copies(1);
    __syncthreads();
    const float *x = shared + turn * length + fragment_quad() * x_stride + fragment_row();
    const float *by = shared + turn * length + rows * x_stride + fragment_quad() * by_stride + fragment_row();
    for (int k = 8 * part; k < filled; k += 8 * sharing) {
      const float *lefts = x + k * x_stride, *rights = by + k * by_stride;
#pragma unroll
      for (int tile = 0; tile < OUTER_TILES; tile++) {
        if (begun + tile * step >= tiles) break;
        const float *left = lefts + at_left[tile], *right = rights + at_right[tile];
        const Parts a[4] = {parts_of(left[0]), parts_of(left[8]), parts_of(left[4 * x_stride]), parts_of(left[4 * x_stride + 8])};
        const Parts c[2] = {parts_of(right[0]), parts_of(right[4 * by_stride])};
        // One sum for both: registers are short.
        add_step(sums[tile], sums[tile], a, c);
      }
    }
    __syncthreads();
  }
  if (sharing > 1) {
    // A share without rows comes here with ones in shared memory.
    __syncthreads();
#pragma unroll
    for (int i = 0; i < 4; i++) shared[threadIdx.x * 4 + i] = sums[0][i];
    __syncthreads();
    if (part) return;
    for (int other = 1; other < sharing; other++)
#pragma unroll
      for (int i = 0; i < 4; i++) sums[0][i] += shared[(threadIdx.x + other * WARP) * 4 + i];
  }
  float* to = parts + ((size_t)b * splits + split) * size + o.first;
#pragma unroll
  for (int tile = 0; tile < OUTER_TILES; tile++) {
    if (begun + tile * step >= tiles) break;
#pragma unroll
    for (int i = 0; i < 4; i++) {
      const int row = o.left + at_left[tile] + fragment_row() + 8 * (i / 2), column = o.right + at_right[tile] + 2 * fragment_quad() + i % 2;
      if (row < o.left_end && column < o.right_end) to[(size_t)row * columns + column] = sums[tile][i];
    }
  }
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
