// The inputs of nodes, as `mod.rs`; `s` is a stream or the plan of a training, with the domain's lower corner, walls, width of a cell, and
// the columns and rows of its maps.
#define MIN_MASS 1e-3f
#define FULL_MASS 16.0f
// Mass, and proximity to four walls.
#define NODE_FEATURES 5
// Proximity of the nodes with this number on an axis to the wall on a side.
template <class S> __device__ __forceinline__ float node_proximity(const S& s, int at, int axis, int side) {
  const float place = s.lower[axis] + multiply_rounded((float)at, s.width);
  const float distance = side ? s.wall_upper[axis] - place : place - s.wall_lower[axis];
  return exponential(-fmaxf(distance, 0.0f) / s.width);
}
// Writes four means of a node; for the quadruple behind those, mass and proximity to walls.
template <class S> __device__ __forceinline__ void write_node_inputs(const S& s, u32 entry, int quad, const NodeSum& found, float* to) {
  if (quad < QUADS) {
    const float scale = 1.0f / (found.mass + MIN_MASS);
    const float means[4] = {found.sum.x * scale, found.sum.y * scale, found.sum.z * scale, found.sum.w * scale};
#pragma unroll
    for (int u = 0; u < 4; u++)
      if (4 * quad + u < C0) to[4 * quad + u] = means[u];
    return;
  }
  to[C0] = found.mass / FULL_MASS;
  u32 rest = entry;
#pragma unroll
  for (int a = 0; a < DIM; a++) {
    const u32 across = s.across[a];
    const int at = (int)(a + 1 < DIM ? rest % across : rest) - ORIGIN;
    rest /= across;
#pragma unroll
    for (int side = 0; side < 2; side++) to[C0 + 1 + DIM * side + a] = node_proximity(s, at, a, side);
  }
  for (int k = C0 + NODE_FEATURES; k < INPUT4; k++) to[k] = 0.0f;
}
