// The rule `elastic`: bodies of jelly that nothing else is close to move by their elasticity (`ops/rules/elastic` and `kernels/lattice` of
// eddy-inference).

// A particle or a node, and its weight.
struct LatticeShare { u32 index; float weight; };
// A quadrature point: the nodes of its element, the gradients of their shape functions, its particles, and the width of the element.
struct LatticePoint {
  u32 nodes[4];
  float gradients[4][2];
  float particles, width;
};
// A part of the surface: the nodes of its element, their shape functions, and its particles.
struct LatticePart {
  u32 nodes[4];
  float weights[4];
  float particles;
};
// The lattice of a body, and the law: Lame parameters, viscosity, distances (domain lengths), acceleration by walls.
struct Lattice {
  const u32* rows;             // particle
  const LatticeShare* corners; // [particles, 4] the nodes of its element
  const u32* sample_first;     // [nodes + 1] first sample of each node
  const LatticeShare* samples; // the particles that have the node, and its shape functions there
  const float* inverse;        // of the matrix of the fit, [nodes, nodes]
  const float* inverse_mass;   // of each node, in units of a particle's mass
  const u32* incident_first;   // [nodes + 1] first force on each node
  const u32* incident;         // [(points + parts) 4] the forces, those of points first
  const LatticePoint* points;
  const LatticePart* parts;
  u32 particle_count, node_count, point_count, part_count;
  u32 first_node, first_force; // of its scratch memory
  float mu, lambda, viscosity, wall_distance, wall_stiffness, rebound, clear_distance, most_stretch, most_error, small_error;
  int steps, unused;
};
// Threads that look around a part of the surface.
#define PART_THREADS 8
// Largest change of a node's velocity, speed away from a wall from which on it pushes least: `FASTEST` and `REBOUNDING` of eddy-inference.
#define FASTEST 64.0f
#define REBOUNDING 0.1f
// Strain that tears a body while walls push it, relative to that of a free one: `PUSHED_STRAIN`.
#define PUSHED_STRAIN 2.0f
// The largest error where nothing is expected, or there is no limit.
#define NOTHING_EXPECTED 3.4e38f

// The larger stretch at a point.
__device__ __forceinline__ float stretch(const LatticePoint& point, const Body* nodes) {
  float f[2][2] = {{0.0f, 0.0f}, {0.0f, 0.0f}};
#pragma unroll
  for (int corner = 0; corner < 4; corner++)
#pragma unroll
    for (int row = 0; row < 2; row++)
#pragma unroll
      for (int column = 0; column < 2; column++) f[row][column] += nodes[point.nodes[corner]].x[row] * point.gradients[corner][column];
  const float a = f[0][0] + f[1][1], b = f[1][0] - f[0][1], c = f[0][0] - f[1][1], d = f[1][0] + f[0][1];
  return 0.5f * (sqrtf(a * a + b * b) + sqrtf(c * c + d * d));
}
// The forces of the stress at a point on its nodes, in units of a particle's mass.
__device__ __forceinline__ void point_forces(const Lattice& law, const LatticePoint& point, const Body* nodes, float* forces) {
  float f[2][2] = {{0.0f, 0.0f}, {0.0f, 0.0f}}, rate[2][2] = {{0.0f, 0.0f}, {0.0f, 0.0f}};
#pragma unroll
  for (int corner = 0; corner < 4; corner++) {
    const Body node = nodes[point.nodes[corner]];
#pragma unroll
    for (int row = 0; row < 2; row++)
#pragma unroll
      for (int column = 0; column < 2; column++) {
        f[row][column] += node.x[row] * point.gradients[corner][column];
        rate[row][column] += node.v[row] * point.gradients[corner][column];
      }
  }
  // The rotation R of the polar decomposition.
  float cosine = f[0][0] + f[1][1], sine = f[1][0] - f[0][1];
  const float length = fmaxf(sqrtf(cosine * cosine + sine * sine), 1e-12f);
  cosine /= length;
  sine /= length;
  const float modulus = law.lambda + 2.0f * law.mu, twice = 2.0f * law.mu, viscous = 0.5f * law.viscosity * sqrtf(modulus) * point.width;
  const float volumetric = law.lambda * (f[0][0] * f[1][1] - f[0][1] * f[1][0] - 1.0f);
  // The rate of strain, 1/2 (F' R^T + R F'^T), times R: 1/2 (F' + R F'^T R).
  const float turned[2][2] = {{cosine * rate[0][0] - sine * rate[0][1], cosine * rate[1][0] - sine * rate[1][1]},
                              {sine * rate[0][0] + cosine * rate[0][1], sine * rate[1][0] + cosine * rate[1][1]}};
#pragma unroll
  for (int row = 0; row < 2; row++) {
    rate[row][0] += turned[row][0] * cosine + turned[row][1] * sine;
    rate[row][1] += turned[row][1] * cosine - turned[row][0] * sine;
  }
  const float stress[2][2] = {{twice * (f[0][0] - cosine) + volumetric * f[1][1] + viscous * rate[0][0],
                               twice * (f[0][1] + sine) - volumetric * f[1][0] + viscous * rate[0][1]},
                              {twice * (f[1][0] - sine) - volumetric * f[0][1] + viscous * rate[1][0],
                               twice * (f[1][1] - cosine) + volumetric * f[0][0] + viscous * rate[1][1]}};
#pragma unroll
  for (int corner = 0; corner < 4; corner++)
#pragma unroll
    for (int a = 0; a < 2; a++)
      forces[2 * corner + a] = -point.particles * (stress[a][0] * point.gradients[corner][0] + stress[a][1] * point.gradients[corner][1]);
}

// Adds a multiple of a body's position and velocity.
__device__ __forceinline__ void add_scaled(Body& sum, float factor, const Body& other) {
#pragma unroll
  for (int a = 0; a < 2; a++) {
    sum.x[a] += factor * other.x[a];
    sum.v[a] += factor * other.v[a];
  }
}
__device__ __forceinline__ Body zero_body() {
  Body body;
#pragma unroll
  for (int a = 0; a < 2; a++) body.x[a] = body.v[a] = 0.0f;
  return body;
}
// The sum over a node's particles, weighted with their shape functions.
__device__ __forceinline__ Body particle_sum(const Lattice& l, u32 node, const Body* bodies) {
  Body sum = zero_body();
#pragma unroll 4
  for (u32 k = l.sample_first[node]; k < l.sample_first[node + 1]; k++) add_scaled(sum, l.samples[k].weight, bodies[l.samples[k].index]);
  return sum;
}

// Position and velocity of a part.
__device__ __forceinline__ Body part_state(const LatticePart& part, const Body* nodes) {
  Body own = zero_body();
#pragma unroll
  for (int corner = 0; corner < 4; corner++) add_scaled(own, part.weights[corner], nodes[part.nodes[corner]]);
  return own;
}
// The forces of the walls on the nodes of a part.
__device__ __forceinline__ void push(const Lattice& law, const float* lower, const float* upper, const float* fall, const LatticePart& part,
    const Body* nodes, float* forces) {
  const Body own = part_state(part, nodes);
#pragma unroll
  for (int a = 0; a < 2; a++) {
    const float depth = fmaxf(lower[a] - own.x[a], 0.0f) - fmaxf(own.x[a] - upper[a], 0.0f), velocity = own.v[a] + fall[a];
    const float away = fminf(fmaxf((depth > 0.0f ? velocity : -velocity) / REBOUNDING, 0.0f), 1.0f);
    const float force = law.wall_stiffness * part.particles * (1.0f - (1.0f - law.rebound) * away) * depth;
#pragma unroll
    for (int corner = 0; corner < 4; corner++) forces[2 * corner + a] = part.weights[corner] * force;
  }
}

// Mass x squared distance of a node from a place.
__device__ __forceinline__ float weighted_distance(const Lattice& l, u32 node, const Body& own, const float* place) {
  const float x = own.x[0] - place[0], y = own.x[1] - place[1];
  return (x * x + y * y) / l.inverse_mass[node];
}

// Whether a particle of no or another body than `number` is closer than `reach` to a place: thread `lane` of PART_THREADS looks at its share of
// the cells around. Rounding keeps the order of numbers, so that no particle outside of them can be as close.
__device__ __forceinline__ bool is_close(const Stream& s, u32 number, float2 place, float reach, u32 lane) {
  Body low, high;
  low.x[0] = place.x - reach;
  low.x[1] = place.y - reach;
  high.x[0] = place.x + reach;
  high.x[1] = place.y + reach;
  const u32 left = cell_along(s, low, 0), right = cell_along(s, high, 0), top = cell_along(s, high, 1);
  for (u32 row = cell_along(s, low, 1); row <= top; row++) {
    const u32* starts = s.starts + row * s.across[0];
    const u32 end = starts[right + 1];
#pragma unroll 2
    for (u32 slot = starts[left] + lane; slot < end; slot += PART_THREADS) {
      const u32 p = s.order[slot];
      const Body other = s.bodies[p];
      const float x = place.x - other.x[0], y = place.y - other.x[1];
      if (x * x + y * y < reach * reach && s.body_of[p] != number) return true;
    }
  }
  return false;
}

// The motion of body number `number` of a stream by a block of ELASTIC_THREADS, to the prediction: nothing while another particle is close, if it is torn,
// or if its nodes are not where they were expected.
__device__ __forceinline__ void elastic_motion(const Stream& s, const Lattice& l, u32 number) {
  const u32 particles = l.particle_count, nodes = l.node_count, points = l.point_count, parts = l.part_count;
  Body *now = s.lattice_nodes + 2 * l.first_node, *start = now + nodes;
  float* forces = s.lattice_forces + l.first_force;
  // The least-squares fit to the particles: means first, and then what the particles differ by.
  for (u32 node = threadIdx.x; node < nodes; node += ELASTIC_THREADS) {
    Body mean = zero_body();
    add_scaled(mean, l.inverse_mass[node], particle_sum(l, node, s.bodies));
    start[node] = mean;
  }
  __syncthreads();
  for (u32 k = threadIdx.x; k < particles; k += ELASTIC_THREADS) {
    Body residual = s.bodies[l.rows[k]];
#pragma unroll
    for (int corner = 0; corner < 4; corner++) add_scaled(residual, -l.corners[4 * k + corner].weight, start[l.corners[4 * k + corner].index]);
    s.residuals[l.rows[k]] = residual;
  }
  __syncthreads();
  for (u32 node = threadIdx.x; node < nodes; node += ELASTIC_THREADS) now[node] = particle_sum(l, node, s.residuals);
  __syncthreads();
  for (u32 node = threadIdx.x; node < nodes; node += ELASTIC_THREADS) {
    const float* inverse = l.inverse + node;
    Body sum = start[node];
#pragma unroll 8
    for (u32 k = 0; k < nodes; k++) add_scaled(sum, inverse[(size_t)k * nodes], now[k]);
    start[node] = sum;
  }
  __syncthreads();
  float* places_expected = s.lattice_places + 2 * l.first_node;
  float error = 0.0f;
  for (u32 node = threadIdx.x; node < nodes; node += ELASTIC_THREADS) {
    now[node] = start[node];
    error += weighted_distance(l, node, start[node], places_expected + 2 * node);
  }
  error = block_sum<ELASTIC_THREADS>(error);
  const float most_error = s.begun ? s.lattice_errors[number] : NOTHING_EXPECTED;
  __syncthreads();
  if (threadIdx.x == 0) s.lattice_errors[number] = NOTHING_EXPECTED;
  __shared__ int stops, is_pushed;
  if (threadIdx.x == 0) stops = is_pushed = 0;
  const float lower[2] = {s.wall_lower[0] + l.wall_distance, s.wall_lower[1] + l.wall_distance};
  const float upper[2] = {s.wall_upper[0] - l.wall_distance, s.wall_upper[1] - l.wall_distance};
  // Whether the body is torn, or another particle is close to the surface, whose parts are where the forces will be.
  float2* places = (float2*)forces;
  __syncthreads();
  for (u32 i = threadIdx.x; i < parts; i += ELASTIC_THREADS) {
    const Body own = part_state(l.parts[i], now);
    float2 place;
    place.x = own.x[0];
    place.y = own.x[1];
    places[i] = place;
    for (int a = 0; a < 2; a++)
      if (own.x[a] < lower[a] || own.x[a] > upper[a]) is_pushed = 1;
  }
  __syncthreads();
  const float most_stretch = 1.0f + (is_pushed ? PUSHED_STRAIN : 1.0f) * (l.most_stretch - 1.0f);
  for (u32 point = threadIdx.x; point < points; point += ELASTIC_THREADS)
    if (!(stretch(l.points[point], now) <= most_stretch)) stops = 1;
  __syncthreads();
  const int is_torn = stops;
  __syncthreads();
  if (is_torn) return;
  for (u32 i = threadIdx.x / PART_THREADS; i < parts; i += ELASTIC_THREADS / PART_THREADS)
    if (is_close(s, number, places[i], l.clear_distance, threadIdx.x % PART_THREADS)) stops = 1;
  __syncthreads();
  const int stays = stops;
  __syncthreads();
  if (stays) return;
  const float step = s.dt / (float)l.steps, fall[2] = {s.fall[0] / (float)l.steps, s.fall[1] / (float)l.steps};
  for (int k = 0; k < l.steps; k++) {
    for (u32 point = threadIdx.x; point < points; point += ELASTIC_THREADS) point_forces(l, l.points[point], now, forces + 8 * point);
    for (u32 i = threadIdx.x; i < parts; i += ELASTIC_THREADS) push(l, lower, upper, fall, l.parts[i], now, forces + 8 * (points + i));
    __syncthreads();
    for (u32 node = threadIdx.x; node < nodes; node += ELASTIC_THREADS) {
      float force[2] = {0.0f, 0.0f};
#pragma unroll 4
      for (u32 i = l.incident_first[node]; i < l.incident_first[node + 1]; i++) {
        const float2 one = *(const float2*)(forces + 2 * l.incident[i]);
        force[0] += one.x;
        force[1] += one.y;
      }
      Body own = now[node];
#pragma unroll
      for (int a = 0; a < 2; a++) {
        own.v[a] += step * force[a] * l.inverse_mass[node] + fall[a];
        own.x[a] += step * own.v[a];
      }
      now[node] = own;
    }
    __syncthreads();
  }
  float moved = 0.0f;
  for (u32 node = threadIdx.x; node < nodes; node += ELASTIC_THREADS) {
    const Body from = start[node], to = now[node];
    Body impulse;
    float fallen[2];
#pragma unroll
    for (int a = 0; a < 2; a++) {
      const float change = to.v[a] - from.v[a] - s.fall[a];
      fallen[a] = from.x[a] + (from.v[a] + 0.5f * s.fall[a]) * s.dt;
      impulse.v[a] = change;
      impulse.x[a] = to.x[a] - from.x[a] - (from.v[a] + change + 0.5f * s.fall[a]) * s.dt;
      // A lattice that has diverged moves nothing.
      if (!(fabsf(change) <= FASTEST)) stops = 1;
    }
    moved += weighted_distance(l, node, to, fallen);
    start[node] = impulse;
  }
  moved = block_sum<ELASTIC_THREADS>(moved);
  const int diverged = stops;
  __syncthreads();
  if (diverged) return;
  for (u32 node = threadIdx.x; node < nodes; node += ELASTIC_THREADS)
    for (int a = 0; a < 2; a++) places_expected[2 * node + a] = now[node].x[a];
  if (threadIdx.x == 0 && l.most_error < NOTHING_EXPECTED)
    s.lattice_errors[number] = l.most_error * moved + (float)particles * l.small_error * l.small_error;
  if (most_error < NOTHING_EXPECTED && !(error <= most_error)) return;
  for (u32 k = threadIdx.x; k < particles; k += ELASTIC_THREADS) {
    Body impulse = zero_body(), next = s.bodies[l.rows[k]];
#pragma unroll
    for (int corner = 0; corner < 4; corner++) add_scaled(impulse, l.corners[4 * k + corner].weight, start[l.corners[4 * k + corner].index]);
#pragma unroll
    for (int a = 0; a < 2; a++) {
      const float v = next.v[a] + impulse.v[a];
      next.x[a] = clamp_axis(s, a, next.x[a] + (v + 0.5f * s.fall[a]) * s.dt + impulse.x[a]);
      next.v[a] = v + s.fall[a];
    }
    s.next[l.rows[k]] = next;
  }
}

// A block has a body. grid (bodies, B), block ELASTIC_THREADS
extern "C" __global__ void __launch_bounds__(ELASTIC_THREADS) elastic(const Stream* __restrict__ streams, const float* __restrict__ constants, int rule, int step) {
  const Stream& s = streams[blockIdx.y];
  for (u32 body = blockIdx.x; body < (u32)s.lattice_count; body += gridDim.x) elastic_motion(s, s.lattices[body], body);
}
