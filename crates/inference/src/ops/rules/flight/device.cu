// By which rigid motion a body's prediction differs from free fall, as `mod.rs`.
struct RigidError { double centre[2], next_centre[2], velocity[2], angle, spin; };
#define POINT 1e-10
__device__ __forceinline__ bool rigid_error(const BodySums& body, RigidError& error) {
  const double count = fmax(sum_of(body, COUNT), 1.0);
  double v[2], speed[2];
  for (int a = 0; a < 2; a++) {
    error.centre[a] = sum_of(body, X + a) / count;
    error.next_centre[a] = sum_of(body, NEXT_X + a) / count;
    v[a] = sum_of(body, V + a) / count;
    speed[a] = sum_of(body, NEXT_V + a) / count;
    error.velocity[a] = speed[a] - v[a];
  }
  const double rr = sum_of(body, SQUARE) - count * DOT(error.centre, error.centre);
  const double pp = sum_of(body, NEXT_SQUARE) - count * DOT(error.next_centre, error.next_centre);
  const double rw = sum_of(body, TURN_XV) - count * CROSS(error.centre, v);
  const double rp = sum_of(body, TURN_XX) - count * CROSS(error.centre, error.next_centre);
  const double pq = sum_of(body, TURN_NEXT) - count * CROSS(error.next_centre, speed);
  const double rq = sum_of(body, STRETCH) - count * DOT(error.centre, speed);
  error.angle = rr > POINT * count ? rp / rr : 0.0;
  const double inertia = pp - error.angle * error.angle * rr;
  error.spin = inertia > POINT * count ? (pq + error.angle * rq - rw) / inertia : 0.0;
  return !body.invalid;
}
// Bodies in flight keep their momentum and angular momentum. A thread has a cell.
// grid (.., B), block 128
extern "C" __global__ void __launch_bounds__(128) flight(const Stream* __restrict__ streams, const float* __restrict__ constants, int rule, int step) {
  const Stream& s = streams[blockIdx.y];
  const float distance = ((const FlightConstants*)constants)->distance;
  for (u32 cell = first_thread(); cell < s.across[0] * s.across[1]; cell += all_threads()) {
    const u32 begin = s.starts[cell], end = s.starts[cell + 1];
    if (begin == end) continue;
    const BodySums& body = body_of(s, cell);
    RigidError error;
    if (!is_clear(s, body, distance) || !rigid_error(body, error)) continue;
    for (u32 slot = begin; slot < end; slot++) {
      const u32 p = s.order[slot];
      const Body seen = s.bodies[p], free = free_fall(s, seen);
      Body next = s.next[p];
      const double r[2] = {(double)free.x[0] - error.centre[0], (double)free.x[1] - error.centre[1]};
      const double arm[2] = {(double)next.x[0] - error.next_centre[0] + error.angle * r[1], (double)next.x[1] - error.next_centre[1] - error.angle * r[0]};
      const double turned[2] = {-arm[1], arm[0]};
#pragma unroll
      for (int a = 0; a < 2; a++) {
        next.x[a] = clamp_axis(s, a, (float)(error.centre[a] + arm[a]));
        next.v[a] = (float)((double)next.v[a] - error.velocity[a] - error.spin * turned[a]);
      }
      s.next[p] = next;
    }
  }
}
