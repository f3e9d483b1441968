// Frames backwards, the last ones first: the gradient by the decoder's output, through decoder, core and context, through what is
// gathered from the nodes and summed on them, through encoder and features to the state that was predicted.

// The gradient by the decoder's output of sheets from `first` on, in its place. `by_state` has the gradient by the state of the
// next frame, where the network went on from it; where this frame's was predicted as well, the gradient by it takes its place,
// but for the part through the network. grid (ceil(most / 256), sheets), block 256
extern "C" __global__ void __launch_bounds__(256) train_output_gradient(const Plan* __restrict__ plan, int first) {
  const Plan& s = *plan;
  const int sheet = first + blockIdx.y, t = sheet / s.batch, b = sheet % s.batch;
  const u32 p = blockIdx.x * 256 + threadIdx.x, n = particles_of(s, b);
  if (p >= n) return;
  const Window& window = window_of(s, b);
  const size_t at = particle_row(s, sheet, p);
  const Body body = s.states[at];
  float* output = s.output + at * OUT4;
  const Body next = unlimited(s, body, output), found = limited_in_training(s, next);
  const Body truth = truth_of(s, window, n, t, b, p), weight = error_weight(s, window, t, b, p);
  const bool free = t + 1 >= s.warm_up, goes_on = free && t + 1 < frames_of(s);
  const float scale = 2.0f * s.scales[(free ? 0 : s.batch) + b];
  Body& by_state = s.by_state[particle_row(s, b, p)];
#pragma unroll
  for (int a = 0; a < DIM; a++) {
    float gx = scale * weight.x[a] * (found.x[a] - truth.x[a]), gv = scale * weight.v[a] * (found.v[a] - truth.v[a]);
    if (goes_on) {
      gx += by_state.x[a];
      gv += by_state.v[a];
    }
    step_gradient(s, body, next, a, gx, gv, output);
    if (t >= s.warm_up) {
      by_state.x[a] = gx;
      by_state.v[a] = gv;
    }
  }
}

// Where a tile's numbers of a layer with ReLU are not positive, there is no gradient by its sums; nor where there is no particle.
__device__ __forceinline__ void mask_tile(const WarpTile& tile, float* by, int stride, const float* outputs, int width) {
  for (int i = lane_of(); i < WARP_ROWS * (width / 4); i += WARP) {
    const int row = i / (width / 4), k = i % (width / 4) * 4;
    const float4 output = quad_of(outputs + (size_t)row * width + k, row < tile.count);
    float4& own = *(float4*)(by + row * stride + k);
    if (!(output.x > 0.0f)) own.x = 0.0f;
    if (!(output.y > 0.0f)) own.y = 0.0f;
    if (!(output.z > 0.0f)) own.z = 0.0f;
    if (!(output.w > 0.0f)) own.w = 0.0f;
  }
}

// Through decoder, mixer, core and context, for some frames of all windows, the last one first. `w` has the matrices in the order
// of `train_decode`. grid (ceil(most / (LEARN_WARPS WARP_ROWS)), B), block LEARN_THREADS, shared memory: of each row the core's sums or the
// input, two lists of units
extern "C" __global__ void __launch_bounds__(LEARN_THREADS) train_decode_gradient(const Plan* __restrict__ plan, const float* __restrict__ w, int first, int frames) {
  DYNAMIC_SHARED(float, shared);
  float *slots = rows_of_warp(shared, LEARN_LONGEST + 2 * LEARN_NARROW), *wide = slots;
  float *x = slots + WARP_ROWS * LEARN_LONGEST, *y = x + WARP_ROWS * LEARN_NARROW;
  const Plan& s = *plan;
  const int all = frames_of(s);
  const WarpTile tile = tile_of(s, blockIdx.y);
  if (!tile.count) return;
  const float* mixer = w + CONTEXT_SIZE + LAYERS * CORE_SIZE;
  for (int t = first + frames - 1; t >= first; t--) {
    const int sheet = t * s.batch + tile.b;
    const size_t at = particle_row(s, sheet, tile.begin), here = particle_row(s, (t - first) * s.batch + tile.b, tile.begin);
    load_tile(tile, x, LEARN_NARROW, s.output + at * OUT4, OUT4);
    __syncwarp();
    tile_gradient(x, LEARN_NARROW, y, LEARN_NARROW, mixer + MIXER_SIZE, H4, OUT4);
    __syncwarp();
    mask_tile(tile, y, LEARN_NARROW, s.mixed + at * H4, H4);
    __syncwarp();
    store_tile(tile, s.by_mixed + at * H4, H4, y, LEARN_NARROW);
    tile_gradient(y, LEARN_NARROW, x, LEARN_NARROW, mixer, H4, H4);
    for (int layer = LAYERS - 1; layer >= 0; layer--) {
      const float* matrix = w + CONTEXT_SIZE + layer * CORE_SIZE;
      const size_t before = layer_row(s, layer, (all + 1) * s.batch, sheet, tile.begin), after = before + (size_t)s.batch * s.most;
      const size_t gates_at = layer_row(s, layer, all * s.batch, sheet, tile.begin), carried = layer_row(s, layer, s.batch, tile.b, tile.begin);
      __syncwarp();
      for (int i = lane_of(); i < WARP_ROWS * (H4 / 4); i += WARP) {
        const int row = i / (H4 / 4), unit = i % (H4 / 4) * 4;
        float sums[GATE_SUMS][4];
#pragma unroll
        for (int gate = 0; gate < GATE_SUMS; gate++)
#pragma unroll
          for (int u = 0; u < 4; u++) sums[gate][u] = 0.0f;
        if (row < tile.count) {
          const size_t number = (carried + row) * H4 + unit;
          float* own = s.gates + (gates_at + row) * SLOTS + unit;
          // Outputs and cells are lists of their own.
          float *const by_state[2] = {s.by_output, s.by_cell}, *const states[2] = {s.outputs, s.cells};
          float by[STATES][4] = {}, last[STATES][4], next[STATES][4];
#pragma unroll
          for (int gate = 0; gate < GATE_SUMS; gate++) load_units<4>(own + gate * H4, sums[gate]);
#pragma unroll
          for (int i = 0; i < STATES; i++) {
            if (REMEMBERS) load_units<4>(by_state[i] + number, by[i]);
            load_units<4>(states[i] + (before + row) * H4 + unit, last[i]);
            load_units<4>(states[i] + (after + row) * H4 + unit, next[i]);
          }
#pragma unroll
          for (int u = 0; u < 4; u++) {
            float one[GATE_SUMS], one_last[STATES], one_next[STATES], one_by[STATES];
#pragma unroll
            for (int gate = 0; gate < GATE_SUMS; gate++) one[gate] = sums[gate][u];
#pragma unroll
            for (int i = 0; i < STATES; i++) {
              one_last[i] = last[i][u];
              one_next[i] = next[i][u];
              one_by[i] = by[i][u];
            }
            one_by[0] += x[row * LEARN_NARROW + unit + u];
            cell_gradient(one, one_last, one_next, one_by);
#pragma unroll
            for (int i = 0; i < STATES; i++) by[i][u] = one_by[i];
#pragma unroll
            for (int gate = 0; gate < GATE_SUMS; gate++) sums[gate][u] = one[gate];
          }
#pragma unroll
          for (int i = 0; i < STATES; i++)
            if (REMEMBERS) store_units(by_state[i] + number, by[i]);
#pragma unroll
          for (int gate = 0; gate < GATE_SUMS; gate++) store_units(own + gate * H4, sums[gate]);
        }
#pragma unroll
        for (int gate = 0; gate < GATE_SUMS; gate++) store_units(slots + row * LEARN_SLOTS + gate * H4 + unit, sums[gate]);
      }
      __syncwarp();
#if RECURRENT
      // The gradient by the split gate's products lies behind the gates.
      const float* recurrent = matrix + GATES_SIZE;
      tile_product<false>(slots, LEARN_SLOTS, y, LEARN_NARROW, recurrent, CORE_COLUMNS, nullptr, SPLIT_GATE * H4, H4, false);
#if SPLIT_GATE < GATES
      tile_product<true>(slots + GATES * H4, LEARN_SLOTS, y, LEARN_NARROW, recurrent + SPLIT_GATE * H4, CORE_COLUMNS, nullptr, H4, H4, false);
#endif
      __syncwarp();
      for (int i = lane_of(); i < tile.count * H4; i += WARP) s.by_output[carried * H4 + i] += y[i / H4 * LEARN_NARROW + i % H4];
      __syncwarp();
#endif
      tile_gradient(slots, LEARN_SLOTS, x, LEARN_NARROW, matrix, H4, CORE_COLUMNS);
    }
    __syncwarp();
    mask_tile(tile, x, LEARN_NARROW, s.context + at * H4, H4);
    __syncwarp();
    store_tile(tile, s.by_context + at * H4, H4, x, LEARN_NARROW);
    tile_gradient(x, LEARN_NARROW, wide, LEARN_WIDE, w, CONCAT, H4);
    __syncwarp();
    store_tile(tile, s.by_inputs + here * CONCAT, CONCAT, wide, LEARN_WIDE);
    __syncwarp();
  }
}

// Derivatives of the weights of three nodes by the distance from the first (1 / cells).
__device__ __forceinline__ float weight_slope(float place, int node) {
  return node == 0 ? place - 1.5f : (node == 1 ? 2.0f - 2.0f * place : place - 0.5f);
}
// The gradient by an axis of a particle's place (cells) of the weight of a node of its stencil.
__device__ __forceinline__ float node_slope(const PlacedStencil& own, int node, int axis) {
  float product = 1.0f;
#pragma unroll
  for (int a = 0; a < DIM; a++) {
    const int digit = node % 3;
    product *= a == axis ? weight_slope(own.place[a], digit) : own.weights[a][digit];
    node /= 3;
  }
  return product;
}

// The gradient by a particle's state through its features, from the one by them; that by the deformation of the particle and
// by the velocity that was expected goes to lists.
__device__ __forceinline__ Body features_gradient(const Plan& s, int sheet, int b, u32 p, const float* by) {
  const Body* bodies = s.states + particle_row(s, sheet, 0);
  const Body body = bodies[p];
  // The next frame compares its velocity with the one that the ballistic step expects now.
  float* by_expected = s.by_expected + particle_row(s, b, p) * DIM;
  float by_coming[DIM];
#pragma unroll
  for (int a = 0; a < DIM; a++) by_coming[a] = by_expected[a];
  const Body found = motion_features_gradient(s, body, by, by_coming, by_expected);
  const u32* first = first_of(s, s.link_first, b);
  float* by_shape = s.by_shape + particle_row(s, b, p) * (DIM * DIM + DIM);
  for (int i = 0; i < DIM * DIM + DIM; i++) by_shape[i] = 0.0f;
  if (first && first[p] != first[p + 1]) rest_shape_gradient(s.links, first[p], first[p + 1], bodies, body, by + SHAPE_FROM, by_shape);
  return found;
}

// Through the sums on the nodes and the encoder, of sheets from `first` on; where the frame was predicted, one at a time, also
// through the features and the places on the grid, to `by_state`.
// grid (ceil(most / (LEARN_WARPS WARP_ROWS)), sheets), block LEARN_THREADS, shared memory: of each row the outputs, the hidden layer,
// the features, a number of each of its stencil's nodes, the stencil
extern "C" __global__ void __launch_bounds__(LEARN_THREADS) train_encode_gradient(const Plan* __restrict__ plan, const float* __restrict__ first_matrix,
    const float* __restrict__ second_matrix, int first, int predicted) {
  DYNAMIC_SHARED(float, shared);
  float* by_encoded = rows_of_warp(shared, ODD4(C04) + ODD4(E4) + ODD4(F4) + STENCIL + STENCIL_NUMBERS);
  float *by_hidden = by_encoded + WARP_ROWS * ODD4(C04), *by_features = by_hidden + WARP_ROWS * ODD4(E4);
  float* dots = by_features + WARP_ROWS * ODD4(F4);
  PlacedStencil* stencils = (PlacedStencil*)(dots + WARP_ROWS * STENCIL);
  const Plan& s = *plan;
  const int sheet = first + blockIdx.y, b = sheet % s.batch, lane = lane_of();
  const WarpTile tile = tile_of(s, b);
  if (!tile.count) return;
  const size_t at = particle_row(s, sheet, tile.begin), here = particle_row(s, blockIdx.y, tile.begin);
  const float* slopes = s.slopes[0] + (size_t)sheet * s.nodes[0] * INPUT4;
  const float* field = s.fields[FIELDS - 1] + (size_t)sheet * s.nodes[0] * C04;
  if (lane < tile.count) stencils[lane] = stencil_of(s, sheet, s.states[at + lane]);
  __syncwarp();
  for (int i = lane; i < WARP_ROWS * (C04 / 4); i += WARP) {
    const int row = i / (C04 / 4), k = i % (C04 / 4);
    float4 sum = {0.0f, 0.0f, 0.0f, 0.0f};
    if (row < tile.count) sum = gathered_quad(stencils[row], slopes, INPUT4, k);
    // Behind the channels are the mass and others.
    if (4 * k + 1 >= C0) sum.y = 0.0f;
    if (4 * k + 2 >= C0) sum.z = 0.0f;
    if (4 * k + 3 >= C0) sum.w = 0.0f;
    *(float4*)(by_encoded + row * ODD4(C04) + 4 * k) = sum;
  }
  __syncwarp();
  store_tile(tile, s.by_encoded + at * C04, C04, by_encoded, ODD4(C04));
  tile_gradient(by_encoded, ODD4(C04), by_hidden, ODD4(E4), second_matrix, E4, C04);
  __syncwarp();
  mask_tile(tile, by_hidden, ODD4(E4), s.hidden + at * E4, E4);
  __syncwarp();
  store_tile(tile, s.by_hidden + at * E4, E4, by_hidden, ODD4(E4));
  if (!predicted) return;
  tile_gradient(by_hidden, ODD4(E4), by_features, ODD4(F4), first_matrix, F4, E4);
  // What a node's numbers add up to for a particle: of those that it gathers, and of those that it is summed up in. Padding is zero
  // in what the particle has. Eight threads have a particle.
  for (int row = lane / 8; row < WARP_ROWS; row += WARP / 8) {
    const bool is = row < tile.count;
    float found[STENCIL];
#pragma unroll
    for (int node = 0; node < STENCIL; node++) found[node] = 0.0f;
    if (is)
      for (int c = lane % 8 * 4; c < C04; c += 32) {
        const float4 gathered = *(const float4*)(s.by_inputs + (here + row) * CONCAT + F4 + c), encoded = *(const float4*)(s.encoded + (at + row) * C04 + c);
#pragma unroll
        for (int node = 0; node < STENCIL; node++) {
          const size_t place = stencils[row].rows[node / 3] + node % 3;
          const float4 read = *(const float4*)(field + place * C04 + c), summed = *(const float4*)(slopes + place * INPUT4 + c);
          found[node] += gathered.x * read.x + gathered.y * read.y + gathered.z * read.z + gathered.w * read.w + encoded.x * summed.x
              + encoded.y * summed.y + encoded.z * summed.z + encoded.w * summed.w;
        }
      }
#pragma unroll
    for (int node = 0; node < STENCIL; node++) {
      for (int mask = 4; mask; mask /= 2) found[node] += shuffle_xor(found[node], mask);
      if (is && lane % 8 == 0) dots[row * STENCIL + node] = found[node] + slopes[(size_t)(stencils[row].rows[node / 3] + node % 3) * INPUT4 + C0];
    }
  }
  __syncwarp();
  if (lane >= tile.count) return;
  float by[F4];
  for (int k = 0; k < F4; k++) by[k] = by_features[lane * ODD4(F4) + k] + s.by_inputs[(here + lane) * CONCAT + k];
  const Body found = features_gradient(s, sheet, b, tile.begin + lane, by);
  Body& to = s.by_state[particle_row(s, b, tile.begin + lane)];
#pragma unroll
  for (int a = 0; a < DIM; a++) {
    float slope = 0.0f;
#pragma unroll
    for (int node = 0; node < STENCIL; node++) slope = fmaf(dots[lane * STENCIL + node], node_slope(stencils[lane], node, a), slope);
    to.x[a] += found.x[a] + slope / s.width;
    to.v[a] += found.v[a];
  }
}

// The part of the gradient by the positions through the shapes: a particle's own, and those that it is a neighbour in.
// grid (ceil(most / 256), B), block 256
extern "C" __global__ void __launch_bounds__(256) train_shape_gradient(const Plan* __restrict__ plan) {
  const Plan& s = *plan;
  const int b = blockIdx.y;
  const u32 p = blockIdx.x * 256 + threadIdx.x;
  if (p >= particles_of(s, b)) return;
  const u32 *first = first_of(s, s.link_first, b), *incoming = first_of(s, s.incoming_first, b);
  const float* own = s.by_shape + particle_row(s, b, p) * (DIM * DIM + DIM);
  float sum[2] = {0.0f, 0.0f};
  for (u32 i = first[p]; i < first[p + 1]; i++) {
    const Link link = s.links[i];
#pragma unroll
    for (int a = 0; a < 2; a++) sum[a] -= own[2 * a] * link.coefficient[0] + own[2 * a + 1] * link.coefficient[1] + own[4 + a] * link.share;
  }
  for (u32 i = incoming[p]; i < incoming[p + 1]; i++) {
    const Link link = s.incoming[i];
    const float* other = s.by_shape + particle_row(s, b, link.particle) * (DIM * DIM + DIM);
#pragma unroll
    for (int a = 0; a < 2; a++) sum[a] += other[2 * a] * link.coefficient[0] + other[2 * a + 1] * link.coefficient[1] + other[4 + a] * link.share;
  }
  Body& to = s.by_state[particle_row(s, b, p)];
#pragma unroll
  for (int a = 0; a < 2; a++) to.x[a] += sum[a];
}
