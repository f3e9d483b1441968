// The elastic impulse of jelly, after which the network sees it (`kernels/lattice` of eddy-inference).

// A particle or a node, and its weight.
struct LatticeShare { u32 index; float weight; };
// First node and number of nodes of a body, and where its matrix begins.
struct LatticeBody { u32 first, count, inverse; };
// A quadrature point: the nodes of its element, the gradients of their shape functions, its particles, and the width of the element.
struct LatticePoint {
  u32 nodes[4];
  float gradients[4][2];
  float particles, width;
};
// A part of a surface: the nodes of its element, their shape functions, its particles, and the parts of its body.
struct LatticePart {
  u32 nodes[4];
  float weights[4];
  float particles;
  u32 first, end;
};
// The lattices of a stream's bodies, and the law: Lame parameters, viscosity, accelerations by walls, and contact of bodies.
struct Lattice {
  const u32* rows;             // particle
  const LatticeShare* corners; // [particles, 4] the nodes of its element
  const u32* sample_first;     // [nodes + 1] first sample of each node
  const LatticeShare* samples; // the particles that have the node, and its shape functions there
  const LatticeBody* bodies;   // of each node
  const float* inverse;        // of the matrix of each body's fit, [nodes, nodes]
  const float* inverse_mass;   // of each node, in units of a particle's mass
  const u32* incident_first;   // [nodes + 1] first force on each node
  const u32* incident;         // [(points + parts) 4] the forces, those of points first
  const LatticePoint* points;
  const LatticePart* parts;
  u32 particle_count, node_count, point_count, part_count;
  float mu, lambda, viscosity, wall_distance, wall_stiffness, rebound, contact_distance, contact_stiffness, contact_viscosity;
  int steps;
};
#define ELASTIC_THREADS 512
// Largest change of a node's velocity, stretch from which on a point has no stress, speed away from a wall from which on it pushes least:
// `FASTEST`, `TORN` and `REBOUNDING` of eddy-inference.
#define FASTEST 64.0f
#define TORN 1.6f
#define REBOUNDING 0.1f

// What the network sees of a particle, and what the impulse adds to its position after the ballistic step. There are no impulses
// where the network sees matter as it is.
template <class S> __device__ __forceinline__ Body seen_body(const S& s, size_t row, Body body) {
  if (s.impulses)
#pragma unroll
    for (int a = 0; a < 2; a++) body.v[a] += s.impulses[row].v[a];
  return body;
}
template <class S> __device__ __forceinline__ float elastic_displacement(const S& s, size_t row, int axis) {
  return s.impulses ? s.impulses[row].x[axis] : 0.0f;
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
  // The rotation R of the polar decomposition; the sum and the difference of the stretches.
  float cosine = f[0][0] + f[1][1], sine = f[1][0] - f[0][1];
  const float length = fmaxf(sqrtf(cosine * cosine + sine * sine), 1e-12f), apart = 2.0f * TORN - length;
  const float across = f[0][0] - f[1][1], along = f[1][0] + f[0][1];
  const float area = apart < 0.0f || across * across + along * along > apart * apart ? 0.0f : point.particles;
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
      forces[2 * corner + a] = -area * (stress[a][0] * point.gradients[corner][0] + stress[a][1] * point.gradients[corner][1]);
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

// Adds the force of the walls on a part.
__device__ __forceinline__ void push(const Lattice& law, const float* lower, const float* upper, const float* fall, const LatticePart& part, const Body& own,
    float* force) {
#pragma unroll
  for (int a = 0; a < 2; a++) {
    const float depth = fmaxf(lower[a] - own.x[a], 0.0f) - fmaxf(own.x[a] - upper[a], 0.0f), velocity = own.v[a] + fall[a];
    const float away = fminf(fmaxf((depth > 0.0f ? velocity : -velocity) / REBOUNDING, 0.0f), 1.0f);
    force[a] += law.wall_stiffness * part.particles * (1.0f - (1.0f - law.rebound) * away) * depth;
  }
}
// Adds the forces of the parts from `first` to `end`, of other bodies, on a part.
__device__ __forceinline__ void add_contact(const Lattice& law, const LatticePart& part, const Body& own, const Body* states, u32 first, u32 end, float* force) {
#pragma unroll 4
  for (u32 other = first; other < end; other++) {
    const Body to = states[other];
    const float apart[2] = {own.x[0] - to.x[0], own.x[1] - to.x[1]}, squared = apart[0] * apart[0] + apart[1] * apart[1];
    if (!(squared < law.contact_distance * law.contact_distance)) continue;
    const float particles = law.parts[other].particles, gap = fmaxf(sqrtf(squared), 1e-9f);
    const float depth = 2.0f * part.particles * particles / (part.particles + particles) * (law.contact_distance - gap);
    const float spring = law.contact_stiffness * depth / gap, exchange = law.contact_viscosity * depth / law.contact_distance;
#pragma unroll
    for (int a = 0; a < 2; a++) force[a] += spring * apart[a] - exchange * (own.v[a] - to.v[a]);
  }
}

// The impulses of n particles by a block of ELASTIC_THREADS: x is added to the position after the ballistic step, v to the velocity
// before. `s` has walls (domain lengths), fall (domain lengths per second) and dt (s); `now` and `start` have room for the nodes, `forces` for
// 8 numbers a point and 12 a part: forces on four nodes, and the position and velocity of a part.
template <class S> __device__ __forceinline__ void elastic_impulses(const Lattice& l, const S& s, u32 n, const Body* bodies, Body* impulses, Body* now,
    Body* start, float* forces) {
  const u32 particles = l.particle_count, nodes = l.node_count, points = l.point_count, parts = l.part_count;
  for (u32 p = threadIdx.x; p < n; p += ELASTIC_THREADS) impulses[p] = zero_body();
  // The least-squares fit to the particles: means first, and then what the particles differ by.
  for (u32 node = threadIdx.x; node < nodes; node += ELASTIC_THREADS) {
    Body mean = zero_body();
    add_scaled(mean, l.inverse_mass[node], particle_sum(l, node, bodies));
    start[node] = mean;
  }
  __syncthreads();
  for (u32 k = threadIdx.x; k < particles; k += ELASTIC_THREADS) {
    Body residual = bodies[l.rows[k]];
#pragma unroll
    for (int corner = 0; corner < 4; corner++) add_scaled(residual, -l.corners[4 * k + corner].weight, start[l.corners[4 * k + corner].index]);
    impulses[l.rows[k]] = residual;
  }
  __syncthreads();
  for (u32 node = threadIdx.x; node < nodes; node += ELASTIC_THREADS) now[node] = particle_sum(l, node, impulses);
  __syncthreads();
  for (u32 node = threadIdx.x; node < nodes; node += ELASTIC_THREADS) {
    const LatticeBody body = l.bodies[node];
    const float* inverse = l.inverse + body.inverse + (node - body.first);
    Body sum = start[node];
#pragma unroll 8
    for (u32 k = 0; k < body.count; k++) add_scaled(sum, inverse[(size_t)k * body.count], now[body.first + k]);
    start[node] = sum;
  }
  __syncthreads();
  for (u32 node = threadIdx.x; node < nodes; node += ELASTIC_THREADS) now[node] = start[node];
  __syncthreads();
  const float step = s.dt / (float)l.steps, fall[2] = {s.fall[0] / (float)l.steps, s.fall[1] / (float)l.steps};
  const float lower[2] = {s.wall_lower[0] + l.wall_distance, s.wall_lower[1] + l.wall_distance};
  const float upper[2] = {s.wall_upper[0] - l.wall_distance, s.wall_upper[1] - l.wall_distance};
  Body* states = (Body*)(forces + 8 * (points + parts));
  for (int k = 0; k < l.steps; k++) {
    for (u32 point = threadIdx.x; point < points; point += ELASTIC_THREADS) point_forces(l, l.points[point], now, forces + 8 * point);
    for (u32 i = threadIdx.x; i < parts; i += ELASTIC_THREADS) {
      Body own = zero_body();
#pragma unroll
      for (int corner = 0; corner < 4; corner++) add_scaled(own, l.parts[i].weights[corner], now[l.parts[i].nodes[corner]]);
      states[i] = own;
    }
    __syncthreads();
    for (u32 i = threadIdx.x; i < parts; i += ELASTIC_THREADS) {
      const LatticePart& part = l.parts[i];
      const Body own = states[i];
      float force[2] = {0.0f, 0.0f};
      push(l, lower, upper, fall, part, own, force);
      add_contact(l, part, own, states, 0, part.first, force);
      add_contact(l, part, own, states, part.end, parts, force);
#pragma unroll
      for (int corner = 0; corner < 4; corner++)
#pragma unroll
        for (int a = 0; a < 2; a++) forces[8 * (points + i) + 2 * corner + a] = part.weights[corner] * force[a];
    }
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
  for (u32 node = threadIdx.x; node < nodes; node += ELASTIC_THREADS) {
    const Body from = start[node], to = now[node];
    Body impulse;
#pragma unroll
    for (int a = 0; a < 2; a++) {
      const float change = to.v[a] - from.v[a] - s.fall[a];
      impulse.v[a] = change;
      impulse.x[a] = to.x[a] - from.x[a] - (from.v[a] + change + 0.5f * s.fall[a]) * s.dt;
    }
    start[node] = impulse;
  }
  __syncthreads();
  // A body whose lattice has diverged gets none.
  for (u32 node = threadIdx.x; node < nodes; node += ELASTIC_THREADS) {
    const LatticeBody body = l.bodies[node];
    // Without branches, so that many are loaded at once.
    int converged = 1;
#pragma unroll 8
    for (u32 k = body.first; k < body.first + body.count; k++)
#pragma unroll
      for (int a = 0; a < 2; a++) converged &= fabsf(start[k].v[a]) <= FASTEST;
    now[node] = converged ? start[node] : zero_body();
  }
  __syncthreads();
  for (u32 k = threadIdx.x; k < particles; k += ELASTIC_THREADS) {
    Body impulse = zero_body();
#pragma unroll
    for (int corner = 0; corner < 4; corner++) add_scaled(impulse, l.corners[4 * k + corner].weight, now[l.corners[4 * k + corner].index]);
    impulses[l.rows[k]] = impulse;
  }
}

// The impulses of the streams that have jelly. grid (1, B), block ELASTIC_THREADS
extern "C" __global__ void __launch_bounds__(ELASTIC_THREADS) particle_elastic(const Stream* __restrict__ streams) {
  const Stream& s = streams[blockIdx.y];
  if (!s.lattice) return;
  const Lattice& l = *s.lattice;
  elastic_impulses(l, s, s.particles, s.bodies, s.impulses, s.lattice_nodes, s.lattice_nodes + l.node_count, s.lattice_forces);
}
