// Frames forwards: features and encoder; what is gathered from the nodes, context, core and decoder; the predicted motion and
// its error. A block has a tile of a window's particles; rows of a tile beyond the window are computed, but not kept.

// A tile: particles begin..begin + count of a window.
struct Tile { int b; u32 begin; int count; };
__device__ __forceinline__ Tile tile_of(const Plan& s, int b) {
  const u32 begin = blockIdx.x * LEARN_TILE, n = particles_of(s, b);
  return {b, begin, begin < n ? (int)min((u32)LEARN_TILE, n - begin) : 0};
}
// Rows of a tile from a list of rows of `width` numbers, and back.
__device__ __forceinline__ void load_tile(const Tile& tile, float* to, int to_stride, const float* from, int width) {
  for (int i = threadIdx.x; i < LEARN_TILE * (width / 4); i += THREADS) {
    const int row = i / (width / 4), k = i % (width / 4);
    *(float4*)(to + row * to_stride + 4 * k) = row < tile.count ? *(const float4*)(from + (size_t)row * width + 4 * k) : float4{0.0f, 0.0f, 0.0f, 0.0f};
  }
}
__device__ __forceinline__ void store_tile(const Tile& tile, float* to, int width, const float* from, int from_stride) {
  for (int i = threadIdx.x; i < tile.count * (width / 4); i += THREADS) {
    const int row = i / (width / 4), k = i % (width / 4);
    *(float4*)(to + (size_t)row * width + 4 * k) = *(const float4*)(from + row * from_stride + 4 * k);
  }
}

// Links of a window's particles: nowhere if no particle has a rest shape.
__device__ __forceinline__ const u32* first_of(const Plan& s, const u32* first, int b) {
  const Window& window = window_of(s, b);
  return first ? first + (size_t)(2 * window.stream + window.mirrored) * (s.most + 1) : nullptr;
}
// The features of a particle in a frame (`model/features.rs` of eddy-learning).
#define SHAPE_FROM (7 * DIM)
__device__ __forceinline__ void features_of(const Plan& s, int sheet, int b, u32 p, float* own) {
  const Body* bodies = s.states + particle_row(s, sheet, 0);
  const Body body = bodies[p];
#pragma unroll
  for (int a = 0; a < DIM; a++) {
    const float expected = sheet < s.batch ? body.v[a] : ballistic(s, s.states[particle_row(s, sheet - s.batch, p)], a).v;
    const Fall fall = ballistic(s, body, a);
    own[a] = body.v[a] / s.unit;
    own[DIM + a] = (body.v[a] - expected) / s.unit;
    own[2 * DIM + a] = (fall.v - fall.free) / s.unit;
    const float sides[2] = {body.x[a] - s.wall_lower[a], s.wall_upper[a] - body.x[a]};
#pragma unroll
    for (int side = 0; side < 2; side++) {
      const float distance = sides[side] > 0.0f ? sides[side] : 0.0f;
      own[3 * DIM + DIM * side + a] = exponential(distance * (-1.0f / CONTACT_SCALE));
      own[5 * DIM + DIM * side + a] = exponential(distance * (-1.0f / BODY_SCALE));
    }
  }
  rest_shape(first_of(s, s.link_first, b), s.links, bodies, p, body, own + SHAPE_FROM);
  own[SHAPE_FROM + SHAPE_FEATURES + s.material[(size_t)window_of(s, b).stream * s.most + p]] = 1.0f;
}

// Features and encoder of sheets from `first` on. grid (ceil(most / LEARN_TILE), sheets), block THREADS, shared memory: rows of
// features, of the hidden layer, of outputs
extern "C" __global__ void __launch_bounds__(THREADS) train_encode(const Plan* __restrict__ plan, const float* __restrict__ first_matrix,
    const float* __restrict__ second_matrix, int first) {
  DYNAMIC_SHARED(float, shared);
  float *x = shared, *hidden = x + LEARN_TILE * ODD4(F4), *encoded = hidden + LEARN_TILE * ODD4(E4);
  const Plan& s = *plan;
  const int sheet = first + blockIdx.y, b = sheet % s.batch;
  const Tile tile = tile_of(s, b);
  if (!tile.count) return;
  const size_t at = particle_row(s, sheet, tile.begin);
  for (int row = threadIdx.x; row < LEARN_TILE; row += THREADS) {
    float* own = x + row * ODD4(F4);
    for (int k = 0; k < F4; k++) own[k] = 0.0f;
    if (row < tile.count) features_of(s, sheet, b, tile.begin + row, own);
  }
  __syncthreads();
  for (int i = threadIdx.x; i < tile.count * (F4 / 4); i += THREADS) {
    const int row = i / (F4 / 4), k = i % (F4 / 4);
    *(float4*)(s.inputs + (at + row) * CONCAT + 4 * k) = *(const float4*)(x + row * ODD4(F4) + 4 * k);
  }
  tile_product<LEARN_TILE, true>(x, ODD4(F4), hidden, ODD4(E4), first_matrix, F4, E4, true);
  __syncthreads();
  store_tile(tile, s.hidden + at * E4, E4, hidden, ODD4(E4));
  tile_product<LEARN_TILE, true>(hidden, ODD4(E4), encoded, ODD4(C04), second_matrix, E4, C04, false);
  __syncthreads();
  store_tile(tile, s.encoded + at * C04, C04, encoded, ODD4(C04));
}

// Matrices begin at multiples of 64.
#define ROUND64(n) (((n) + 63) / 64 * 64)
#define CONTEXT_SIZE ROUND64((CONCAT + 1) * H4)
#define GATES_SIZE ROUND64((H4 + 1) * CORE_COLUMNS)
#define CORE_SIZE ((CORE >= 3 ? 2 : 1) * GATES_SIZE)
#define MIXER_SIZE ROUND64((H4 + 1) * H4)
#define SLOTS (GATE_SUMS * H4)

// A unit from its sums: what the way back needs in the place of the sums, the new state, and of LSTM the cell.
__device__ __forceinline__ float unit_forward(float* sums, float last, float* cell) {
#if CORE == 3
  sums[0] = sigmoid(sums[0]);
  sums[1] = sigmoid(sums[1]);
  sums[2] = hyperbolic_tangent(fmaf(sums[0], sums[3], sums[2]));
  return fmaf(sums[1], last - sums[2], sums[2]);
#elif CORE == 4
  sums[0] = sigmoid(sums[0]);
  sums[1] = sigmoid(sums[1]);
  sums[2] = hyperbolic_tangent(sums[2]);
  sums[3] = sigmoid(sums[3]);
  *cell = fmaf(sums[1], *cell, sums[0] * sums[2]);
  return sums[3] * hyperbolic_tangent(*cell);
#else
  return unit_state(sums, last, cell);
#endif
}

// Gather from the nodes, context, core and decoder, for some frames of all windows, one after the other. `w` has the matrices of
// context, core (input, then recurrent), mixer and decoder one behind the other.
// grid (ceil(most / LEARN_TILE), B), block THREADS, shared memory: rows of the input, two lists of rows of units; each particle's
// stencil
#define LEARN_WIDE ODD4(WIDEST(CONCAT, H4))
#define LEARN_NARROW ODD4(H4)
extern "C" __global__ void __launch_bounds__(THREADS) train_decode(const Plan* __restrict__ plan, const float* __restrict__ w, int first, int frames) {
  DYNAMIC_SHARED(float, shared);
  float *wide = shared, *narrow = wide + LEARN_TILE * LEARN_WIDE, *last = narrow + LEARN_TILE * LEARN_NARROW;
  Stencil* stencils = (Stencil*)(last + LEARN_TILE * LEARN_NARROW);
  const Plan& s = *plan;
  const int all = frames_of(s);
  const Tile tile = tile_of(s, blockIdx.y);
  if (!tile.count) return;
  for (int t = first; t < first + frames; t++) {
    const int sheet = t * s.batch + tile.b;
    const size_t at = particle_row(s, sheet, tile.begin);
    for (int row = threadIdx.x; row < tile.count; row += THREADS) stencils[row] = stencil_of(s, sheet, s.states[at + row]);
    __syncthreads();
    const float* field = s.fields[FIELDS - 1] + (size_t)sheet * s.nodes[0] * C04;
    for (int i = threadIdx.x; i < LEARN_TILE * (CONCAT / 4); i += THREADS) {
      const int row = i / (CONCAT / 4), k = i % (CONCAT / 4);
      float4 sum = {0.0f, 0.0f, 0.0f, 0.0f};
      if (row < tile.count && k < F4 / 4) {
        sum = *(const float4*)(s.inputs + (at + row) * CONCAT + 4 * k);
      } else if (row < tile.count) {
        const Stencil& own = stencils[row];
#pragma unroll
        for (int j = 0; j < STENCIL_ROWS; j++)
#pragma unroll
          for (int c = 0; c < 3; c++) {
            const float4 value = *(const float4*)(field + (size_t)(own.rows[j] + c) * C04 + 4 * k - F4);
            const float weight = own.weights[0][c] * row_weight(own.weights, j);
            sum.x = fmaf(weight, value.x, sum.x);
            sum.y = fmaf(weight, value.y, sum.y);
            sum.z = fmaf(weight, value.z, sum.z);
            sum.w = fmaf(weight, value.w, sum.w);
          }
        *(float4*)(s.inputs + (at + row) * CONCAT + 4 * k) = sum;
      }
      *(float4*)(wide + row * LEARN_WIDE + 4 * k) = sum;
    }
    __syncthreads();
    const float* matrix = w;
    tile_product<LEARN_TILE, true>(wide, LEARN_WIDE, narrow, LEARN_NARROW, matrix, CONCAT, H4, true);
    matrix += CONTEXT_SIZE;
    __syncthreads();
    store_tile(tile, s.context + at * H4, H4, narrow, LEARN_NARROW);
    float *x = narrow, *y = wide;
    int x_stride = LEARN_NARROW, y_stride = LEARN_WIDE;
    for (int layer = 0; layer < LAYERS; layer++) {
      const size_t before = layer_row(s, layer, (all + 1) * s.batch, sheet, tile.begin), after = before + (size_t)s.batch * s.most;
      const size_t gates_at = layer_row(s, layer, all * s.batch, sheet, tile.begin);
      load_tile(tile, last, LEARN_NARROW, s.outputs + before * H4, H4);
      __syncthreads();
      for (int item = threadIdx.x; item < LEARN_TILE / ROWS * (H4 / UNITS); item += THREADS) {
        const int row = item % (LEARN_TILE / ROWS), unit = item / (LEARN_TILE / ROWS) * UNITS;
        float sums[GATE_SUMS][ROWS][UNITS];
#pragma unroll
        for (int gate = 0; gate < GATES; gate++)
#pragma unroll
          for (int r = 0; r < ROWS; r++) load_units<UNITS>(matrix + H4 * CORE_COLUMNS + gate * H4 + unit, sums[gate][r]);
        add_products<GATES, GATE_SUMS, UNITS, -1>(sums, x + row * x_stride, LEARN_TILE / ROWS * x_stride, matrix + unit, CORE_COLUMNS, H4, H4);
#if CORE >= 3
        const float* recurrent = matrix + GATES_SIZE;
#pragma unroll
        for (int gate = 0; gate < GATES; gate++) {
          float bias[UNITS];
          load_units<UNITS>(recurrent + H4 * CORE_COLUMNS + gate * H4 + unit, bias);
#pragma unroll
          for (int r = 0; r < ROWS; r++)
#pragma unroll
            for (int u = 0; u < UNITS; u++) {
              if (CORE == 3 && gate == 2) sums[GATE_SUMS - 1][r][u] = bias[u];
              else sums[gate][r][u] += bias[u];
            }
        }
        add_products<GATES, GATE_SUMS, UNITS, CORE == 3 ? 2 : -1>(sums, last + row * LEARN_NARROW, LEARN_TILE / ROWS * LEARN_NARROW,
            recurrent + unit, CORE_COLUMNS, H4, H4);
#endif
#pragma unroll
        for (int r = 0; r < ROWS; r++) {
          const int place = row + r * (LEARN_TILE / ROWS);
          const bool kept = place < tile.count;
#pragma unroll
          for (int u = 0; u < UNITS; u++) {
            float own[GATE_SUMS], cell = 0.0f;
#pragma unroll
            for (int gate = 0; gate < GATE_SUMS; gate++) own[gate] = sums[gate][r][u];
#if CORE == 4
            if (kept) cell = s.cells[(before + place) * H4 + unit + u];
#endif
            // Padding has no state: the sums there are zero, their gates are not.
            const bool is_unit = unit + u < H;
            const float state = unit_forward(own, last[place * LEARN_NARROW + unit + u], &cell);
            y[place * y_stride + unit + u] = is_unit ? state : 0.0f;
#if CORE == 4
            if (kept) s.cells[(after + place) * H4 + unit + u] = is_unit ? cell : 0.0f;
#endif
            if (kept)
#pragma unroll
              for (int gate = 0; gate < GATE_SUMS; gate++) s.gates[(gates_at + place) * SLOTS + gate * H4 + unit + u] = own[gate];
          }
        }
      }
      __syncthreads();
      store_tile(tile, s.outputs + after * H4, H4, y, y_stride);
      matrix += CORE_SIZE;
      float* swap = x;
      x = y;
      y = swap;
      const int stride = x_stride;
      x_stride = y_stride;
      y_stride = stride;
    }
    __syncthreads();
    tile_product<LEARN_TILE, true>(x, x_stride, y, y_stride, matrix, H4, H4, true);
    matrix += MIXER_SIZE;
    __syncthreads();
    store_tile(tile, s.mixed + at * H4, H4, y, y_stride);
    tile_product<LEARN_TILE, true>(y, y_stride, last, LEARN_NARROW, matrix, H4, OUT4, false);
    __syncthreads();
    store_tile(tile, s.output + at * OUT4, OUT4, last, LEARN_NARROW);
    __syncthreads();
  }
}

// The predicted state of a particle from its own and the decoder's output, before it is limited.
__device__ __forceinline__ Body unlimited(const Plan& s, const Body& body, const float* output) {
  Body next;
#pragma unroll
  for (int a = 0; a < DIM; a++) {
    const Fall fall = ballistic(s, body, a);
    next.v[a] = fmaf(s.unit, output[a], fall.v);
    next.x[a] = fmaf(multiply_rounded(s.unit, s.dt), output[DIM + a], fall.x);
  }
  return next;
}
__device__ __forceinline__ float limited(float v, float low, float high) { return fminf(fmaxf(v, low), high); }
__device__ __forceinline__ Body limited_body(const Plan& s, Body body) {
#pragma unroll
  for (int a = 0; a < DIM; a++) {
    body.v[a] = limited(body.v[a], s.slowest[a], s.fastest[a]);
    body.x[a] = limited(body.x[a], s.wall_lower[a], s.wall_upper[a]);
  }
  return body;
}
// What a frame is to predict; of an observed frame, what the network is shown.
__device__ __forceinline__ Body truth_of(const Plan& s, const Window& window, u32 n, int t, int b, u32 p) {
  if (t + 1 < s.warm_up) return s.states[particle_row(s, (t + 1) * s.batch + b, p)];
  return mirror(s.store[window.first + (u64)(t + 1) * n + p], window, s.sides);
}
__device__ __forceinline__ Body error_weight(const Plan& s, const Window& window, int t, int b, u32 p) {
  const int k = max(t - (s.warm_up - 1), 0), kind = s.material[(size_t)window.stream * s.most + p];
  Body weight = s.error_weights[(size_t)s.progress->step * s.weights_step + ((size_t)k * s.batch + b) * MATERIALS + kind];
  if (t < s.warm_up - 1)
#pragma unroll
    for (int a = 0; a < DIM; a++) {
      weight.x[a] *= s.even;
      weight.v[a] *= s.even;
    }
  return weight;
}
// Predictions of sheets from `first` on: sums of weighted squares, and the next frame's state where the network goes on from it.
// grid (ceil(most / 256), sheets), block 256
extern "C" __global__ void __launch_bounds__(256) train_advance(const Plan* __restrict__ plan, int first) {
  const Plan& s = *plan;
  const int sheet = first + blockIdx.y, t = sheet / s.batch, b = sheet % s.batch;
  const u32 p = blockIdx.x * 256 + threadIdx.x, n = particles_of(s, b);
  float sum = 0.0f;
  if (p < n) {
    const Window& window = window_of(s, b);
    const size_t at = particle_row(s, sheet, p);
    const Body found = limited_body(s, unlimited(s, s.states[at], s.output + at * OUT4));
    if (t + 1 >= s.warm_up && t + 1 < frames_of(s)) s.states[at + (size_t)s.batch * s.most] = found;
    const Body truth = truth_of(s, window, n, t, b, p), weight = error_weight(s, window, t, b, p);
#pragma unroll
    for (int a = 0; a < DIM; a++) {
      const float dx = found.x[a] - truth.x[a], dv = found.v[a] - truth.v[a];
      sum += weight.x[a] * dx * dx + weight.v[a] * dv * dv;
    }
  }
  sum = block_sum(sum);
  if (threadIdx.x == 0) s.squares[(size_t)sheet * gridDim.x + blockIdx.x] = sum;
}
