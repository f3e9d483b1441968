// The particle model's features, as `mod.rs`, and their gradient as `trajectories.rs`; `s` is a stream or the plan of a training, with
// walls, fall, dt, unit.
// Scales of wall proximity, `engine/scales.rs`; of strain and bend, `kernels/rest_shape.rs`.
#define CONTACT_SCALE 0.03f
#define BODY_SCALE 0.2f
#define STRAIN_SCALE 10.0f
#define BEND_SCALE 60.0f
#define SHAPE_LIMIT 4.0f
// Their places: velocity, residual, impulse; proximity at both scales; shape; material.
#define NEAR_FROM (3 * DIM)
#define FAR_FROM (5 * DIM)
#define SHAPE_FROM (7 * DIM)
#define SHAPE_FEATURES 5
#define MATERIAL_FROM (SHAPE_FROM + SHAPE_FEATURES)
#define STIFFNESS_FROM (MATERIAL_FROM + MATERIAL_INPUTS)
__device__ __forceinline__ float exponential(float x) { return exp2_approximate(LOG2E * x); }

// Deformation gradient and bend of a particle with these links (`deformation`).
struct Deformation { float f[2][2], bend[2]; };
__device__ __forceinline__ Deformation deformation(const Link* links, u32 begin, u32 end, const Body* bodies, const Body& body) {
  Deformation d = {{{0.0f, 0.0f}, {0.0f, 0.0f}}, {0.0f, 0.0f}};
#pragma unroll 4
  for (u32 i = begin; i < end; i++) {
    const Link link = links[i];
    const Body other = bodies[link.particle];
#pragma unroll
    for (int a = 0; a < 2; a++) {
      const float apart = other.x[a] - body.x[a];
      d.f[a][0] = fmaf(apart, link.coefficient[0], d.f[a][0]);
      d.f[a][1] = fmaf(apart, link.coefficient[1], d.f[a][1]);
      d.bend[a] = fmaf(apart, link.share, d.bend[a]);
    }
  }
  return d;
}
// Strain and bend before they are limited.
__device__ __forceinline__ void scaled_shape(const Deformation& d, float* shape) {
  shape[0] = STRAIN_SCALE * (d.f[0][0] * d.f[0][0] + d.f[0][1] * d.f[0][1] - 1.0f);
  shape[1] = STRAIN_SCALE * (d.f[1][0] * d.f[1][0] + d.f[1][1] * d.f[1][1] - 1.0f);
  shape[2] = STRAIN_SCALE * (d.f[0][0] * d.f[1][0] + d.f[0][1] * d.f[1][1]);
  shape[3] = BEND_SCALE * d.bend[0];
  shape[4] = BEND_SCALE * d.bend[1];
}
// Strain and bend of a particle (`RestShape::shape_of`); `first` is nowhere if no particle has links.
__device__ __forceinline__ void rest_shape(const u32* first, const Link* links, const Body* bodies, u32 p, const Body& body, float* shape) {
  for (int i = 0; i < SHAPE_FEATURES; i++) shape[i] = 0.0f;
  if (!first) return;
  const u32 begin = first[p], end = first[p + 1];
  if (begin == end) return;
  scaled_shape(deformation(links, begin, end, bodies, body), shape);
  for (int i = 0; i < SHAPE_FEATURES; i++) {
    const float raised = shape[i] < -SHAPE_LIMIT ? -SHAPE_LIMIT : shape[i];
    shape[i] = raised > SHAPE_LIMIT ? SHAPE_LIMIT : raised;
  }
}
// The gradients by deformation gradient and bend, [DIM DIM + DIM], from those by the shape, of a particle with these links.
__device__ __forceinline__ void rest_shape_gradient(const Link* links, u32 begin, u32 end, const Body* bodies, const Body& body, const float* by, float* by_shape) {
  const Deformation d = deformation(links, begin, end, bodies, body);
  float shape[SHAPE_FEATURES], g[SHAPE_FEATURES];
  scaled_shape(d, shape);
  for (int i = 0; i < SHAPE_FEATURES; i++)
    g[i] = fabsf(shape[i]) > SHAPE_LIMIT ? 0.0f : by[i] * (i < 3 ? STRAIN_SCALE : BEND_SCALE);
  for (int c = 0; c < 2; c++) {
    by_shape[c] = 2.0f * g[0] * d.f[0][c] + g[2] * d.f[1][c];
    by_shape[2 + c] = 2.0f * g[1] * d.f[1][c] + g[2] * d.f[0][c];
    by_shape[4 + c] = g[3 + c];
  }
}

// The features of motion and walls, of material and stiffness, from the velocity that was expected. Others are left as they are.
template <class S> __device__ __forceinline__ void motion_features(const S& s, const Body& body, const float* expected, float* own) {
#pragma unroll
  for (int a = 0; a < DIM; a++) {
    const Fall fall = ballistic(s, body, a);
    own[a] = body.v[a] / s.unit;
    own[DIM + a] = (body.v[a] - expected[a]) / s.unit;
    own[2 * DIM + a] = (fall.v - fall.free) / s.unit;
    const float sides[2] = {body.x[a] - s.wall_lower[a], s.wall_upper[a] - body.x[a]};
#pragma unroll
    for (int side = 0; side < 2; side++) {
      const float distance = sides[side] > 0.0f ? sides[side] : 0.0f;
      own[NEAR_FROM + DIM * side + a] = exponential(distance * (-1.0f / CONTACT_SCALE));
      own[FAR_FROM + DIM * side + a] = exponential(distance * (-1.0f / BODY_SCALE));
    }
  }
}
__device__ __forceinline__ void matter_features(int material, float stiffness, float* own) {
  own[MATERIAL_FROM + material] = 1.0f;
  if (F > STIFFNESS_FROM) own[STIFFNESS_FROM] = stiffness;
}
// The gradients by a particle's state, and by the velocity that was expected, from those by its features. `by_coming` is the gradient by
// the velocity that is expected of the next frame.
template <class S> __device__ __forceinline__ Body motion_features_gradient(const S& s, const Body& body, const float* by, const float* by_coming, float* by_expected) {
  Body found;
  const float unit = 1.0f / s.unit;
#pragma unroll
  for (int a = 0; a < DIM; a++) {
    const Fall fall = ballistic(s, body, a);
    found.v[a] = unit * (by[a] + by[DIM + a] - (fall.moves ? 0.0f : by[2 * DIM + a]));
    if (fall.moves) found.v[a] += by_coming[a];
    by_expected[a] = -unit * by[DIM + a];
    found.x[a] = 0.0f;
    const float sides[2] = {body.x[a] - s.wall_lower[a], s.wall_upper[a] - body.x[a]};
#pragma unroll
    for (int side = 0; side < 2; side++) {
      // The features decrease with the distance, which decreases with the coordinate at the upper wall.
      if (!(sides[side] > 0.0f)) continue;
      const float near = exponential(sides[side] * (-1.0f / CONTACT_SCALE)), far = exponential(sides[side] * (-1.0f / BODY_SCALE));
      const float sum = by[NEAR_FROM + DIM * side + a] * near / CONTACT_SCALE + by[FAR_FROM + DIM * side + a] * far / BODY_SCALE;
      found.x[a] += side ? sum : -sum;
    }
  }
  return found;
}
