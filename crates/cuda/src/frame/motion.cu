// From the decoder's output of a particle to its next state (`FrameOutput` of eddy-inference).
//
//   OUTPUT  0 change of the velocity, 1 the same after the ballistic step, 2 scaled position

struct Motion {
  float dt[DIM];        // time between two frames (s), the same for each axis
  float fall[DIM];      // g dt
  float lower[DIM];     // walls (domain lengths)
  float upper[DIM];
  float mean[DIM];      // of positions in training (domain lengths)
  float deviation[DIM];
};

// The ballistic step along an axis: free fall, stopped by the walls.
__device__ __forceinline__ bool ballistic_step(float& x, float& v, const Motion& motion, int a) {
  const float fallen = v + motion.fall[a], free = fmaf(0.5f * (v + fallen), motion.dt[a], x);
  x = fminf(fmaxf(free, motion.lower[a]), motion.upper[a]);
  const bool stopped = x != free;
  v = stopped ? 0.0f : fallen;
  return stopped;
}
__device__ __forceinline__ Body next_body(Body body, const float* output, const Motion& motion) {
#pragma unroll
  for (int a = 0; a < DIM; a++) {
#if OUTPUT == 2
    const float x = fmaf(motion.deviation[a], output[a], motion.mean[a]);
    body.v[a] = (x - body.x[a]) / motion.dt[a];
    body.x[a] = x;
#elif OUTPUT == 1
    ballistic_step(body.x[a], body.v[a], motion, a);
    body.v[a] += output[a];
    body.x[a] = fmaf(0.5f * motion.dt[a], output[a], body.x[a]);
#else
    body.v[a] += output[a];
    body.x[a] = fmaf(body.v[a], motion.dt[a], body.x[a]);
#endif
  }
  return body;
}
// From the gradient by the next state along an axis to the one by `body` (in its place), and the one by the output.
__device__ __forceinline__ float gradient_of_next(const Body& body, float& by_x, float& by_v, const Motion& motion, int a) {
#if OUTPUT == 2
  const float total = by_x + by_v / motion.dt[a];
  by_x = -by_v / motion.dt[a];
  by_v = 0.0f;
  return motion.deviation[a] * total;
#elif OUTPUT == 1
  const float by_output = fmaf(0.5f * motion.dt[a], by_x, by_v);
  float x = body.x[a], v = body.v[a];
  if (ballistic_step(x, v, motion, a)) by_x = by_v = 0.0f;
  else by_v = fmaf(motion.dt[a], by_x, by_v);
  return by_output;
#else
  by_v = fmaf(motion.dt[a], by_x, by_v);
  return by_v;
#endif
}
