// Shared by all kernels: the networks' and the solver's. NVRTC compiles the files of a program as one text, without headers;
// the tests compile the same text for the CPU (`emulator.cpp`), which defines EMULATED.
typedef unsigned int u32;
typedef unsigned long long u64;

#ifdef EMULATED
#define multiply_rounded(a, b) ((a) * (b))
#else
// Not joined with an addition: cells and walls must be those that the processor finds.
#define multiply_rounded(a, b) __fmul_rn(a, b)
#endif

// Weights of three nodes by the quadratic spline, at a distance of 0.5 to 1.5 from the first (cells).
__device__ __forceinline__ void spline_weights(float x, float* weights) {
  weights[0] = 0.5f * (1.5f - x) * (1.5f - x);
  weights[1] = 0.75f - (x - 1.0f) * (x - 1.0f);
  weights[2] = 0.5f * (x - 0.5f) * (x - 0.5f);
}
