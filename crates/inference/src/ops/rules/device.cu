// What the kernels of the rules share. `Stream` is that of eddy-cuda (`particle/nodes.cu`). Every kernel has the parameters (streams,
// constants, rule, step): a block's y is its stream, the constants are those of the rule, and so is the list `scratch[rule]` of a stream. Sums over particles that are not in the order of
// cells are of integers, so that their order does not matter.

#ifdef EMULATED
static u32 float_bits(float v) { u32 bits; std::memcpy(&bits, &v, 4); return bits; }
static float bits_float(u32 bits) { float v; std::memcpy(&v, &bits, 4); return v; }
static u64 double_bits(double v) { u64 bits; std::memcpy(&bits, &v, 8); return bits; }
static double bits_double(u64 bits) { double v; std::memcpy(&v, &bits, 8); return v; }
#else
#define float_bits __float_as_uint
#define bits_float __uint_as_float
#define double_bits(v) ((u64)__double_as_longlong(v))
#define bits_double(v) __longlong_as_double((long long)(v))
#endif

__device__ __forceinline__ float clamp_axis(const Stream& s, int axis, float x) {
  return clamped(x, s.wall_lower[axis], s.wall_upper[axis]);
}

// Free fall without walls (`Ballistic::free`).
__device__ __forceinline__ Body free_fall(const Stream& s, const Body& body) {
  Body free;
#pragma unroll
  for (int a = 0; a < 2; a++) {
    free.v[a] = body.v[a] + s.fall[a];
    free.x[a] = body.x[a] + multiply_rounded(multiply_rounded(0.5f, body.v[a] + free.v[a]), s.dt);
  }
  return free;
}

