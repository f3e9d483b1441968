// The ballistic step, and the particle model's step from the decoder's outputs to the next state, as `mod.rs`; `s` is a stream or the
// plan of a training, with walls, fall, dt, unit and limits of velocities.

// A comparison: NaN stays NaN.
__device__ __forceinline__ float clamped(float v, float low, float high) {
  const float raised = v < low ? low : v;
  return raised > high ? high : raised;
}
// The ballistic step of a particle on an axis (`Ballistic::step`); `free` is its velocity without walls, which stop it unless it
// `moves`.
struct Fall { float x, v, free; bool moves; };
template <class S> __device__ __forceinline__ Fall ballistic(const S& s, const Body& body, int axis) {
  const float free = body.v[axis] + s.fall[axis], mean = multiply_rounded(0.5f, body.v[axis] + free);
  const float to = body.x[axis] + multiply_rounded(mean, s.dt);
  const float raised = to > s.wall_lower[axis] ? to : s.wall_lower[axis];
  const float held = raised < s.wall_upper[axis] ? raised : s.wall_upper[axis];
  return {held, held == to ? free : 0.0f, free, held == to};
}
// The next state before it is limited.
template <class S> __device__ __forceinline__ Body unlimited(const S& s, const Body& body, const float* output) {
  Body next;
#pragma unroll
  for (int a = 0; a < DIM; a++) {
    const Fall fall = ballistic(s, body, a);
    next.v[a] = fmaf(output[a], s.unit, fall.v);
    next.x[a] = fmaf(output[DIM + a] * s.unit, s.dt, fall.x);
  }
  return next;
}
template <class S> __device__ __forceinline__ Body limited(const S& s, Body body) {
#pragma unroll
  for (int a = 0; a < DIM; a++) {
    body.v[a] = clamped(body.v[a], s.slowest[a], s.fastest[a]);
    body.x[a] = clamped(body.x[a], s.wall_lower[a], s.wall_upper[a]);
  }
  return body;
}
// The same for training: NaN becomes the lower limit.
template <class S> __device__ __forceinline__ Body limited_in_training(const S& s, Body body) {
#pragma unroll
  for (int a = 0; a < DIM; a++) {
    body.v[a] = fminf(fmaxf(body.v[a], s.slowest[a]), s.fastest[a]);
    body.x[a] = fminf(fmaxf(body.x[a], s.wall_lower[a]), s.wall_upper[a]);
  }
  return body;
}
// From the gradient by the next state on an axis, `next` being that before it is limited, to the ones by the state (in its place) and
// by the outputs.
template <class S> __device__ __forceinline__ void step_gradient(const S& s, const Body& body, const Body& next, int a, float& by_x, float& by_v, float* by_output) {
  // No gradient passes a limit.
  const float x = next.x[a] >= s.wall_lower[a] && next.x[a] <= s.wall_upper[a] ? by_x : 0.0f;
  const float v = next.v[a] >= s.slowest[a] && next.v[a] <= s.fastest[a] ? by_v : 0.0f;
  by_output[a] = s.unit * v;
  by_output[DIM + a] = multiply_rounded(s.unit, s.dt) * x;
  const bool moves = ballistic(s, body, a).moves;
  by_x = moves ? x : 0.0f;
  by_v = moves ? fmaf(s.dt, x, v) : 0.0f;
}
