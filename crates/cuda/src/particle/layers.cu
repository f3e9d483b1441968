// The particle model's layers on particles (`engine/particle_blocks.rs` of eddy-inference), and what goes from them to the nodes. Matrices are
// [in4, gates, out4], the biases [gates, out4] behind them; padding is zero. In shared memory rows are padded so that
// threads of neighbouring rows use different banks.
//
// The kernels with particles are a fused form of the plan: a tile stays in shared memory from its features to the encoder's outputs, and
// from what it gathers to the prediction. With a kernel for each operation, a frame takes 12 % longer for a stream of 2,500 particles, 6 %
// for 64 of them, 20 % for one of 1,000,000 (H200, without rules).
// An odd multiple of 4, at least w.
#define ODD4(w) ((w) / 4 % 2 ? (w) : (w) + 4)
#define CONCAT (F4 + C04)
#define WIDEST(a, b) ((a) > (b) ? (a) : (b))

// Features and encoder. grid (ceil(n / TILE), B), block THREADS, shared memory: TILE rows of features, of the hidden layer, and
// of outputs
extern "C" __global__ void __launch_bounds__(THREADS) particle_encode(const Stream* __restrict__ streams, const float* __restrict__ first,
    const float* __restrict__ second) {
  DYNAMIC_SHARED(float, shared);
  float *x = shared, *hidden = x + TILE * ODD4(F4), *encoded = hidden + TILE * ODD4(E4);
  const Stream& s = streams[blockIdx.y];
  const u32 n = s.particles;
  for (u32 begin = blockIdx.x * TILE; begin < n; begin += gridDim.x * TILE) {
    const int count = (int)min((u32)TILE, n - begin);
    for (int row = threadIdx.x; row < TILE; row += THREADS) {
      float* own = x + row * ODD4(F4);
      for (int k = 0; k < F4; k++) own[k] = 0.0f;
      if (row >= count) continue;
      const u32 p = s.order[begin + row];
      const Body body = s.bodies[p];
      float expected[2];
#pragma unroll
      for (int a = 0; a < 2; a++) {
        expected[a] = s.begun ? s.expected[2 * p + a] : body.v[a];
        s.expected[2 * p + a] = ballistic(s, body, a).v;
      }
      motion_features(s, body, expected, own);
      rest_shape(s.first, s.links, s.bodies, p, body, own + SHAPE_FROM);
      matter_features(s.material[p], s.stiffness, own);
    }
    __syncthreads();
    for (int i = threadIdx.x; i < count * (F4 / 4); i += THREADS)
      ((float4*)s.features)[(size_t)begin * (F4 / 4) + i] = *(const float4*)(x + i / (F4 / 4) * ODD4(F4) + i % (F4 / 4) * 4);
    tile_linear(x, ODD4(F4), hidden, ODD4(E4), first, F4, E4, true);
    __syncthreads();
    tile_linear(hidden, ODD4(E4), encoded, ODD4(C04), second, E4, C04, false);
    __syncthreads();
    for (int i = threadIdx.x; i < count * (C04 / 4); i += THREADS)
      ((float4*)s.encoded)[(size_t)begin * (C04 / 4) + i] = *(const float4*)(encoded + i / (C04 / 4) * ODD4(C04) + i % (C04 / 4) * 4);
  }
}

// The inputs of nodes, and a node of the same body before each, where bodies are looked for.
// grid (nodes (QUADS + 1) / WARP, B), block TO_NODES_THREADS
#define TO_NODES_THREADS (STENCIL_ROWS * WARP)
extern "C" __global__ void __launch_bounds__(TO_NODES_THREADS) particle_to_nodes(const Stream* __restrict__ streams) {
  const Stream& s = streams[blockIdx.y];
  const u32 total = s.totals[0], across = s.across[0];
  for (u32 first = blockIdx.x * WARP; first < total * (QUADS + 1); first += gridDim.x * WARP) {
    const u32 item = first + lane_of(), node = item / (QUADS + 1);
    const int quad = item % (QUADS + 1);
    const u32 entry = node < total ? s.lists[0][node] : MISSING;
    const NodeSum found = sum_around<1>(s, entry, s.starts, s.weights,
        [&](u32 slot) { return quad < QUADS ? s.encoded + (size_t)slot * C04 + 4 * quad : nullptr; });
    if (threadIdx.x < WARP && entry != MISSING) {
      write_node_inputs(s, entry, quad, found, s.fields[0] + (size_t)node * INPUT4);
      if (quad == QUADS && s.parents) {
        // The smallest neighbour.
        const u32 before[4] = {entry - across - 1, entry - across, entry - across + 1, entry - 1};
        u32 parent = node;
        for (int i = 3; i >= 0; i--) {
          const u32 other = s.maps[0][before[i]];
          if (other != MISSING) parent = other;
        }
        s.parents[node] = parent;
      }
    }
    __syncthreads();
  }
}

#define UNITS (GATE_SUMS > 2 ? 2 : 4)
#define CORE_COLUMNS (GATES * H4)
#define CORE_MATRIX ((H4 + 1) * CORE_COLUMNS)

// Gather from the nodes, context, core, decoder, and the predicted motion. `w` has the matrices of context, core (input, then
// recurrent), mixer and decoder one behind the other.
// grid (ceil(n / TILE), B), block THREADS, shared memory: two lists of TILE rows; if the core remembers, also the states;
// each particle's stencil
#define DECODE_WIDE ODD4(WIDEST(CONCAT, H4))
#define DECODE_NARROW ODD4(H4)
extern "C" __global__ void __launch_bounds__(THREADS) particle_decode(const Stream* __restrict__ streams, const float* __restrict__ w) {
  DYNAMIC_SHARED(float, shared);
  float *wide = shared, *narrow = wide + TILE * DECODE_WIDE, *states = narrow + TILE * DECODE_NARROW;
  Stencil* stencils = (Stencil*)(states + (REMEMBERS ? TILE * DECODE_NARROW : 0));
  const Stream& s = streams[blockIdx.y];
  const u32 n = s.particles;
  for (u32 begin = blockIdx.x * TILE; begin < n; begin += gridDim.x * TILE) {
    const int count = (int)min((u32)TILE, n - begin);
    for (int row = threadIdx.x; row < count; row += THREADS) {
      const u32 slot = begin + row;
#pragma unroll
      for (int i = 0; i < 3 * DIM; i++) stencils[row].weights[i / 3][i % 3] = s.weights[3 * DIM * (size_t)slot + i];
      set_rows(s, s.maps[0], s.cells[s.order[slot]], stencils[row]);
    }
    __syncthreads();
    for (int i = threadIdx.x; i < TILE * (CONCAT / 4); i += THREADS) {
      const int row = i / (CONCAT / 4), k = i % (CONCAT / 4);
      float4 sum = {0.0f, 0.0f, 0.0f, 0.0f};
      if (row < count && k < F4 / 4) {
        sum = ((const float4*)s.features)[(size_t)(begin + row) * (F4 / 4) + k];
      } else if (row < count) {
        sum = gathered_quad(stencils[row], s.fields[2], C04, k - F4 / 4);
      }
      *(float4*)(wide + row * DECODE_WIDE + 4 * k) = sum;
    }
    __syncthreads();
    const float* matrix = w;
    tile_linear(wide, DECODE_WIDE, narrow, DECODE_NARROW, matrix, CONCAT, H4, true);
    matrix += (CONCAT + 1) * H4;
    float *x = narrow, *y = wide;
    int x_stride = DECODE_NARROW, y_stride = DECODE_WIDE;
    for (int layer = 0; layer < LAYERS; layer++) {
#if REMEMBERS
      float* remembered = s.hidden + (size_t)layer * n * H4;
      for (int i = threadIdx.x; i < TILE * (H4 / 4); i += THREADS) {
        const int row = i / (H4 / 4), k = i % (H4 / 4);
        *(float4*)(states + row * DECODE_NARROW + 4 * k) =
            row < count ? ((const float4*)remembered)[(size_t)s.order[begin + row] * (H4 / 4) + k] : float4{0.0f, 0.0f, 0.0f, 0.0f};
      }
#endif
      __syncthreads();
      for (int item = threadIdx.x; item < TILE / ROWS * (H4 / UNITS); item += THREADS) {
        const int row = item % (TILE / ROWS), unit = item / (TILE / ROWS) * UNITS;
        float sums[GATE_SUMS][ROWS][UNITS];
#pragma unroll
        for (int gate = 0; gate < GATES; gate++)
#pragma unroll
          for (int r = 0; r < ROWS; r++) load_units<UNITS>(matrix + H4 * CORE_COLUMNS + gate * H4 + unit, sums[gate][r]);
        add_products<GATES, GATE_SUMS, UNITS, GATES>(sums, x + row * x_stride, TILE / ROWS * x_stride, matrix + unit, CORE_COLUMNS, H4, H4);
#if RECURRENT
        const float* recurrent = matrix + CORE_MATRIX;
#pragma unroll
        for (int gate = 0; gate < GATES; gate++) {
          float bias[UNITS];
          load_units<UNITS>(recurrent + H4 * CORE_COLUMNS + gate * H4 + unit, bias);
#pragma unroll
          for (int r = 0; r < ROWS; r++)
#pragma unroll
            for (int u = 0; u < UNITS; u++) {
              if (gate == SPLIT_GATE) sums[GATE_SUMS - 1][r][u] = bias[u];
              else sums[gate][r][u] += bias[u];
            }
        }
        add_products<GATES, GATE_SUMS, UNITS, SPLIT_GATE>(sums, states + row * DECODE_NARROW, TILE / ROWS * DECODE_NARROW,
            recurrent + unit, CORE_COLUMNS, H4, H4);
#endif
#pragma unroll
        for (int r = 0; r < ROWS; r++) {
          const int place = row + r * (TILE / ROWS);
#pragma unroll
          for (int u = 0; u < UNITS; u++) {
            float gates[GATE_SUMS], state[STATES] = {};
#pragma unroll
            for (int gate = 0; gate < GATE_SUMS; gate++) gates[gate] = sums[gate][r][u];
#if REMEMBERS
            state[0] = states[place * DECODE_NARROW + unit + u];
#endif
            float* own = s.hidden + ((size_t)layer * n + (place < count ? s.order[begin + place] : 0)) * H4 + unit + u;
#pragma unroll
            for (int i = 1; i < STATES; i++)
              if (place < count) state[i] = own[(size_t)i * LAYERS * n * H4];
            cell_forward(gates, state);
            y[place * y_stride + unit + u] = state[0];
#pragma unroll
            for (int i = 1; i < STATES; i++)
              if (place < count) own[(size_t)i * LAYERS * n * H4] = state[i];
          }
        }
      }
      __syncthreads();
#if REMEMBERS
      for (int i = threadIdx.x; i < count * (H4 / 4); i += THREADS) {
        const int row = i / (H4 / 4), k = i % (H4 / 4);
        ((float4*)remembered)[(size_t)s.order[begin + row] * (H4 / 4) + k] = *(const float4*)(y + row * y_stride + 4 * k);
      }
#endif
      matrix += (RECURRENT ? 2 : 1) * CORE_MATRIX;
      float* swap = x;
      x = y;
      y = swap;
      const int stride = x_stride;
      x_stride = y_stride;
      y_stride = stride;
    }
    __syncthreads();
    tile_linear(x, x_stride, y, y_stride, matrix, H4, H4, true);
    matrix += (H4 + 1) * H4;
    __syncthreads();
    tile_linear(y, y_stride, x, x_stride, matrix, H4, 4, false);
    __syncthreads();
    for (int row = threadIdx.x; row < count; row += THREADS) {
      const u32 p = s.order[begin + row];
      s.next[p] = limited(s, unlimited(s, s.bodies[p], x + row * x_stride));
    }
    __syncthreads();
  }
}

// Predictions to the memory of the host. grid (ceil(n / 256), B), block 256
extern "C" __global__ void __launch_bounds__(256) particle_store(const Stream* __restrict__ streams) {
  const Stream& s = streams[blockIdx.y];
  for (u32 p = first_thread(); p < s.particles; p += all_threads()) s.predicted[p] = s.next[p];
}
