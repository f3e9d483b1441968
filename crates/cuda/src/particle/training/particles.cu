// Frames forwards: features and encoder; what is gathered from the nodes, context, core and decoder; the predicted motion and
// its error. A warp has a tile of a window's particles; rows of a tile beyond the window are computed, but not kept.
//
// A fused form of the plan: a tile stays in shared memory, though its lists are also written for the gradients. With a kernel for each
// operation, a step takes 1 % (minLSTM) to 9 % (LSTM) longer (H200, 16 windows of 2,500 particles).

// A warp's tile: particles begin..begin + count of a window.
struct WarpTile { int b; u32 begin; int count; };
__device__ __forceinline__ WarpTile tile_of(const Plan& s, int b) {
  const u32 begin = (blockIdx.x * LEARN_WARPS + threadIdx.x / WARP) * WARP_ROWS, n = particles_of(s, b);
  return {b, begin, begin < n ? (int)min((u32)WARP_ROWS, n - begin) : 0};
}
// Rows of a tile from a list of rows of `width` numbers, and back.
__device__ __forceinline__ void load_tile(const WarpTile& tile, float* to, int to_stride, const float* from, int width) {
  for (int i = lane_of(); i < WARP_ROWS * (width / 4); i += WARP) {
    const int row = i / (width / 4), k = i % (width / 4);
    *(float4*)(to + row * to_stride + 4 * k) = quad_of(from + (size_t)row * width + 4 * k, row < tile.count);
  }
}
__device__ __forceinline__ void store_tile(const WarpTile& tile, float* to, int width, const float* from, int from_stride) {
  for (int i = lane_of(); i < tile.count * (width / 4); i += WARP) {
    const int row = i / (width / 4), k = i % (width / 4);
    *(float4*)(to + (size_t)row * width + 4 * k) = *(const float4*)(from + row * from_stride + 4 * k);
  }
}
__device__ __forceinline__ void store_units(float* to, const float* from) { *(float4*)to = float4{from[0], from[1], from[2], from[3]}; }
#define LEARN_THREADS (LEARN_WARPS * WARP)
// Shared memory of a warp whose rows have so many numbers.
__device__ __forceinline__ float* rows_of_warp(void* shared, int numbers) { return (float*)shared + threadIdx.x / WARP * WARP_ROWS * numbers; }
#define STENCIL_NUMBERS (int)(sizeof(PlacedStencil) / sizeof(float))

// Links of a window's particles: nowhere if no particle has a rest shape.
__device__ __forceinline__ const u32* first_of(const Plan& s, const u32* first, int b) {
  const Window& window = window_of(s, b);
  return first ? first + (size_t)(2 * window.stream + window.mirrored) * (s.most + 1) : nullptr;
}
// The features of a particle in a frame.
__device__ __forceinline__ void features_of(const Plan& s, int sheet, int b, u32 p, float* own) {
  const Body* bodies = s.states + particle_row(s, sheet, 0);
  const Body body = bodies[p];
  float expected[DIM];
#pragma unroll
  for (int a = 0; a < DIM; a++) expected[a] = sheet < s.batch ? body.v[a] : ballistic(s, s.states[particle_row(s, sheet - s.batch, p)], a).v;
  motion_features(s, body, expected, own);
  rest_shape(first_of(s, s.link_first, b), s.links, bodies, p, body, own + SHAPE_FROM);
  const u32 stream = window_of(s, b).stream;
  matter_features(s.material[(size_t)stream * s.most + p], s.stiffness[stream], own);
}

// Features and encoder of sheets from `first` on. Matrices are transposed. grid (ceil(most / (LEARN_WARPS WARP_ROWS)), sheets), block
// LEARN_THREADS, shared memory: of each row the features, the hidden layer, the outputs
extern "C" __global__ void __launch_bounds__(LEARN_THREADS) train_encode(const Plan* __restrict__ plan, const float* __restrict__ first_matrix,
    const float* __restrict__ second_matrix, int first) {
  DYNAMIC_SHARED(float, shared);
  float* x = rows_of_warp(shared, ODD4(F4) + ODD4(E4) + ODD4(C04));
  float *hidden = x + WARP_ROWS * ODD4(F4), *encoded = hidden + WARP_ROWS * ODD4(E4);
  const Plan& s = *plan;
  const int sheet = first + blockIdx.y, b = sheet % s.batch, row = lane_of();
  const WarpTile tile = tile_of(s, b);
  if (!tile.count) return;
  const size_t at = particle_row(s, sheet, tile.begin);
  if (row < WARP_ROWS) {
    float* own = x + row * ODD4(F4);
    for (int k = 0; k < F4; k++) own[k] = 0.0f;
    if (row < tile.count) features_of(s, sheet, b, tile.begin + row, own);
  }
  __syncwarp();
  for (int i = lane_of(); i < tile.count * (F4 / 4); i += WARP) {
    const int row = i / (F4 / 4), k = i % (F4 / 4);
    *(float4*)(s.inputs + (at + row) * CONCAT + 4 * k) = *(const float4*)(x + row * ODD4(F4) + 4 * k);
  }
  tile_layer(x, ODD4(F4), hidden, ODD4(E4), first_matrix, F4, E4, true);
  __syncwarp();
  store_tile(tile, s.hidden + at * E4, E4, hidden, ODD4(E4));
  tile_layer(hidden, ODD4(E4), encoded, ODD4(C04), second_matrix, E4, C04, false);
  __syncwarp();
  store_tile(tile, s.encoded + at * C04, C04, encoded, ODD4(C04));
}

// Matrices begin at multiples of 64.
#define ROUND64(n) (((n) + 63) / 64 * 64)
#define CONTEXT_SIZE ROUND64((CONCAT + 1) * H4)
#define GATES_SIZE ROUND64((H4 + 1) * CORE_COLUMNS)
#define CORE_SIZE ((RECURRENT ? 2 : 1) * GATES_SIZE)
#define MIXER_SIZE ROUND64((H4 + 1) * H4)
#define SLOTS (GATE_SUMS * H4)

// Gather from the nodes, context, core and decoder, for some frames of all windows, one after the other. `w` has the transposed
// matrices of context, core (input, then recurrent), mixer and decoder one behind the other.
// grid (ceil(most / (LEARN_WARPS WARP_ROWS)), B), block LEARN_THREADS, shared memory: of each row the input or the core's sums, two lists
// of units, the stencil
#define LEARN_WIDE ODD4(WIDEST(CONCAT, H4))
#define LEARN_NARROW ODD4(H4)
#define LEARN_SLOTS ODD4(SLOTS)
#define LEARN_LONGEST WIDEST(LEARN_WIDE, LEARN_SLOTS)
extern "C" __global__ void __launch_bounds__(LEARN_THREADS) train_decode(const Plan* __restrict__ plan, const float* __restrict__ w, int first, int frames) {
  DYNAMIC_SHARED(float, shared);
  float *wide = rows_of_warp(shared, LEARN_LONGEST + 2 * LEARN_NARROW + STENCIL_NUMBERS), *slots = wide;
  float *units = wide + WARP_ROWS * LEARN_LONGEST, *last = units + WARP_ROWS * LEARN_NARROW;
  PlacedStencil* stencils = (PlacedStencil*)(last + WARP_ROWS * LEARN_NARROW);
  const Plan& s = *plan;
  const int all = frames_of(s);
  const WarpTile tile = tile_of(s, blockIdx.y);
  if (!tile.count) return;
  for (int t = first; t < first + frames; t++) {
    const int sheet = t * s.batch + tile.b;
    const size_t at = particle_row(s, sheet, tile.begin);
    if (lane_of() < tile.count) stencils[lane_of()] = stencil_of(s, sheet, s.states[at + lane_of()]);
    __syncwarp();
    const float* field = s.fields[FIELDS - 1] + (size_t)sheet * s.nodes[0] * C04;
    for (int i = lane_of(); i < WARP_ROWS * (CONCAT / 4); i += WARP) {
      const int row = i / (CONCAT / 4), k = i % (CONCAT / 4);
      float4 sum = {0.0f, 0.0f, 0.0f, 0.0f};
      if (row < tile.count && k < F4 / 4) {
        sum = *(const float4*)(s.inputs + (at + row) * CONCAT + 4 * k);
      } else if (row < tile.count) {
        sum = gathered_quad(stencils[row], field, C04, k - F4 / 4);
        *(float4*)(s.inputs + (at + row) * CONCAT + 4 * k) = sum;
      }
      *(float4*)(wide + row * LEARN_WIDE + 4 * k) = sum;
    }
    __syncwarp();
    const float* matrix = w;
    tile_layer(wide, LEARN_WIDE, units, LEARN_NARROW, matrix, CONCAT, H4, true);
    matrix += CONTEXT_SIZE;
    __syncwarp();
    store_tile(tile, s.context + at * H4, H4, units, LEARN_NARROW);
    for (int layer = 0; layer < LAYERS; layer++) {
      const size_t before = layer_row(s, layer, (all + 1) * s.batch, sheet, tile.begin), after = before + (size_t)s.batch * s.most;
      const size_t gates_at = layer_row(s, layer, all * s.batch, sheet, tile.begin);
      load_tile(tile, last, LEARN_NARROW, s.outputs + before * H4, H4);
      tile_layer(units, LEARN_NARROW, slots, LEARN_SLOTS, matrix, H4, CORE_COLUMNS, false);
      __syncwarp();
#if RECURRENT
      // The split gate is the last one; its products with the state lie behind the gates.
      const float *recurrent = matrix + GATES_SIZE, *bias = recurrent + H4 * CORE_COLUMNS;
      tile_product<true>(last, LEARN_NARROW, slots, LEARN_SLOTS, recurrent, H4, bias, H4, SPLIT_GATE * H4, false);
#if SPLIT_GATE < GATES
      tile_product<false>(last, LEARN_NARROW, slots + GATES * H4, LEARN_SLOTS, recurrent + SPLIT_GATE * H4 * H4, H4, bias + SPLIT_GATE * H4, H4, H4, false);
#endif
      __syncwarp();
#endif
      for (int i = lane_of(); i < WARP_ROWS * (H4 / 4); i += WARP) {
        const int row = i / (H4 / 4), unit = i % (H4 / 4) * 4;
        const bool kept = row < tile.count;
        float sums[GATE_SUMS][4], states[STATES][4] = {};
#pragma unroll
        for (int gate = 0; gate < GATE_SUMS; gate++) load_units<4>(slots + row * LEARN_SLOTS + gate * H4 + unit, sums[gate]);
        load_units<4>(last + row * LEARN_NARROW + unit, states[0]);
#pragma unroll
        for (int i = 1; i < STATES; i++)
          if (kept) load_units<4>(s.cells + (before + row) * H4 + unit, states[i]);
#pragma unroll
        for (int u = 0; u < 4; u++) {
          float own[GATE_SUMS], state[STATES];
#pragma unroll
          for (int gate = 0; gate < GATE_SUMS; gate++) own[gate] = sums[gate][u];
#pragma unroll
          for (int i = 0; i < STATES; i++) state[i] = states[i][u];
          cell_forward(own, state);
          // Padding has no state: the sums there are zero, their gates are not.
#pragma unroll
          for (int i = 0; i < STATES; i++) states[i][u] = unit + u < H ? state[i] : 0.0f;
#pragma unroll
          for (int gate = 0; gate < GATE_SUMS; gate++) sums[gate][u] = own[gate];
        }
        store_units(units + row * LEARN_NARROW + unit, states[0]);
        if (!kept) continue;
#pragma unroll
        for (int i = 1; i < STATES; i++) store_units(s.cells + (after + row) * H4 + unit, states[i]);
#pragma unroll
        for (int gate = 0; gate < GATE_SUMS; gate++) store_units(s.gates + (gates_at + row) * SLOTS + gate * H4 + unit, sums[gate]);
      }
      __syncwarp();
      store_tile(tile, s.outputs + after * H4, H4, units, LEARN_NARROW);
      matrix += CORE_SIZE;
    }
    tile_layer(units, LEARN_NARROW, wide, LEARN_WIDE, matrix, H4, H4, true);
    matrix += MIXER_SIZE;
    __syncwarp();
    store_tile(tile, s.mixed + at * H4, H4, wide, LEARN_WIDE);
    tile_layer(wide, LEARN_WIDE, last, LEARN_NARROW, matrix, H4, OUT4, false);
    __syncwarp();
    store_tile(tile, s.output + at * OUT4, OUT4, last, LEARN_NARROW);
    __syncwarp();
  }
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
    const Body found = limited_in_training(s, unlimited(s, s.states[at], s.output + at * OUT4));
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
