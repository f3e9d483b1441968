// Dense layers, the network of the paper's comparison of activations. H is the width of its hidden layers.

// The activation in place, and its gradient. grid (ceil(HP / 128), rows), block 128
extern "C" __global__ void dense_forward(float* __restrict__ y) {
  const int j = blockIdx.x * blockDim.x + threadIdx.x;
  if (j >= HP) return;
  const size_t i = (size_t)blockIdx.y * HP + j;
  y[i] = padded(j, activate(y[i]));
}
extern "C" __global__ void dense_backward(float* __restrict__ d, const float* __restrict__ y) {
  const int j = blockIdx.x * blockDim.x + threadIdx.x;
  if (j >= HP) return;
  const size_t i = (size_t)blockIdx.y * HP + j;
  d[i] = j < H ? d[i] * activation_slope(y[i]) : 0.0f;
}
// Squared errors of predictions [rows, columns], of which `width` columns are numbers: sums of rows, and the gradient
// of their sum times `scale` / 2 in the place of the predictions. grid rows, block 256
extern "C" __global__ void __launch_bounds__(256) dense_error(float* __restrict__ y, const float* __restrict__ truth, float* __restrict__ squares, int columns, int width, float scale) {
  float sum = 0.0f;
  for (int j = threadIdx.x; j < columns; j += 256) {
    const size_t i = (size_t)blockIdx.x * columns + j;
    const float difference = j < width ? y[i] - truth[i] : 0.0f;
    sum += difference * difference;
    y[i] = scale * difference;
  }
  sum = block_sum(sum);
  if (threadIdx.x == 0) squares[blockIdx.x] = sum;
}
// Adam (Kingma and Ba 2015), without clipping. grid ceil(n / 256), block 256
extern "C" __global__ void __launch_bounds__(256) dense_adam(float* __restrict__ w, const float* __restrict__ g, float* __restrict__ first, float* __restrict__ second,
    int n, float rate, float correction, float epsilon) {
  const u32 i = blockIdx.x * 256 + threadIdx.x;
  if (i >= (u32)n) return;
  const float gradient = g[i];
  const float mean = first[i] + 0.1f * (gradient - first[i]);
  const float square = second[i] + 0.001f * (gradient * gradient - second[i]);
  first[i] = mean;
  second[i] = square;
  w[i] -= rate * divide(mean, fmaf(sqrtf(square), correction, epsilon));
}
