// Front-to-back blending, one 4 x 4 block of pixels per F32x16.
#include <algorithm>

#include "pool.h"
#include "raster_tile.h"

namespace se::raster {
namespace {

struct Pixels {  // the pixels of a tile in block order
  alignas(64) float through[256], left[256], color[3][256], depth[256];
};

// Blend the batch's list into one block until no pixel lets light through. Return how many Gaussians of the list
// that took. `through` falls below the stop; `left` keeps the value before it.
int blend_block(const Batch& batch, int block, Pixels& px, const Exp2& exp2, bool& alive) {
  const F32x16 y = block_y(block / 4), stop = broadcast(kMinTransmittance);
  const int at = block * 16, column = block % 4;
  F32x16 through = load(px.through + at), left = load(px.left + at);
  F32x16 sum[4] = {load(px.color[0] + at), load(px.color[1] + at), load(px.color[2] + at), load(px.depth + at)};
  int i = 0;
  for (alive = true; i < batch.list.count && alive; i += 4) {
    const Row* row[4];
    F32x16 alpha[4];
    for (int k = 0; k < 4; ++k) row[k] = &batch.row(batch.list.place[i + k]);
    compute_alphas(row, column, y, exp2, alpha);
    for (int k = 0; k < 4; ++k) {
      const F32x16 weight = through * alpha[k];
      through = fnma(through, alpha[k], through);
      const Mask16 drawn = ge(through, stop);
      left = select(drawn, through, left);
      add_where(drawn, weight, &row[k]->r, sum);
    }
    alive = any(ge(through, stop));
  }
  store(px.through + at, through), store(px.left + at, left), store(px.depth + at, sum[3]);
  for (int c = 0; c < 3; ++c) store(px.color[c] + at, sum[c]);
  return i;
}

void write_tile(State& s, int number, const Tile& tile, Pixels& px, const float* background, const Outputs& out) {
  std::copy(px.left, px.left + 256, s.transmittance.data() + number * 256);
  for (int k = 0; k < 256; k += 16) {
    const F32x16 left = load(px.left + k);
    for (int c = 0; c < 3; ++c) store(px.color[c] + k, fma(left, broadcast(background[c]), load(px.color[c] + k)));
    store(px.left + k, broadcast(1.0f) - left);
  }
  store_tile(out.image, s.camera, tile, px.color);
  store_tile(out.alpha, s.camera, tile, px.left);
  store_tile(out.depth, s.camera, tile, px.depth);
}

void blend_tile(State& s, int number, Batch& batch, const float* background, const Outputs& out, const Exp2& exp2) {
  const Tile tile = tile_at(s, number);
  Pixels px;
  mark_inside(s.camera, tile, px.through);
  std::copy(px.through, px.through + 256, px.left);
  std::fill(&px.color[0][0], &px.color[0][0] + 768, 0.0f);
  std::fill(px.depth, px.depth + 256, 0.0f);
  uint32_t alive = 0;
  for (int b = 0; b < 16; ++b) alive |= (px.through[16 * b] > 0.0f ? 1u : 0u) << b;  // if any pixel of a block is inside, the first one is
  const uint32_t begin = s.tile_begin.data()[number], end = s.tile_begin.data()[number + 1];
  uint32_t at = begin;
  while (at < end && alive) {
    const int n = static_cast<int>(std::min<uint32_t>(kBatch, end - at));
    const uint32_t* from = s.list.data() + at;
    const int64_t number_of_batch = s.batch(number, static_cast<int>((at - begin) / kBatch));
    if (at > begin) std::copy(px.through, px.through + 256, s.checkpoints.data() + number_of_batch * 256);
    Touched& touched = *reinterpret_cast<Touched*>(s.masks.data() + number_of_batch * kBatch);
    uint16_t* drawn = s.drawn.data() + number_of_batch * 16;
    test_blocks(s.records.data(), from, n, tile, touched);
    uint16_t any[kGroups];
    merge_blocks(touched, alive, n, any);
    batch.load_rows(s.records.data(), from, any, n, tile);
    for (const int b : kBlockOrder) {
      drawn[b] = 0;
      if (!(alive >> b & 1)) continue;
      batch.fill_list(touched, b, n);
      if (batch.list.count == 0) continue;
      bool still;
      drawn[b] = static_cast<uint16_t>(blend_block(batch, b, px, exp2, still));
      if (!still) alive &= ~(1u << b);
    }
    at += static_cast<uint32_t>(n);
  }
  s.tile_used.data()[number] = at - begin;
  write_tile(s, number, tile, px, background, out);
}

}  // namespace

void blend(State& s, const float* background, const Outputs& out, int threads) {
  s.transmittance.get(static_cast<size_t>(s.tiles()) * 256);
  s.checkpoints.get(s.batches() * 256);
  s.masks.get(s.batches() * kBatch), s.drawn.get(s.batches() * 16);
  distribute_tiles(s, threads, [&](int begin, int end, int) {
    Batch& batch = thread_scratch<Batch>();
    const Exp2 exp2;
    for (int t = begin; t < end; ++t) blend_tile(s, t, batch, background, out, exp2);
  });
}

}  // namespace se::raster
