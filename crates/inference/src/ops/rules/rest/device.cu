// Bodies at walls that hardly move come to rest, as `mod.rs`.

// The mean squared speed of each body's fastest cell, observed or predicted. A thread has a cell. grid (.., B), block 128
extern "C" __global__ void __launch_bounds__(128) rest_speeds(const Stream* __restrict__ streams, const float* __restrict__ constants, int rule, int step) {
  const Stream& s = streams[blockIdx.y];
  for (u32 cell = first_thread(); cell < s.across[0] * s.across[1]; cell += all_threads()) {
    const u32 begin = s.starts[cell], end = s.starts[cell + 1];
    if (begin == end) continue;
    double observed = 0.0, predicted = 0.0;
    for (u32 slot = begin; slot < end; slot++) {
      const u32 p = s.order[slot];
      const Body seen = s.bodies[p], next = s.next[p];
      observed += (double)(seen.v[0] * seen.v[0] + seen.v[1] * seen.v[1]);
      predicted += (double)(next.v[0] * next.v[0] + next.v[1] * next.v[1]);
    }
    const double fastest = fmax(observed, predicted) / (double)(end - begin);
    if (fastest >= 0.0) atomicMax(&body_of(s, cell).fastest, double_bits(fastest));
  }
}
// grid (ceil(n / 256), B), block 256
extern "C" __global__ void __launch_bounds__(256) rest(const Stream* __restrict__ streams, const float* __restrict__ constants, int rule, int step) {
  const Stream& s = streams[blockIdx.y];
  const RestConstants rules = *(const RestConstants*)constants;
  for (u32 p = first_thread(); p < s.particles; p += all_threads()) {
    const BodySums& body = body_of(s, s.cells[p]);
    const float awake = ((float)sqrt(bits_double(body.fastest)) / rules.gain - rules.asleep_below) / (rules.awake_from - rules.asleep_below);
    const float share = awake < 0.0f ? 0.0f : awake;
    // Not finite without gravity.
    if (!(share < 1.0f) || !(fabsf(awake) <= 3.4e38f) || is_clear(s, body, rules.distance)) continue;
    const Body seen = s.bodies[p];
    Body next = s.next[p];
#pragma unroll
    for (int a = 0; a < 2; a++) {
      next.x[a] = seen.x[a] + share * (next.x[a] - seen.x[a]);
      next.v[a] *= share;
    }
    s.next[p] = next;
  }
}
