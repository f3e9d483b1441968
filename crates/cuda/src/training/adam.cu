// Adam (Kingma and Ba 2015) over the matrix of a layer, its tensors' gradients shortened to `clip` each first. A
// layer holds `parts` weight tensors side by side, `width` columns each, rows 0..bias, and their biases in row `bias`;
// tensor 2 * part is a weight, 2 * part + 1 its bias. Padding is 0 in weights and gradients. A launch is for one matrix or for
// several, one behind the other in `places`.
struct Place {
  u32 first;          // where its numbers begin within all
  int rows, columns;
  int bias, width;
  int tensor, tensors; // the first one, and how many
  int muon;            // 1: Muon changes the weights, Adam the biases only
};

// Sums of squares of the gradients: [tensors, CHUNKS], zero where there is no block. grid (at most CHUNKS, most tensors, matrices),
// block 256
#define CHUNKS 256
extern "C" __global__ void __launch_bounds__(256) squares_of_gradient(const Place* __restrict__ places, const float* __restrict__ gradients, float* __restrict__ squares) {
  const Place place = places[blockIdx.z];
  if ((int)blockIdx.y >= place.tensors) return;
  const int part = blockIdx.y / 2, first = blockIdx.y % 2 ? place.bias : 0, rows = blockIdx.y % 2 ? 1 : place.bias, wide = place.width / 4;
  const float* g = gradients + place.first;
  const u32 n = (u32)rows * wide;
  float sum = 0.0f;
  for (u32 i = blockIdx.x * 256 + threadIdx.x; i < n; i += gridDim.x * 256) {
    const float4 v = *(const float4*)(g + (size_t)(first + i / wide) * place.columns + part * place.width + 4 * (i % wide));
    sum += v.x * v.x + v.y * v.y + v.z * v.z + v.w * v.w;
  }
  sum = block_sum(sum);
  if (threadIdx.x == 0) squares[(size_t)(place.tensor + blockIdx.y) * CHUNKS + blockIdx.x] = sum;
}
// What each tensor's gradient is multiplied by: 0 where it is not finite. grid tensors, block 256
extern "C" __global__ void __launch_bounds__(256) clip(const float* __restrict__ squares, float* __restrict__ scales, float* __restrict__ totals, float longest) {
  const float total = block_sum(squares[(size_t)blockIdx.x * CHUNKS + threadIdx.x]);
  if (threadIdx.x) return;
  totals[blockIdx.x] = total;
  const float norm = sqrtf(total);
  scales[blockIdx.x] = !(norm <= 3.4e38f) ? 0.0f : (norm > longest ? longest / norm : 1.0f);
}
// A number of the running average `kept` of `weight`, by the schedule `now`.
#define AVERAGE(q) kept.q = weight.q + now.kept * (kept.q - weight.q);
// grid (ceil(most rows * columns / 4 / 256), 1, matrices), block 256
extern "C" __global__ void __launch_bounds__(256) adam(const Place* __restrict__ places, float4* __restrict__ w, const float4* __restrict__ g, float4* __restrict__ first,
    float4* __restrict__ second, float4* __restrict__ average, const float* __restrict__ scales, const Schedule* __restrict__ schedule,
    const Progress* __restrict__ progress, float epsilon) {
  const Place place = places[blockIdx.z];
  const u32 number = blockIdx.x * 256 + threadIdx.x, wide = place.columns / 4;
  if (number >= place.rows * wide) return;
  const Schedule& now = schedule[progress->step];
  const u32 row = number / wide, column = 4 * (number % wide), i = place.first / 4 + number;
  if (place.muon && (int)row < place.bias) return;
  const float scale = scales[place.tensor + 2 * (column / place.width) + ((int)row == place.bias)];
  if (scale == 0.0f) return; // a gradient that is not finite tells no direction; the host ends the run
  const float rate = now.rate, correction = now.correction;
  float4 weight = w[i], gradient = g[i], mean = first[i], square = second[i];
#define NUMBER(q)                                                            \
  gradient.q *= scale;                                                       \
  mean.q += 0.1f * (gradient.q - mean.q);                                    \
  square.q += 0.001f * (gradient.q * gradient.q - square.q);                 \
  weight.q -= rate * divide(mean.q, fmaf(sqrtf(square.q), correction, epsilon));
  NUMBER(x) NUMBER(y) NUMBER(z) NUMBER(w)
  w[i] = weight;
  first[i] = mean;
  second[i] = square;
  if (average) {
    float4 kept = average[i];
    AVERAGE(x) AVERAGE(y) AVERAGE(z) AVERAGE(w)
    average[i] = kept;
  }
}
// Ends a step. grid 1, block 256
extern "C" __global__ void __launch_bounds__(256) finish(const float* __restrict__ totals, int tensors, Progress* __restrict__ progress, Outcome* __restrict__ outcomes) {
  float sum = 0.0f;
  for (int i = threadIdx.x; i < tensors; i += 256) sum += totals[i];
  const float total = block_sum(sum);
  if (threadIdx.x) return;
  Outcome& outcome = outcomes[progress->step];
  outcome.gradient_norm = sqrtf(total);
  outcome.not_finite = !(total <= 3.4e38f);
  progress->step += 1;
}
