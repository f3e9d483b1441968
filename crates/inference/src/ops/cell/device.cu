// The recurrent cell of a network, one unit at a time: the new state from the sums, and the gradients. `mod.rs` has the equations. Compiled for
//   MLP, LSTM, GRU, MINLSTM or MINGRU  the core
//   GATES       sums that the input gives
//   RECURRENT   1: the last output is multiplied too
//   SPLIT_GATE  the gate whose part from the last output is a sum of its own, behind the gates: the last gate, or GATES if there is none
//   REMEMBERS   1: the new state depends on the last one
//   STATES      numbers of a unit's state: output, and the cell of LSTM
//   LOG_FORM, NORMALIZED  forms of the minimal recurrences
// and for the functions `sigmoid`, `hyperbolic_tangent`, `activate`, `activation_slope` and `divide`.
#define GATE_SUMS (GATES + (SPLIT_GATE < GATES))
#if SPLIT_GATE < GATES - 1
#error "the split gate must be the last one"
#endif

// What is added to f + i of minLSTM, which is zero in f32 if both gates are closed.
#define MIN_GATE_SUM 1e-12f

// The candidate as it enters the state, and its derivative.
__device__ __forceinline__ float candidate(float c) {
#if LOG_FORM
  return c >= 0.0f ? c + 0.5f : sigmoid(c);
#else
  return c;
#endif
}
__device__ __forceinline__ float candidate_slope(float c) {
#if LOG_FORM
  const float s = sigmoid(c);
  return c >= 0.0f ? 1.0f : s * (1.0f - s);
#else
  return 1.0f;
#endif
}

// The new state in place of the last one. In GRU and LSTM, what the gradient needs takes the place of the sums.
__device__ __forceinline__ void cell_forward(float* sums, float* state) {
#if MLP
  state[0] = activate(sums[0]);
#elif MINGRU
  const float z = sigmoid(sums[0]);
  state[0] = fmaf(1.0f - z, state[0], z * candidate(sums[1]));
#elif MINLSTM
  const float f = sigmoid(sums[0]), i = sigmoid(sums[1]), c = candidate(sums[2]);
#if NORMALIZED
  const float u = divide(i, f + i + MIN_GATE_SUM);
  state[0] = fmaf(1.0f - u, state[0], u * c);
#else
  state[0] = fmaf(f, state[0], i * c);
#endif
#elif GRU
  const float r = sigmoid(sums[0]), z = sigmoid(sums[1]), n = hyperbolic_tangent(fmaf(r, sums[3], sums[2]));
  sums[0] = r;
  sums[1] = z;
  sums[2] = n;
  state[0] = fmaf(z, state[0] - n, n);
#elif LSTM
  const float i = sigmoid(sums[0]), f = sigmoid(sums[1]), g = hyperbolic_tangent(sums[2]), o = sigmoid(sums[3]);
  sums[0] = i;
  sums[1] = f;
  sums[2] = g;
  sums[3] = o;
  state[1] = fmaf(f, state[1], i * g);
  state[0] = o * hyperbolic_tangent(state[1]);
#else
#error "this core has no cell"
#endif
}

// The gradients by the sums in their place, and by the last state in the place of those by the new one, `by`. The sums are as `cell_forward` left
// them. In GRU and LSTM, the gradient by the last output lacks its part through the sums.
__device__ __forceinline__ void cell_gradient(float* sums, const float* last, const float* next, float* by) {
#if MLP
  sums[0] = by[0] * activation_slope(next[0]);
  by[0] = 0.0f;
#elif MINGRU
  const float z = sigmoid(sums[0]), c = candidate(sums[1]);
  sums[0] = by[0] * (c - last[0]) * z * (1.0f - z);
  sums[1] = by[0] * z * candidate_slope(sums[1]);
  by[0] = by[0] * (1.0f - z);
#elif MINLSTM
  const float f = sigmoid(sums[0]), i = sigmoid(sums[1]), c = candidate(sums[2]);
#if NORMALIZED
  const float inverse = divide(1.0f, f + i + MIN_GATE_SUM), u = i * inverse, by_share = by[0] * (c - last[0]) * inverse;
  const float by_f = -by_share * u, by_i = by_share * (1.0f - u), by_c = by[0] * u, by_last = by[0] * (1.0f - u);
#else
  const float by_f = by[0] * last[0], by_i = by[0] * c, by_c = by[0] * i, by_last = by[0] * f;
#endif
  sums[0] = by_f * f * (1.0f - f);
  sums[1] = by_i * i * (1.0f - i);
  sums[2] = by_c * candidate_slope(sums[2]);
  by[0] = by_last;
#elif GRU
  const float r = sums[0], z = sums[1], n = sums[2], by_n = by[0] * (1.0f - z) * (1.0f - n * n);
  sums[0] = by_n * sums[3] * r * (1.0f - r);
  sums[1] = by[0] * (last[0] - n) * z * (1.0f - z);
  sums[2] = by_n;
  sums[3] = by_n * r;
  by[0] = by[0] * z;
#elif LSTM
  const float i = sums[0], f = sums[1], g = sums[2], o = sums[3], t = hyperbolic_tangent(next[1]), by_c = fmaf(by[0] * o, 1.0f - t * t, by[1]);
  sums[0] = by_c * g * i * (1.0f - i);
  sums[1] = by_c * last[1] * f * (1.0f - f);
  sums[2] = by_c * i * (1.0f - g * g);
  sums[3] = by[0] * t * o * (1.0f - o);
  by[0] = 0.0f;
  by[1] = by_c * f;
#else
#error "this core has no gradient"
#endif
}
