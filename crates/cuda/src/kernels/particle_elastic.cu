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
  const u32* others;           // particles in no body
  u32 particle_count, node_count, point_count, part_count, other_count;
  float mu, lambda, viscosity, wall_distance, wall_stiffness, rebound, contact_distance, contact_stiffness, contact_viscosity;
  int steps;
};
#define ELASTIC_THREADS 512
// Largest change of a node's velocity, stretch from which on a point has no stress, speed away from a wall from which on it pushes least:
// `FASTEST`, `TORN` and `REBOUNDING` of eddy-inference.
#define FASTEST 64.0f
#define TORN 1.6f
#define REBOUNDING 0.1f
// Of particles of other matter: `INERTIA`, `EXCHANGE` and `FOUND`.
#define LOOSE_INERTIA 4.0f
#define LOOSE_EXCHANGE 0.4f
#define LOOSE_FOUND 2.0f

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
// A part of a surface or a particle of other matter that all threads of a block look at, and where it was at the beginning of the frame.
struct Near { Body body; float start[2], particles; };
// Calls use(first, count) for so many of all of `total` at a time, which load(index) has put to `near`.
template <class Load, class Use> __device__ __forceinline__ void over_tiles(Near* near, u32 total, Load load, Use use) {
  for (u32 first = 0; first < total; first += ELASTIC_THREADS) {
    const u32 count = min(total - first, (u32)ELASTIC_THREADS);
    if (threadIdx.x < count) near[threadIdx.x] = load(first + threadIdx.x);
    __syncthreads();
    use(first, count);
    __syncthreads();
  }
}
__device__ __forceinline__ float squared_distance(const float* one, const float* other) {
  const float x = one[0] - other[0], y = one[1] - other[1];
  return x * x + y * y;
}
// Adds the forces of the parts of other bodies among `count`, the first of which is number `first`, on a part.
__device__ __forceinline__ void add_contact(const Lattice& law, const LatticePart& part, const Body& own, const Near* near, u32 first, u32 count, float* force) {
  const u32 own_parts = part.end - part.first;
#pragma unroll 4
  for (u32 k = 0; k < count; k++) {
    const Body to = near[k].body;
    const float squared = squared_distance(own.x, to.x);
    if (!(squared < law.contact_distance * law.contact_distance) || first + k - part.first < own_parts) continue;
    const float particles = near[k].particles, gap = fmaxf(sqrtf(squared), 1e-9f);
    const float depth = 2.0f * part.particles * particles / (part.particles + particles) * (law.contact_distance - gap);
    const float spring = law.contact_stiffness * depth / gap, exchange = law.contact_viscosity * depth / law.contact_distance;
#pragma unroll
    for (int a = 0; a < 2; a++) force[a] += spring * (own.x[a] - to.x[a]) - exchange * (own.v[a] - to.v[a]);
  }
}
// Adds the forces between a part and particles of other matter, or between one of these and parts, that were close at the beginning.
__device__ __forceinline__ void add_exchange(const Lattice& law, float rate, const Near& own, const Near* near, u32 count, float* force) {
  const float distance = law.contact_distance, found = LOOSE_FOUND * distance;
#pragma unroll 4
  for (u32 k = 0; k < count; k++) {
    const Body to = near[k].body;
    const float squared = squared_distance(own.body.x, to.x);
    if (!(squared < distance * distance) || !(squared_distance(own.start, near[k].start) < found * found)) continue;
    const float share = rate * (1.0f - sqrtf(squared) / distance);
#pragma unroll
    for (int a = 0; a < 2; a++) force[a] += share * (to.v[a] - own.body.v[a]);
  }
}
// The sum of the numbers of the threads up to this one; `sums` has room for all.
__device__ __forceinline__ u32 running_sum(u32 own, u32* sums) {
  sums[threadIdx.x] = own;
  __syncthreads();
  for (u32 apart = 1; apart < ELASTIC_THREADS; apart *= 2) {
    const u32 before = threadIdx.x >= apart ? sums[threadIdx.x - apart] : 0;
    __syncthreads();
    sums[threadIdx.x] += before;
    __syncthreads();
  }
  return sums[threadIdx.x];
}

// The impulses of n particles by a block of ELASTIC_THREADS: x is added to the position after the ballistic step, v to the velocity
// before. `s` has walls (domain lengths), fall (domain lengths per second) and dt (s); `now` and `start` have room for the nodes, `forces` for
// 8 numbers a point, 14 a part and 5 a particle in no body: forces on four nodes; position and velocity of a part, and its first position; position,
// velocity and number of a particle.
template <class S> __device__ __forceinline__ void elastic_impulses(const Lattice& l, const S& s, u32 n, const Body* bodies, Body* impulses, Body* now,
    Body* start, float* forces) {
  const u32 particles = l.particle_count, nodes = l.node_count, points = l.point_count, parts = l.part_count, others = l.other_count;
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
  Body *states = (Body*)(forces + 8 * (points + parts)), *loose = states + parts;
  float* starts = (float*)(loose + others);
  u32* loose_rows = (u32*)(starts + 2 * parts);
  __shared__ Near near[ELASTIC_THREADS];
  __shared__ u32 sums[ELASTIC_THREADS];
  const auto locate = [&] {
    for (u32 i = threadIdx.x; i < parts; i += ELASTIC_THREADS) {
      Body own = zero_body();
#pragma unroll
      for (int corner = 0; corner < 4; corner++) add_scaled(own, l.parts[i].weights[corner], now[l.parts[i].nodes[corner]]);
      states[i] = own;
    }
  };
  const auto part_near = [&](u32 i) { return Near{states[i], {starts[2 * i], starts[2 * i + 1]}, l.parts[i].particles}; };
  const auto loose_near = [&](u32 i) { const float* start = bodies[loose_rows[i]].x; return Near{loose[i], {start[0], start[1]}, 1.0f}; };
  // The particles of other matter that are close to surfaces, in the order of the list.
  locate();
  for (u32 i = threadIdx.x; i < parts; i += ELASTIC_THREADS)
#pragma unroll
    for (int a = 0; a < 2; a++) starts[2 * i + a] = states[i].x[a];
  __syncthreads();
  u32 loose_count = 0;
  for (u32 begin = 0; begin < others; begin += ELASTIC_THREADS) {
    const u32 k = begin + threadIdx.x, row = l.others[k < others ? k : 0];
    const Body own = bodies[row];
    const float found = LOOSE_FOUND * l.contact_distance;
    u32 close = 0;
    over_tiles(near, parts, part_near, [&](u32, u32 count) {
#pragma unroll 4
      for (u32 i = 0; i < count; i++) close |= squared_distance(own.x, near[i].start) < found * found;
    });
    if (k >= others) close = 0;
    const u32 place = loose_count + running_sum(close, sums) - close;
    if (close) {
      loose_rows[place] = row;
      loose[place] = own;
    }
    loose_count += sums[ELASTIC_THREADS - 1];
    __syncthreads();
  }
  // A faster exchange would be unstable.
  const float rate = fminf(LOOSE_EXCHANGE * l.contact_viscosity, 1.0f / step);
  for (int k = 0; k < l.steps; k++) {
    for (u32 point = threadIdx.x; point < points; point += ELASTIC_THREADS) point_forces(l, l.points[point], now, forces + 8 * point);
    locate();
    __syncthreads();
    for (u32 begin = 0; begin < parts; begin += ELASTIC_THREADS) {
      const u32 i = min(begin + threadIdx.x, parts - 1);
      const LatticePart& part = l.parts[i];
      const Near own = part_near(i);
      float force[2] = {0.0f, 0.0f};
      push(l, lower, upper, fall, part, own.body, force);
      // One body has no other to touch.
      if (l.parts[0].end < parts)
        over_tiles(near, parts, part_near, [&](u32 first, u32 count) { add_contact(l, part, own.body, near, first, count, force); });
      over_tiles(near, loose_count, loose_near, [&](u32, u32 count) { add_exchange(l, rate, own, near, count, force); });
      if (begin + threadIdx.x >= parts) continue;
#pragma unroll
      for (int corner = 0; corner < 4; corner++)
#pragma unroll
        for (int a = 0; a < 2; a++) forces[8 * (points + i) + 2 * corner + a] = part.weights[corner] * force[a];
    }
    for (u32 begin = 0; begin < loose_count; begin += ELASTIC_THREADS) {
      const u32 i = min(begin + threadIdx.x, loose_count - 1);
      const Near own = loose_near(i);
      Body moved = own.body;
      float force[2] = {0.0f, 0.0f};
      over_tiles(near, parts, part_near, [&](u32, u32 count) { add_exchange(l, rate, own, near, count, force); });
      if (begin + threadIdx.x >= loose_count) continue;
#pragma unroll
      for (int a = 0; a < 2; a++) {
        moved.v[a] += step * force[a] * (1.0f / LOOSE_INERTIA) + fall[a];
        moved.x[a] += step * moved.v[a];
      }
      loose[i] = moved;
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
  const auto between = [&](const Body& from, const Body& to) {
    Body impulse;
#pragma unroll
    for (int a = 0; a < 2; a++) {
      const float change = to.v[a] - from.v[a] - s.fall[a];
      impulse.v[a] = change;
      impulse.x[a] = to.x[a] - from.x[a] - (from.v[a] + change + 0.5f * s.fall[a]) * s.dt;
    }
    return impulse;
  };
  for (u32 node = threadIdx.x; node < nodes; node += ELASTIC_THREADS) start[node] = between(start[node], now[node]);
  for (u32 i = threadIdx.x; i < loose_count; i += ELASTIC_THREADS) {
    const Body impulse = between(bodies[loose_rows[i]], loose[i]);
    if (fabsf(impulse.v[0]) <= FASTEST && fabsf(impulse.v[1]) <= FASTEST) impulses[loose_rows[i]] = impulse;
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
