// Shared by the kernels of both networks.
//
// Constants come from the network's description:
//   DIM        axes of space
//   N          particles of a window
//   MATERIALS  kinds of matter; MATERIAL_INPUTS those that the network has inputs for
//   ONE_HOT    1: a weight row a material, 0: one row for the material's number / (MATERIAL_INPUTS - 1)
//   E, EL      width of the pointwise encoder, and the same rounded up to 4 (columns of its matrix)
//   EP         E and the ones, rounded up to 8
//   H, HP      width of the hidden state; with the ones, rounded up to 8
//   MEAN, MAXIMUM  1: the particles are pooled by their mean, by the maximum of the second Linear's outputs
//   IP         width of the core's input with the ones, H for each of the two, rounded up to 8
//   OP         DIM * N, rounded up to 8 (columns of the decoder)
//   ACTIVATION 0 sigmoid, 1 tanh, 2 ReLU, 3 ELU
//   LOG_FORM, NORMALIZED  forms of the minimal recurrences
//
// Activations are [rows, HP]: columns 0..H are numbers, column H is 1, the rest is 0. The bias is row H
// of the weight matrix, so that the products add it and give its gradient. Gradients are 0 from column
// H on.
#define LOG2E 1.4426950408889634f
#define FEATURES (2 * DIM)
#define INPUTS (FEATURES + (ONE_HOT ? MATERIAL_INPUTS : 1))

#ifdef EMULATED
#define exp2_approximate exp2f
#define divide(a, b) ((a) / (b))
#define shuffle_xor exchange_lanes
#define multiply_tf32 multiply_fragments
#define round_tf32 round_mantissa
#else
__device__ __forceinline__ float exp2_approximate(float v) {
  float r;
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(v));
  return r;
}
#define divide(a, b) __fdividef(a, b)
template <class T> __device__ __forceinline__ T shuffle_xor(T v, int mask) { return __shfl_xor_sync(0xffffffffu, v, mask); }
// The nearest number with 10 bits of mantissa.
__device__ __forceinline__ float round_tf32(float v) { return __uint_as_float((__float_as_uint(v) + 0x1000u) & 0xffffe000u); }
// c[16, 8] += a[16, 8] b[8, 8] by a warp: PTX ISA, "Matrix Fragments for mma.m16n8k8", .tf32.
__device__ __forceinline__ void multiply_tf32(float* c, const float* a, const float* b) {
  asm("mma.sync.aligned.m16n8k8.row.col.f32.tf32.tf32.f32 {%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};"
      : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
      : "r"(__float_as_uint(a[0])), "r"(__float_as_uint(a[1])), "r"(__float_as_uint(a[2])), "r"(__float_as_uint(a[3])),
        "r"(__float_as_uint(b[0])), "r"(__float_as_uint(b[1])));
}
#endif

// Position (domain lengths) and velocity (domain lengths per second) of a particle.
struct __align__(DIM == 2 ? 16 : 8) Body {
  float x[DIM];
  float v[DIM];
};

// A window: where its first frame starts in the store of bodies, and what is done to it.
struct Window {
  u64 first;     // index of a body
  u32 stream;
  u32 mirrored;  // 1: left and right are exchanged
  u32 disturbed; // 1: the last observed frame gets noise
  u32 unused;
  u32 key[8];    // of the generator of the noise
};

// What a step needs from the host beside its windows.
struct Schedule {
  float rate;        // learning rate, corrected for the first moment's start from zero
  float correction;  // 1 / sqrt(1 - beta_2^t)
  float kept;        // share of the weights' running average that stays
  float plain_rate;  // learning rate without that correction
  u32 dropout[8];    // key of the generator of dropout masks
  float shares[4];   // what weights for several stiffnesses count for, MOST_KNOTS of the host
};

// Where the run is within the tables of the host, and what came of each step.
struct Progress { u32 step; };
struct Outcome { float loss; float gradient_norm; u32 not_finite; u32 unused; };

__device__ __forceinline__ float sigmoid(float v) { return divide(1.0f, 1.0f + exp2_approximate(-LOG2E * v)); }
__device__ __forceinline__ float hyperbolic_tangent(float v) {
  return 1.0f - divide(2.0f, 1.0f + exp2_approximate(2.0f * LOG2E * v));
}
__device__ __forceinline__ float padded(int j, float v) { return j < H ? v : (j == H ? 1.0f : 0.0f); }

__device__ __forceinline__ float activate(float a) {
#if ACTIVATION == 0
  return sigmoid(a);
#elif ACTIVATION == 1
  return hyperbolic_tangent(a);
#elif ACTIVATION == 2
  return fmaxf(a, 0.0f);
#else
  return a > 0.0f ? a : exp2_approximate(LOG2E * a) - 1.0f;
#endif
}
// Derivative of the activation, from its value.
__device__ __forceinline__ float activation_slope(float y) {
#if ACTIVATION == 0
  return y * (1.0f - y);
#elif ACTIVATION == 1
  return 1.0f - y * y;
#elif ACTIVATION == 2
  return y > 0.0f ? 1.0f : 0.0f;
#else
  return y > 0.0f ? 1.0f : y + 1.0f;
#endif
}

// Sum over a block of THREADS threads (a power of two), in a fixed order; every thread has it.
template <u32 THREADS = 256> __device__ __forceinline__ float block_sum(float v) {
  __shared__ float sums[THREADS];
  sums[threadIdx.x] = v;
  __syncthreads();
  for (u32 m = THREADS / 2; m; m >>= 1) {
    if (threadIdx.x < m) sums[threadIdx.x] += sums[threadIdx.x + m];
    __syncthreads();
  }
  const float total = sums[0];
  __syncthreads();
  return total;
}

// ChaCha with 8 rounds (Bernstein 2008): the 16 words of a block, as rand_chacha's ChaCha8Rng gives them.
__device__ __forceinline__ u32 rotate(u32 v, int by) { return (v << by) | (v >> (32 - by)); }
__device__ __forceinline__ void chacha8(const u32* key, u64 block, u32* words) {
  u32 start[16] = {0x61707865u, 0x3320646eu, 0x79622d32u, 0x6b206574u, key[0], key[1], key[2], key[3],
                   key[4], key[5], key[6], key[7], (u32)block, (u32)(block >> 32), 0u, 0u};
#pragma unroll
  for (int i = 0; i < 16; i++) words[i] = start[i];
#define QUARTER(a, b, c, d)                                                     \
  words[a] += words[b]; words[d] = rotate(words[d] ^ words[a], 16);             \
  words[c] += words[d]; words[b] = rotate(words[b] ^ words[c], 12);             \
  words[a] += words[b]; words[d] = rotate(words[d] ^ words[a], 8);              \
  words[c] += words[d]; words[b] = rotate(words[b] ^ words[c], 7);
#pragma unroll
  for (int round = 0; round < 4; round++) {
    QUARTER(0, 4, 8, 12) QUARTER(1, 5, 9, 13) QUARTER(2, 6, 10, 14) QUARTER(3, 7, 11, 15)
    QUARTER(0, 5, 10, 15) QUARTER(1, 6, 11, 12) QUARTER(2, 7, 8, 13) QUARTER(3, 4, 9, 14)
  }
#pragma unroll
  for (int i = 0; i < 16; i++) words[i] += start[i];
}
// A number in 0..1 from a word, as rand's f32.
__device__ __forceinline__ float unit(u32 word) { return (float)(word >> 8) * (1.0f / 16777216.0f); }
