// Runs the kernels' text on the CPU, for tests on machines without a GPU: a fiber per CUDA thread, the blocks of a
// grid one after the other. `__shared__` is static memory, `__syncthreads` lets every other fiber of the block come
// as far. The file is compiled behind the constants and in front of `EMULATED_KERNELS`, which the caller writes.
#include <ucontext.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
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
#define __syncthreads() meet()

struct Dim { unsigned x, y, z; };
static Dim threadIdx, blockIdx, blockDim, gridDim;
static long long dynamic_shared[32768];

using std::max;
using std::min;
struct alignas(16) float4 { float x, y, z, w; };
static unsigned long long atomicAdd(unsigned long long* to, unsigned long long by) {
  const unsigned long long before = *to;
  *to += by;
  return before;
}

static const size_t STACK = 64 << 10;
struct Fiber { ucontext_t context; bool over; };
static std::vector<Fiber> fibers;
static std::vector<char> stacks;
static ucontext_t scheduler;
static unsigned current;
static const std::function<void()>* body;

static void meet() { swapcontext(&fibers[current].context, &scheduler); }
static void run_fiber() {
  (*body)();
  fibers[current].over = true;
}

static void run(const unsigned* grid, const unsigned* block, const std::function<void()>& work) {
  gridDim = {grid[0], grid[1], grid[2]};
  blockDim = {block[0], block[1], 1};
  const unsigned threads = block[0] * block[1];
  body = &work;
  fibers.resize(std::max<size_t>(fibers.size(), threads));
  stacks.resize(std::max(stacks.size(), threads * STACK));
  for (unsigned z = 0; z < grid[2]; z++)
    for (unsigned y = 0; y < grid[1]; y++)
      for (unsigned x = 0; x < grid[0]; x++) {
        blockIdx = {x, y, z};
        for (unsigned i = 0; i < threads; i++) {
          Fiber& fiber = fibers[i];
          fiber.over = false;
          getcontext(&fiber.context);
          fiber.context.uc_stack.ss_sp = stacks.data() + i * STACK;
          fiber.context.uc_stack.ss_size = STACK;
          fiber.context.uc_link = &scheduler;
          makecontext(&fiber.context, run_fiber, 0);
        }
        for (bool any = true; any;) {
          any = false;
          for (current = 0; current < threads; current++) {
            if (fibers[current].over) continue;
            threadIdx = {current % block[0], current / block[0], 0};
            swapcontext(&scheduler, &fibers[current].context);
            any = true;
          }
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
