// The recurrent cells of both networks, one unit at a time: the new state from the sums of the gates, and the gradients backwards.
// References keep what the way back needs: of GRU and LSTM the gates take the place of their sums. The gradients by the sums then take
// that place. The layers that give the sums are elsewhere.

// What is added to f + i of minLSTM, which is zero in f32 if both gates are closed (`kernels/minimal.rs`).
#define MIN_GATE_SUM 1e-12f

// Candidates of the log form are made positive (Feng et al. 2024, appendix B).
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

// minGRU: h_t = (1 - z) h_{t-1} + z c with z = sigmoid(z').
__device__ __forceinline__ float mingru(float z, float c, float last) {
  z = sigmoid(z);
  return fmaf(1.0f - z, last, z * candidate(c));
}
// Returns the gradient by the last state, from the one by the new state.
__device__ __forceinline__ float mingru_gradient(float& z_sum, float& c_sum, float last, float by) {
  const float z = sigmoid(z_sum), c = candidate(c_sum);
  z_sum = by * (c - last) * z * (1.0f - z);
  c_sum = by * z * candidate_slope(c_sum);
  return by * (1.0f - z);
}

// minLSTM: h_t = f h_{t-1} + i c with f = sigmoid(f'), i = sigmoid(i'); normalised: h_t = (1 - u) h_{t-1} + u c, u = i / (f + i).
__device__ __forceinline__ float minlstm(float f, float i, float c, float last) {
  f = sigmoid(f);
  i = sigmoid(i);
  c = candidate(c);
#if NORMALIZED
  const float u = divide(i, f + i + MIN_GATE_SUM);
  return fmaf(1.0f - u, last, u * c);
#else
  return fmaf(f, last, i * c);
#endif
}
__device__ __forceinline__ float minlstm_gradient(float& f_sum, float& i_sum, float& c_sum, float last, float by) {
  const float f = sigmoid(f_sum), i = sigmoid(i_sum), c = candidate(c_sum);
#if NORMALIZED
  const float inverse = divide(1.0f, f + i + MIN_GATE_SUM), u = i * inverse, by_share = by * (c - last) * inverse;
  const float by_f = -by_share * u, by_i = by_share * (1.0f - u), by_c = by * u, by_last = by * (1.0f - u);
#else
  const float by_f = by * last, by_i = by * c, by_c = by * i, by_last = by * f;
#endif
  f_sum = by_f * f * (1.0f - f);
  i_sum = by_i * i * (1.0f - i);
  c_sum = by_c * candidate_slope(c_sum);
  return by_last;
}

// GRU as PyTorch has it: r = sigmoid(r'), z = sigmoid(z'), n = tanh(n' + r n_h), h_t = (1 - z) n + z h_{t-1}. n_h is the part of the last
// state, n' that of the input; r' and z' have both.
__device__ __forceinline__ float gru(float& r, float& z, float& n, float n_h, float last) {
  r = sigmoid(r);
  z = sigmoid(z);
  n = hyperbolic_tangent(fmaf(r, n_h, n));
  return fmaf(z, last - n, n);
}
// The gradient by n_h takes its place. What is returned lacks the part through the sums.
__device__ __forceinline__ float gru_gradient(float& r, float& z, float& n, float& n_h, float last, float by) {
  const float by_n = by * (1.0f - z) * (1.0f - n * n), by_last = by * z;
  z = by * (last - n) * z * (1.0f - z);
  n = by_n;
  const float by_n_h = by_n * r;
  r = by_n * n_h * r * (1.0f - r);
  n_h = by_n_h;
  return by_last;
}

// LSTM as PyTorch has it: c_t = f c_{t-1} + i g, h_t = o tanh(c_t) with sigmoids of i', f', o' and g = tanh(g').
__device__ __forceinline__ float lstm(float& i, float& f, float& g, float& o, float& cell) {
  i = sigmoid(i);
  f = sigmoid(f);
  g = hyperbolic_tangent(g);
  o = sigmoid(o);
  cell = fmaf(f, cell, i * g);
  return o * hyperbolic_tangent(cell);
}
// `by_cell` is the gradient by the new cell from later frames, and becomes the one by the last cell.
__device__ __forceinline__ void lstm_gradient(float& i, float& f, float& g, float& o, float last_cell, float cell, float by, float& by_cell) {
  const float t = hyperbolic_tangent(cell), by_c = fmaf(by * o, 1.0f - t * t, by_cell);
  by_cell = by_c * f;
  f = by_c * last_cell * f * (1.0f - f);
  const float by_i = by_c * g * i * (1.0f - i);
  g = by_c * i * (1.0f - g * g);
  i = by_i;
  o = by * t * o * (1.0f - o);
}
