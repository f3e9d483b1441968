// Shape: as `mod.rs`.
// The rule's scratch memory: [n, 4] limited deformations, [2, n, 2] positions before and after a sweep in turn, [n, 2] offsets.
__device__ __forceinline__ float4* shape_limited(const Stream& s, int rule) { return (float4*)s.scratch[rule]; }
__device__ __forceinline__ float* shape_positions(const Stream& s, int rule, int side) { return s.scratch[rule] + (4 + 2 * side) * (size_t)s.particles; }
__device__ __forceinline__ float* shape_offsets(const Stream& s, int rule) { return s.scratch[rule] + 8 * (size_t)s.particles; }

// The deformation of each particle with limited stretches. grid (ceil(n / 256), B), block 256
extern "C" __global__ void __launch_bounds__(256) shape_limit(const Stream* __restrict__ streams, const float* __restrict__ constants, int rule, int step) {
  const Stream& s = streams[blockIdx.y];
  const float strain = ((const ShapeConstants*)constants)->strain_limit;
  if (!s.first) return;
  for (u32 p = first_thread(); p < s.particles; p += all_threads()) {
    const Body body = s.next[p];
    const u32 begin = s.first[p], end = s.first[p + 1];
    // Particles without a rest shape keep their position in both lists.
#pragma unroll
    for (int a = 0; a < 2; a++) shape_positions(s, rule, 0)[2 * p + a] = shape_positions(s, rule, 1)[2 * p + a] = body.x[a];
    float4 result = {1.0f, 0.0f, 0.0f, 1.0f};
    if (begin < end) {
      float f[2][2] = {{0.0f, 0.0f}, {0.0f, 0.0f}};
#pragma unroll 4
      for (u32 i = begin; i < end; i++) {
        const Link link = s.links[i];
        const Body other = s.next[link.particle];
#pragma unroll
        for (int a = 0; a < 2; a++) {
          const float apart = other.x[a] - body.x[a];
          f[a][0] = fmaf(apart, link.coefficient[0], f[a][0]);
          f[a][1] = fmaf(apart, link.coefficient[1], f[a][1]);
        }
      }
      // Scaled rotation and scaled reflection: the singular values are the sum and the difference of the scales.
      const float u = 0.5f * (f[0][0] + f[1][1]), w = 0.5f * (f[1][0] - f[0][1]), r = 0.5f * (f[0][0] - f[1][1]), t = 0.5f * (f[1][0] + f[0][1]);
      const float rotation = sqrtf(u * u + w * w), reflection = sqrtf(r * r + t * t), low = 1.0f - strain, high = 1.0f + strain;
      const float sum = rotation + reflection, difference = rotation - reflection;
      const float most = sum < low ? low : (sum > high ? high : sum), least = difference < low ? low : (difference > high ? high : difference);
      const float turn = 0.5f * (most + least) / fmaxf(rotation, 1.17549435e-38f), flip = 0.5f * (most - least) / fmaxf(reflection, 1.17549435e-38f);
      result = {u * turn + r * flip, t * flip - w * turn, t * flip + w * turn, u * turn - r * flip};
    }
    shape_limited(s, rule)[p] = result;
  }
}
// A sweep: each particle moves to its neighbours' mean and the offset that the rest shape implies, which the first sweep
// computes. The last one writes the prediction. grid and block as above
extern "C" __global__ void __launch_bounds__(256) shape_relax(const Stream* __restrict__ streams, const float* __restrict__ constants, int rule, int step) {
  const Stream& s = streams[blockIdx.y];
  if (!s.first) return;
  const float* from = shape_positions(s, rule, step & 1);
  float* to = shape_positions(s, rule, (step & 1) ^ 1);
  float* offsets = shape_offsets(s, rule);
  const bool last = step + 1 == (int)((const ShapeConstants*)constants)->sweeps;
  for (u32 p = first_thread(); p < s.particles; p += all_threads()) {
    const u32 begin = s.first[p], end = s.first[p + 1];
    if (begin == end) continue;
    float offset[2] = {0.0f, 0.0f};
    if (step == 0) {
      const float4 own = shape_limited(s, rule)[p];
#pragma unroll 4
      for (u32 i = begin; i < end; i++) {
        const Neighbour near = s.neighbours[i];
        const float4 theirs = shape_limited(s, rule)[near.particle];
        offset[0] -= 0.5f * near.share * ((own.x + theirs.x) * near.offset[0] + (own.y + theirs.y) * near.offset[1]);
        offset[1] -= 0.5f * near.share * ((own.z + theirs.z) * near.offset[0] + (own.w + theirs.w) * near.offset[1]);
      }
#pragma unroll
      for (int a = 0; a < 2; a++) offsets[2 * p + a] = offset[a];
    }
    float place[2] = {offsets[2 * p], offsets[2 * p + 1]};
#pragma unroll 4
    for (u32 i = begin; i < end; i++) {
      const Neighbour near = s.neighbours[i];
#pragma unroll
      for (int a = 0; a < 2; a++) place[a] = fmaf(near.share, from[2 * near.particle + a], place[a]);
    }
    Body body = s.next[p];
#pragma unroll
    for (int a = 0; a < 2; a++) {
      place[a] = clamp_axis(s, a, place[a]);
      to[2 * p + a] = place[a];
      body.v[a] += (place[a] - body.x[a]) / s.dt;
      body.x[a] = place[a];
    }
    if (last) s.next[p] = body;
  }
}
