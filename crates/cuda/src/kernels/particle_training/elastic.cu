// The elastic impulses of sheets from `first` on; lattices are [2 streams], of a stream as it is and mirrored.
// grid (1, sheets), block ELASTIC_THREADS
extern "C" __global__ void __launch_bounds__(ELASTIC_THREADS) train_elastic(const Plan* __restrict__ plan, const Lattice* __restrict__ lattices,
    int first) {
  const Plan& s = *plan;
  const int sheet = first + blockIdx.y, b = sheet % s.batch;
  const Window& window = window_of(s, b);
  const size_t at = particle_row(s, sheet, 0);
  Body* nodes = s.lattice_nodes + (size_t)blockIdx.y * 2 * s.most_lattice_nodes;
  elastic_impulses(lattices[2 * window.stream + window.mirrored], s, particles_of(s, b), s.states + at, s.impulses + at, nodes,
      nodes + s.most_lattice_nodes, s.lattice_forces + (size_t)blockIdx.y * s.most_lattice_forces);
}
