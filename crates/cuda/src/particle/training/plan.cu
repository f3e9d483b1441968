// Training of the particle model, beside the kernels that predict with it. A sheet is a frame of a window: sheet t B + b is frame
// t of window b, and sheets have a grid each. Lists of particles are [T, B, most, ..] in the order of the particles, `most`
// being those of the largest window; lists of nodes are [T, B, nodes, ..], as long as there can be nodes. Sums have a fixed
// order; only integers are counted atomically.
//
// Constants beside those of the predictions:
//   LEARN_WARPS warps of a block that has particles

// Lists of features at nodes: what particles sum up, then the outputs of the layers.
#define FIELDS (4 * LEVELS)
#define MAX_FIELDS (4 * MAX_LEVELS)
#define OUT4 ROUND4(2 * DIM)

// What all kernels of a step share.
struct Plan {
  // Trajectories: bodies of all frames; of each stream the number of its particles, their materials, [streams, most], and the
  // feature of its stiffness.
  const Body* store;
  const u32* counts;
  const unsigned char* material;
  const float* stiffness;
  // First link of each particle, [2 streams, most + 1], of a stream as it is and mirrored; the same of the links to a
  // particle. None, where no particle has a rest shape.
  const u32* link_first;
  const Link* links;
  const u32* incoming_first;
  const Link* incoming;
  // The step.
  const Window* windows;
  const Progress* progress;
  const Body* error_weights; // [unroll, B, MATERIALS]
  // Kept of each frame.
  Body* states;
  u32* starts;               // [T, B, cells + 1] first slot of each cell
  u32* order;                // particle of each slot: by cells, then by number
  float* weights;            // weights of the particle in a slot, 3 for each axis
  u32* maps[MAX_LEVELS];     // number of each node
  u32* lists[MAX_LEVELS];    // entry of each node
  u32* around[MAX_LEVELS];   // [.., STENCIL] the nodes around each node, MISSING where there is none
  u32* children[MAX_LEVELS]; // [.., CHILDREN] its children, but for the finest level
  u32* totals;               // [T, B, LEVELS] nodes
  float* inputs;             // [.., CONCAT] features and gathered numbers
  float* hidden;             // [.., E4] of the encoder
  float* encoded;            // [.., C04]
  float* context;            // [.., H4]
  float* gates;              // [LAYERS, T, B, most, GATE_SUMS H4], later gradients by the sums
  float* outputs;            // [LAYERS, T + 1, B, most, H4] of the core, those before the first frame first
  float* cells;              // the same of LSTM
  float* mixed;              // [.., H4]
  float* output;             // [.., OUT4] of the decoder, later gradients by it
  float* fields[MAX_FIELDS];
  // Gradients of each frame, by the sums before the activations.
  float* by_hidden;
  float* by_encoded;
  float* by_context;
  float* by_mixed;
  float* slopes[MAX_FIELDS];
  // Of the frames that are computed together.
  u32* cell_counts;          // [.., cells]
  u32* cell_of;              // cell of each particle
  u32* arrivals;             // place among the particles of the cell, in any order
  u32* unsorted;             // particles by cells, in any order within a cell
  float* by_inputs;          // [.., CONCAT]
  // Gradients that go from a frame to the one before.
  Body* by_state;            // [B, most]
  float* by_output;          // [LAYERS, B, most, H4] by the core's outputs
  float* by_cell;
  float* by_expected;        // [B, most, DIM] by the velocities that the ballistic step expects
  float* by_shape;           // [B, most, DIM DIM + DIM] by deformation gradient and bend
  // The loss.
  float* squares;            // [T, B, chunks]
  float* scales;             // [2, B] free, observed
  int batch, warm_up, unroll, most;
  int weights_step;          // bodies of error weights from a step to the next one
  u32 across[DIM];           // of the map of level 0
  u32 entries[MAX_LEVELS];
  u32 nodes[MAX_LEVELS];     // most nodes
  float lower[DIM], extent[DIM]; // the domain's lower corner, its size (cells)
  float width;               // of a cell
  float wall_lower[DIM], wall_upper[DIM], fall[DIM], dt;
  float unit;                // of velocities
  float slowest[DIM], fastest[DIM];
  float sides, even;         // left plus right wall; weight of observed frames
};

__device__ __forceinline__ const Window& window_of(const Plan& s, int b) { return s.windows[(size_t)s.progress->step * s.batch + b]; }
__device__ __forceinline__ u32 particles_of(const Plan& s, int b) { return s.counts[window_of(s, b).stream]; }
// Numbers of a particle's place in lists that go over layers and frames.
__device__ __forceinline__ size_t particle_row(const Plan& s, int sheet, u32 p) { return (size_t)sheet * s.most + p; }
__device__ __forceinline__ size_t layer_row(const Plan& s, int layer, int sheets, int sheet, u32 p) {
  return particle_row(s, layer * sheets + sheet, p);
}
__device__ __forceinline__ int frames_of(const Plan& s) { return s.warm_up + s.unroll - 1; }

// A particle's stencil, and its distance from the lowest node along each axis (cells).
struct PlacedStencil : Stencil { float place[DIM]; };
static_assert(sizeof(PlacedStencil) == STENCIL_BYTES + 4 * DIM, "of training/layout.rs");
__device__ __forceinline__ PlacedStencil stencil_of(const Plan& s, int sheet, const Body& body) {
  PlacedStencil found;
  int base[DIM];
#pragma unroll
  for (int a = 0; a < DIM; a++) {
    const float place = cell_place(s, body, a), lowest = stencil(place);
    base[a] = (int)lowest;
    found.place[a] = place - lowest;
    spline_weights(found.place[a], found.weights[a]);
  }
  set_rows(s, s.maps[0] + (size_t)sheet * s.entries[0], cell_entry(s, base), found);
  return found;
}

// The node at a place of a node's row, or MISSING.
__device__ __forceinline__ u32 node_at(const Plan& s, int sheet, int stencil, int level, u32 node, int place) {
  const size_t row = (size_t)sheet * s.nodes[level] + node;
  if (stencil == NEIGHBOURS) return s.around[level][row * STENCIL + place];
  return stencil == FROM_CHILDREN ? s.children[level][row * CHILDREN + place] : node;
}
