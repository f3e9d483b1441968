// Runs the kernels' text on the CPU, for tests on machines without a GPU: a fiber per CUDA thread, the blocks of a
// grid one after the other. `__shared__` is static memory; `__syncthreads` waits for every fiber of the block, and
// what a warp does together, for every fiber of the warp. The file is compiled behind the constants and in front of `EMULATED_KERNELS`, which the caller writes.
#include <setjmp.h>
#include <ucontext.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <type_traits>
#include <utility>
#include <vector>

#define EMULATED
#define __device__ static
#define __global__
#define __forceinline__ inline
#define __shared__ static
#define __launch_bounds__(...)
#define __restrict__
#define __align__(n) alignas(n)
#define DYNAMIC_SHARED(type, name) type* name = (type*)dynamic_shared
#define __syncthreads() wait_for(FOR_BLOCK)
#define __syncwarp() wait_for(FOR_WARP)

struct Dim { unsigned x, y, z; };
static Dim threadIdx, blockIdx, blockDim, gridDim;
static long long dynamic_shared[32768];

using std::max;
using std::min;
struct alignas(16) float4 { float x, y, z, w; };
struct alignas(8) float2 { float x, y; };
struct alignas(16) uint4 { unsigned x, y, z, w; };
static unsigned atomicAdd(unsigned* to, unsigned by) {
  const unsigned before = *to;
  *to += by;
  return before;
}
static unsigned atomicMin(unsigned* to, unsigned with) {
  const unsigned before = *to;
  *to = min(before, with);
  return before;
}
template <class T> static T atomicMax(T* to, T with) {
  const T before = *to;
  *to = max(before, with);
  return before;
}
static unsigned long long atomicAdd(unsigned long long* to, unsigned long long by) {
  const unsigned long long before = *to;
  *to += by;
  return before;
}

// Whom a fiber waits for.
enum Wait { FOR_NOBODY, FOR_WARP, FOR_BLOCK };
static void wait_for(Wait whom);
// A warp's exchange of numbers.
static float lanes[1024][6];
static unsigned thread_number() { return threadIdx.y * blockDim.x + threadIdx.x; }
template <class T> static T exchange_lanes(T v, int mask) {
  static_assert(sizeof v <= sizeof lanes[0], "what a lane passes on");
  T found;
  std::memcpy(lanes[thread_number()], &v, sizeof v);
  wait_for(FOR_WARP);
  std::memcpy(&found, lanes[thread_number() ^ mask], sizeof v);
  wait_for(FOR_WARP);
  return found;
}
// TF32: 10 bits of mantissa; the tensor cores ignore the others.
static float masked(float v, unsigned add) {
  unsigned bits;
  std::memcpy(&bits, &v, 4);
  bits = (bits + add) & 0xffffe000u;
  std::memcpy(&v, &bits, 4);
  return v;
}
static float round_mantissa(float v) { return masked(v, 0x1000u); }
// Fragments of mma.m16n8k8 as the PTX ISA lays them out.
static void multiply_fragments(float* c, const float* a, const float* b) {
  const unsigned self = thread_number(), warp = self & ~31u, row = (self & 31) >> 2, pair = self & 3;
  for (int i = 0; i < 4; i++) lanes[self][i] = masked(a[i], 0);
  for (int i = 0; i < 2; i++) lanes[self][4 + i] = masked(b[i], 0);
  wait_for(FOR_WARP);
  for (int i = 0; i < 4; i++)
    for (unsigned k = 0; k < 8; k++) {
      const float left = lanes[warp + 4 * row + (k & 3)][(i >> 1) + 2 * (k >> 2)];
      const float right = lanes[warp + 4 * (2 * pair + (i & 1)) + (k & 3)][4 + (k >> 2)];
      c[i] += left * right;
    }
  wait_for(FOR_WARP);
}

// A fiber serves the threads of one number in all blocks, one after the other. It is entered once; then jumps, which
// leave signals alone and so cost no system call, switch between it and the scheduler.
static const size_t STACK = 64 << 10;
struct Fiber {
  char* stack;
  jmp_buf resume;
  bool begun, over;
  Wait waits;
};
static std::vector<Fiber> fibers;
static jmp_buf scheduler;
static unsigned current;
static const std::function<void()>* body;

static void wait_for(Wait whom) {
  fibers[current].waits = whom;
  if (!_setjmp(fibers[current].resume)) _longjmp(scheduler, 1);
}
static void run_fiber() {
  for (;;) {
    (*body)();
    fibers[current].over = true;
    wait_for(FOR_NOBODY);
  }
}
// Goes on with the current fiber, until it waits or is over.
static __attribute__((noinline)) void resume() {
  if (_setjmp(scheduler)) return;
  Fiber& fiber = fibers[current];
  if (fiber.begun) _longjmp(fiber.resume, 1);
  fiber.begun = true;
  ucontext_t context;
  getcontext(&context);
  context.uc_stack.ss_sp = fiber.stack;
  context.uc_stack.ss_size = STACK;
  context.uc_link = nullptr;
  makecontext(&context, run_fiber, 0);
  setcontext(&context);
}

// Goes on with the fibers of a warp, until all wait for the block or are over: whether any waits.
static bool run_warp(unsigned first, unsigned end) {
  for (;;) {
    unsigned in_warp = 0, in_block = 0;
    for (current = first; current < end; current++) {
      if (fibers[current].over) continue;
      threadIdx = {current % blockDim.x, current / blockDim.x, 0};
      if (fibers[current].waits == FOR_NOBODY) resume();
      if (fibers[current].over) continue;
      (fibers[current].waits == FOR_WARP ? in_warp : in_block)++;
    }
    if (!in_warp) return in_block;
    if (in_block) {
      fprintf(stderr, "threads of a warp wait for the block, others for the warp\n");
      abort();
    }
    for (unsigned i = first; i < end; i++) fibers[i].waits = FOR_NOBODY;
  }
}
static void run(const unsigned* grid, const unsigned* block, const std::function<void()>& work) {
  gridDim = {grid[0], grid[1], grid[2]};
  blockDim = {block[0], block[1], 1};
  const unsigned threads = block[0] * block[1];
  body = &work;
  while (fibers.size() < threads) fibers.push_back({new char[STACK], {}, false, false, FOR_NOBODY});
  for (unsigned z = 0; z < grid[2]; z++)
    for (unsigned y = 0; y < grid[1]; y++)
      for (unsigned x = 0; x < grid[0]; x++) {
        blockIdx = {x, y, z};
        for (unsigned i = 0; i < threads; i++) fibers[i].over = false;
        for (bool any = true; any;) {
          any = false;
          for (unsigned i = 0; i < threads; i++) fibers[i].waits = FOR_NOBODY;
          for (unsigned first = 0; first < threads; first += 32) any |= run_warp(first, min(first + 32, threads));
        }
      }
}

// Calls a kernel with arguments as the driver takes them: a list of pointers to the values.
template <class... A, size_t... I>
static void call(void (*kernel)(A...), void** arguments, std::index_sequence<I...>) {
  kernel(*(typename std::remove_reference<A>::type*)arguments[I]...);
}
template <class... A>
static void call(void (*kernel)(A...), const unsigned* grid, const unsigned* block, void** arguments) {
  const std::function<void()> work = [=] { call(kernel, arguments, std::index_sequence_for<A...>{}); };
  run(grid, block, work);
}
