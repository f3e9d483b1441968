// The particle model's layers (`engine/particle_blocks.rs` and `engine/grid.rs` of eddy-inference). Matrices are
// [in4, gates, out4], the biases [gates, out4] behind them; padding is zero. In shared memory rows are padded so that
// threads of neighbouring rows use different banks.
#define F4 ROUND4(F)
#define E4 ROUND4(E)
#define C04 ROUND4(C0)
#define H4 ROUND4(H)
#define INPUT4 ROUND4(C0 + NODE_FEATURES)
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

// Sums over the particles around each node, in the order of their slots: means, mass, proximity to walls. A block has a node,
// each of its three warps the cells of one row of nodes. grid (.., B), block 96
extern "C" __global__ void __launch_bounds__(96) particle_to_nodes(const Stream* __restrict__ streams) {
  __shared__ float sums[3][32];
  const Stream& s = streams[blockIdx.y];
  const u32 total = s.totals[0], across = s.across;
  const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
  for (u32 node = blockIdx.x; node < total; node += gridDim.x) {
    const u32 entry = s.lists[0][node];
    const int column = (int)(entry % across), row = (int)(entry / across);
    const int at[2] = {column - ORIGIN, row - ORIGIN};
    // This is the node (i, warp) of the stencil of the cell (column - i, row - warp).
    const u32 last = entry - warp * across;
    float mass = 0.0f;
    if (threadIdx.x == 0 && s.parents) {
      // The smallest neighbour.
      const u32 before[4] = {entry - across - 1, entry - across, entry - across + 1, entry - 1};
      u32 parent = node;
      for (int i = 3; i >= 0; i--) {
        const u32 other = s.maps[0][before[i]];
        if (other != MISSING) parent = other;
      }
      s.parents[node] = parent;
    }
    // The slots of the three cells follow each other.
    const u32 begin = s.starts[last - 2], middle = s.starts[last - 1], right = s.starts[last], end = s.starts[last + 1];
    float* to = s.fields[0] + (size_t)node * INPUT4;
    for (int first = 0; first < C0 + 1; first += 32) {
      const int channel = first + lane;
      float sum = 0.0f;
#pragma unroll 8
      for (u32 slot = begin; slot < end; slot++) {
        const float* weights = s.weights + 6 * (size_t)slot;
        const float weight = weights[slot < middle ? 2 : (slot < right ? 1 : 0)] * weights[3 + warp];
        const float value = channel < C0 ? s.encoded[(size_t)slot * C04 + channel] : 1.0f;
        sum = fmaf(weight, value, sum);
        if (first == 0) mass += weight;
      }
      sums[warp][lane] = sum;
      __syncthreads();
      if (first == 0) {
        __shared__ float masses[3];
        if (lane == 0) masses[warp] = mass;
        __syncthreads();
        mass = masses[0] + masses[1] + masses[2];
      }
      if (warp == 0 && channel < C0) to[channel] = (sums[0][lane] + sums[1][lane] + sums[2][lane]) * (1.0f / (mass + MIN_MASS));
      __syncthreads();
    }
    if (threadIdx.x < INPUT4 - C0) {
      const int k = threadIdx.x;
      float value = k == 0 ? mass / FULL_MASS : 0.0f;
      if (k > 0 && k < NODE_FEATURES) value = node_proximity(s, at[(k - 1) & 1], (k - 1) & 1, k < 3 ? 0 : 1);
      to[C0 + k] = value;
    }
  }
}

// A layer on the nodes of a level, from one field to another: the 3 x 3 around a node (9 places), its children (4 places), or,
// from parents to children, its own row (1 place) with a matrix for each child and a field that is added. `inner` and `outputs`
// are the padded widths of the fields; `parts` threads share each sum.
// grid (.., B), block 256, shared memory: NODES rows of the gathered numbers; the parts of the sums
struct Layer { int places, level, from, to, skip, inner, outputs, rectified; };
extern "C" __global__ void __launch_bounds__(256) particle_grid_layer(const Stream* __restrict__ streams, const float* __restrict__ w, Layer layer,
    int parts) {
  DYNAMIC_SHARED(float, x);
  __shared__ u32 gathered[NODES * 9];
  const Stream& s = streams[blockIdx.y];
  const int level = layer.level, quarter = NODES / ROWS;
  const u32 total = s.totals[level], across = s.across >> level;
  const int inner = layer.places * layer.inner, stride = ODD4(inner), four = layer.inner / 4;
  const int children = layer.places == 1 ? 4 : 1, columns = children * layer.outputs, items = quarter * (columns / 4);
  const float* from = s.fields[layer.from];
  for (u32 begin = blockIdx.x * NODES; begin < total; begin += gridDim.x * NODES) {
    const int count = (int)min((u32)NODES, total - begin);
    for (int i = threadIdx.x; i < NODES * layer.places; i += 256) {
      const int row = i / layer.places, place = i % layer.places;
      u32 node = MISSING;
      if (row < count) {
        const u32 entry = s.lists[level][begin + row];
        if (layer.places == 9) {
          node = s.maps[level][entry + (place / 3 - 1) * (int)across + place % 3 - 1];
        } else if (layer.places == 4) {
          const u32 finer = 2 * across, corner = 2 * (entry / across) * finer + 2 * (entry % across);
          node = s.maps[level - 1][corner + (place >> 1) * finer + (place & 1)];
        } else {
          node = begin + row;
        }
      }
      gathered[i] = node;
    }
    __syncthreads();
#pragma unroll 4
    for (int i = threadIdx.x; i < NODES * layer.places * four; i += 256) {
      const int number = i / four, k = i % four, row = number / layer.places, place = number % layer.places;
      const u32 node = gathered[number];
      *(float4*)(x + row * stride + (place * four + k) * 4) =
          node == MISSING ? float4{0.0f, 0.0f, 0.0f, 0.0f} : ((const float4*)from)[(size_t)node * four + k];
    }
    __syncthreads();
    for (int item = threadIdx.x; item < items * parts || parts > 1; item += 256) {
      const int part = item / items, own = item % items, row = own % quarter, column = own / quarter * 4;
      float sums[1][ROWS][4];
      if (part < parts) {
        // The numbers in quadruples, shared out as evenly as they can be.
        const int first = inner / 4 * part / parts * 4, end = inner / 4 * (part + 1) / parts * 4;
#pragma unroll
        for (int r = 0; r < ROWS; r++)
#pragma unroll
          for (int u = 0; u < 4; u++) sums[0][r][u] = part ? 0.0f : w[(size_t)inner * columns + column + u];
        add_products<1, 1, 4, -1>(sums, x + row * stride + first, quarter * stride, w + (size_t)first * columns + column, columns, 0, end - first);
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
          int at = column;
          if (layer.places == 1) {
            const int child = column / layer.outputs;
            const u32 entry = s.lists[level][begin + node], finer = 2 * across, corner = 2 * (entry / across) * finer + 2 * (entry % across);
            target = s.maps[level - 1][corner + (child >> 1) * finer + (child & 1)];
            at = column % layer.outputs;
            if (target == MISSING) continue;
          }
          const size_t place = (size_t)target * layer.outputs + at;
#pragma unroll
          for (int u = 0; u < 4; u++) {
            float sum = sums[0][r][u];
            if (layer.places == 1) sum += s.fields[layer.skip][place + u];
            s.fields[layer.to][place + u] = layer.rectified && sum < 0.0f ? 0.0f : sum;
          }
        }
      }
      if (parts > 1) break;
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
// each particle's weights and nodes
#define DECODE_WIDE ODD4(WIDEST(CONCAT, H4))
#define DECODE_NARROW ODD4(H4)
extern "C" __global__ void __launch_bounds__(THREADS) particle_decode(const Stream* __restrict__ streams, const float* __restrict__ w) {
  DYNAMIC_SHARED(float, shared);
  float *wide = shared, *narrow = wide + TILE * DECODE_WIDE, *states = narrow + TILE * DECODE_NARROW;
  float (*weights)[6] = (float (*)[6])(states + (REMEMBERS ? TILE * DECODE_NARROW : 0));
  u32 (*nodes)[3] = (u32 (*)[3])(weights + TILE);
  const Stream& s = streams[blockIdx.y];
  const u32 n = s.particles;
  for (u32 begin = blockIdx.x * TILE; begin < n; begin += gridDim.x * TILE) {
    const int count = (int)min((u32)TILE, n - begin);
    for (int row = threadIdx.x; row < count; row += THREADS) {
      const u32 slot = begin + row, cell = s.cells[s.order[slot]];
#pragma unroll
      for (int i = 0; i < 6; i++) weights[row][i] = s.weights[6 * (size_t)slot + i];
#pragma unroll
      for (int j = 0; j < 3; j++) nodes[row][j] = s.maps[0][cell + j * s.across];
    }
    __syncthreads();
    for (int i = threadIdx.x; i < TILE * (CONCAT / 4); i += THREADS) {
      const int row = i / (CONCAT / 4), k = i % (CONCAT / 4);
      float4 sum = {0.0f, 0.0f, 0.0f, 0.0f};
      if (row < count && k < F4 / 4) {
        sum = ((const float4*)s.features)[(size_t)(begin + row) * (F4 / 4) + k];
      } else if (row < count) {
#pragma unroll
        for (int j = 0; j < 3; j++)
#pragma unroll
          for (int c = 0; c < 3; c++) {
            const float4 value = ((const float4*)s.fields[2])[(size_t)(nodes[row][j] + c) * (C04 / 4) + k - F4 / 4];
            const float weight = weights[row][c] * weights[row][3 + j];
            sum.x = fmaf(weight, value.x, sum.x);
            sum.y = fmaf(weight, value.y, sum.y);
            sum.z = fmaf(weight, value.z, sum.z);
            sum.w = fmaf(weight, value.w, sum.w);
          }
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
