// A layer on sheets from `first` on, whose lists begin with those of sheet 0.
// grid (tiles, sheets), block NODE_LAYER_THREADS
extern "C" __global__ void __launch_bounds__(NODE_LAYER_THREADS) train_layer(const Plan* __restrict__ plan, NodeLayer layer, int first) {
  const Plan& s = *plan;
  const int sheet = first + blockIdx.y, level = layer.level;
  const int source = layer.stencil == FROM_CHILDREN ? level - 1 : level, target = layer.stencil == TO_CHILDREN ? level - 1 : level;
  const u32 total = s.totals[sheet * LEVELS + level];
  if (blockIdx.x >= tiles_of(layer, total)) return;
  layer.from += (size_t)sheet * s.nodes[source] * layer.width;
  const size_t at = (size_t)sheet * s.nodes[target] * layer.outputs;
  layer.to += at;
  if (layer.add) layer.add += at;
  if (layer.mask) layer.mask += at;
  layer_tile(layer, total, blockIdx.x, [&](int stencil, u32 node, int place) { return node_at(s, sheet, stencil, level, node, place); });
}
