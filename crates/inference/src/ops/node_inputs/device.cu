// The inputs of nodes beside the means, as `mod.rs`; `s` is a stream or the plan of a training, with the domain's lower corner, walls and
// width of a cell. The kernels that sum over particles have the means.
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
