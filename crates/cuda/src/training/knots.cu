// Weights for several stiffnesses ("knots"), launched by `training/optimizer.rs`: the weights of a step are their mean, weighted by
// the shares in its schedule.
// The weights of a step from those of the knots, `[knots, n]` in fours. grid ceil(n / 256), block 256
extern "C" __global__ void __launch_bounds__(256) mix_weights(const float4* __restrict__ of_knots, float4* __restrict__ weights, u32 n, int knots, const Schedule* __restrict__ schedule,
    const Progress* __restrict__ progress) {
  const u32 i = blockIdx.x * 256 + threadIdx.x;
  if (i >= n) return;
  const Schedule& now = schedule[progress->step];
  float4 sum = {0.0f, 0.0f, 0.0f, 0.0f};
  for (int knot = 0; knot < knots; knot++) {
    const float share = now.shares[knot];
    const float4 weight = of_knots[(size_t)knot * n + i];
    sum.x = fmaf(share, weight.x, sum.x);
    sum.y = fmaf(share, weight.y, sum.y);
    sum.z = fmaf(share, weight.z, sum.z);
    sum.w = fmaf(share, weight.w, sum.w);
  }
  weights[i] = sum;
}
// The scale of each knot's gradient, `[knots, tensors]`: that of the step's, which clips it, times the knot's share. A scale of 0, as
// where a gradient is not finite, leaves a tensor as it is. grid (ceil(tensors / 256), knots), block 256
extern "C" __global__ void __launch_bounds__(256) share_scales(const float* __restrict__ scales, float* __restrict__ shared, u32 tensors, const Schedule* __restrict__ schedule,
    const Progress* __restrict__ progress) {
  const u32 tensor = blockIdx.x * 256 + threadIdx.x;
  if (tensor < tensors) shared[blockIdx.y * tensors + tensor] = schedule[progress->step].shares[blockIdx.y] * scales[tensor];
}
