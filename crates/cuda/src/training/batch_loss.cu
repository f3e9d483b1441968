// The loss of a batch, of either network, from the weighted squares of its frames.

struct Unroll {
  int batch, warm_up, unroll;
  int decoded; // the first frame that the decoder runs on
};

// The loss of the batch, and what each window's squares are multiplied by in the gradient: scales [2, B], free and
// observed. A relative loss is the root of a window's sum and `error_floor`. grid 1, block 256
extern "C" __global__ void __launch_bounds__(256) loss(const float* __restrict__ squares, int chunks, const float* __restrict__ densities,
    float density_factor, Unroll f, int relative, float error_floor, float observed_weight, float* __restrict__ scales,
    const Progress* __restrict__ progress, Outcome* __restrict__ outcomes) {
  __shared__ double sums[256];
  double total = 0.0;
  for (int b = threadIdx.x; b < f.batch; b += 256) {
#pragma unroll
    for (int kind = 0; kind < 2; kind++) {
      const int from = kind ? f.decoded : f.warm_up - 1, to = kind ? f.warm_up - 1 : f.warm_up + f.unroll - 1;
      const float share = kind ? observed_weight : 1.0f;
      float sum = 0.0f;
      for (int t = from; t < to; t++)
        for (int c = 0; c < chunks; c++) sum += squares[((size_t)t * f.batch + b) * chunks + c];
      if (from < to && share > 0.0f) {
        const float root = sqrtf(sum + error_floor);
        total += (double)share * (relative ? root : sum);
        scales[kind * f.batch + b] = share * (relative ? 0.5f / root : 1.0f) / f.batch;
      } else {
        scales[kind * f.batch + b] = 0.0f;
      }
    }
  }
  total /= f.batch;
  if (density_factor > 0.0f)
    for (int i = threadIdx.x; i < f.unroll * f.batch; i += 256) total += (double)density_factor * densities[i];
  sums[threadIdx.x] = total;
  __syncthreads();
  for (int m = 128; m; m >>= 1) {
    if (threadIdx.x < m) sums[threadIdx.x] += sums[threadIdx.x + m];
    __syncthreads();
  }
  if (threadIdx.x == 0) outcomes[progress->step].loss = (float)sums[0];
}

