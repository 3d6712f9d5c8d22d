// Backward blending. With s_i = colour_i . g (and depth) and behind_i what is seen behind Gaussian i, weighted alike,
//   behind_(i-1) = alpha_i s_i + (1 - alpha_i) behind_i,   W_i = w_i (s_i - behind_i) = d loss / d power_i,   w_i = T_i alpha_i,
// so nothing is divided and nothing cancels: for each batch, last one first, a pass near to far makes alpha_i and w_i from the checkpoint
// that forward left, and a pass far to near makes W_i. All gradients of the ellipse are six moments of W over the pixels; sixteen Gaussians
// are reduced together, one per lane.
#include <algorithm>
#include <cstring>

#include "pool.h"
#include "raster_tile.h"

namespace se::raster {
namespace {

struct Pixels {
  alignas(64) float through[256], behind[256], color[3][256], depth[256];  // color, depth: upstream gradients
};

struct Work {
  Batch batch;
  F16 alpha[kBatch + 16], w[kBatch + 16];  // of one block's list
};

// Adds the sixteen Gaussians' sums over one block. `weights` (w) and W are rows of pixels.
template <bool Depth>
void reduce(Work& work, int first, const F16* weights, F16 (&W)[16], const Pixels& px, int block, const Tile& tile) {
  F16 out[16], w[16];
  const int at = block * 16;
  std::copy(weights, weights + 16, w);
  transpose(w);
  const auto weighted = [&](const float* g) {  // two sums side by side: half as long a chain
    F16 even = w[0] * bcast(g[0]), odd = w[1] * bcast(g[1]);
    for (int l = 2; l < 16; l += 2) even = fma(w[l], bcast(g[l]), even), odd = fma(w[l + 1], bcast(g[l + 1]), odd);
    return even + odd;
  };
  out[kRed] = weighted(px.color[0] + at), out[kGreen] = weighted(px.color[1] + at), out[kBlue] = weighted(px.color[2] + at);
  out[kDepth] = Depth ? weighted(px.depth + at) : bcast(0.0f);

  // Moments about the block's centre in half pixels, -3 -1 1 3: by rows first, then over the rows.
  transpose(W);
  const F16 three = bcast(3.0f), nine = bcast(9.0f);
  F16 row0[4], row1[4], row2[4];
  for (int j = 0; j < 4; ++j) {
    const F16 outer = W[4 * j] + W[4 * j + 3], inner = W[4 * j + 1] + W[4 * j + 2];
    row0[j] = outer + inner;
    row1[j] = fma(three, W[4 * j + 3] - W[4 * j], W[4 * j + 2] - W[4 * j + 1]);
    row2[j] = fma(nine, outer, inner);
  }
  const F16 outer = row0[0] + row0[3], inner = row0[1] + row0[2], half = bcast(0.5f), quarter = bcast(0.25f);
  const F16 m = outer + inner;
  const F16 my = fma(three, row0[3] - row0[0], row0[2] - row0[1]) * half, myy = fma(nine, outer, inner) * quarter;
  const F16 mx = ((row1[0] + row1[3]) + (row1[1] + row1[2])) * half, mxx = ((row2[0] + row2[3]) + (row2[1] + row2[2])) * quarter;
  const F16 mxy = fma(three, row1[3] - row1[0], row1[2] - row1[1]) * quarter;

  // To moments about each Gaussian's centre.
  Row* rows[16];
  const float* centre[16];
  for (int k = 0; k < 16; ++k) rows[k] = &work.batch.row(work.batch.list.place[first + k]), centre[k] = &rows[k]->u;
  F16 u, v;
  load_pairs(centre, u, v);
  const F16 dx = u - bcast(tile.centre_x + 4.0f * static_cast<float>(block % 4) - 6.0f);
  const F16 dy = v - bcast(tile.centre_y + 4.0f * static_cast<float>(block / 4) - 6.0f);
  const F16 sx = dx * m - mx, sy = dy * m - my;
  out[kS] = m, out[kSx] = sx, out[kSy] = sy;
  out[kSxx] = fma(dx, sx - mx, mxx);
  out[kSxy] = fma(dx, sy, fnma(dy, mx, mxy));
  out[kSyy] = fma(dy, sy - my, myy);
  for (int k = 10; k < 16; ++k) out[k] = bcast(0.0f);
  transpose(out);
  for (int k = 0; k < 16; ++k) {
    float* sums = rows[k]->sums;
    store(sums, load(sums) + out[k]);
  }
}

// alpha and w of the first `count` of the block's list, near to far.
void weigh(Work& work, int count, int block, const float* checkpoint, const Exp2& exp2) {
  const Batch& batch = work.batch;
  const F16 y = block_y(block / 4), stop = bcast(kMinTransmittance), one = bcast(1.0f);
  const int column = block % 4;
  F16 through = load(checkpoint + block * 16);
  for (int i = 0; i < count; i += 4) {
    const Row* row[4];
    F16 alpha[4];
    for (int k = 0; k < 4; ++k) row[k] = &batch.row(batch.list.place[i + k]);
    alphas(row, column, y, exp2, alpha);
    for (int k = 0; k < 4; ++k) {
      const F16 next = through * (one - alpha[k]);
      const M16 drawn = ge(next, stop);
      work.w[i + k] = mul_keep(drawn, through, alpha[k]);
      work.alpha[i + k] = keep(drawn, alpha[k]);
      through = next;
    }
  }
}

template <bool Depth>
void block_backward(Work& work, int count, int block, const float* checkpoint, Pixels& px, const Tile& tile, const Exp2& exp2) {
  const Batch& batch = work.batch;
  weigh(work, count, block, checkpoint, exp2);
  const F16 most = bcast(kMaxAlpha), zero = bcast(0.0f), one = bcast(1.0f);
  const int at = block * 16;
  F16 behind = load(px.behind + at);
  const F16 red = load(px.color[0] + at), green = load(px.color[1] + at), blue = load(px.color[2] + at), depth = load(px.depth + at);
  for (int i = count; i < (count + 15) / 16 * 16; ++i) work.w[i] = work.alpha[i] = zero;
  for (int first = (count - 1) / 16 * 16; first >= 0; first -= 16) {
    F16 W[16];
    for (int i = 15; i >= 0; --i) {
      const Row& row = batch.row(batch.list.place[first + i]);
      F16 s = fma(red, bcast(row.r), fma(green, bcast(row.g), blue * bcast(row.b)));
      if constexpr (Depth) s = fma(depth, bcast(row.z), s);
      const F16 alpha = work.alpha[first + i];
      W[i] = mul_keep(gt(most, alpha), work.w[first + i], s - behind);
      behind = fma(one - alpha, behind, alpha * s);  // the one chain from Gaussian to Gaussian: a single step long
    }
    reduce<Depth>(work, first, work.w + first, W, px, block, tile);
  }
  store(px.behind + at, behind);
}

// Upstream gradients of a tile in block order, what is seen behind everything, and the background's gradient.
void begin_tile(State& s, int number, const Tile& tile, const float* background, const Upstream& up, Pixels& px) {
  const auto read = [&](const float* picture, auto& planes) {
    if (picture)
      load_tile(picture, s.camera, tile, planes);
    else
      std::memset(planes, 0, sizeof planes);
  };
  alignas(64) float alpha[256];
  read(up.image, px.color);
  read(up.depth, px.depth);
  read(up.alpha, alpha);
  inside(s.camera, tile, px.through);
  const float* left = s.transmittance.data() + number * 256;
  F16 total[3] = {bcast(0.0f), bcast(0.0f), bcast(0.0f)};
  for (int k = 0; k < 256; k += 16) {
    F16 behind = bcast(0.0f) - load(alpha + k);
    const F16 l = load(left + k);
    for (int c = 0; c < 3; ++c) {
      const F16 g = load(px.color[c] + k);
      behind = fma(g, bcast(background[c]), behind);
      total[c] = fma(g, l, total[c]);
    }
    store(px.behind + k, behind);
  }
  for (int c = 0; c < 3; ++c) {
    alignas(64) float lane[16];
    store(lane, total[c]);
    double sum = 0;
    for (const float value : lane) sum += value;
    s.background.data()[number * 3 + c] = sum;
  }
}

// Where a batch's sums go: added to the worker's own rows, or (slots) stored in the row of this Gaussian and tile.
struct Sink {
  State& s;
  Sums* own;
  Sums& slot(uint32_t place, const Tile& tile) const {
    const Rect r = s.rects.data()[place];
    return s.sums.data()[s.slots.data()[place] + static_cast<uint32_t>((tile.y - r.y0) * (r.x1 - r.x0) + tile.x - r.x0)];
  }
  void add(uint32_t place, const Tile& tile, const float* sums) const {
    if (own)
      store(own[place].x, load(own[place].x) + load(sums));
    else
      store(slot(place, tile).x, load(sums));
  }
};

template <bool Depth>
void tile_backward(State& s, int number, Work& work, const float* background, const Upstream& up, const Sink& sink, const Exp2& exp2) {
  const Tile tile = tile_at(s, number);
  Pixels px;
  begin_tile(s, number, tile, background, up, px);
  const uint32_t begin = s.tile_begin.data()[number], used = s.tile_used.data()[number], end = begin + used;
  Batch& batch = work.batch;
  for (int index = static_cast<int>((used + kBatch - 1) / kBatch) - 1; index >= 0; --index) {
    const uint32_t at = begin + static_cast<uint32_t>(index) * kBatch;
    const int n = static_cast<int>(std::min<uint32_t>(kBatch, end - at));
    const uint32_t* from = s.list.data() + at;
    batch.load_rows(s.records.data(), from, n, tile);
    for (int k = 0; k < n; ++k) {
      if (sink.own) __builtin_prefetch(&sink.own[from[k]], 1);
      store(batch.rows[k].sums, bcast(0.0f));
    }
    const int64_t number_of_batch = s.batch(number, index);
    const Touched& touched = *reinterpret_cast<const Touched*>(s.masks.data() + number_of_batch * kBatch);
    const float* checkpoint = index > 0 ? s.checkpoints.data() + number_of_batch * 256 : px.through;
    const uint16_t* drawn = s.drawn.data() + number_of_batch * 16;  // multiples of 4: the lists are filled up
    uint16_t any[kGroups] = {};
    for (int b = 0; b < 16; ++b) {
      if (!drawn[b]) continue;
      for (int i = 0; i < kGroups; ++i) any[i] |= touched[b][i];
      batch.list_block(touched[b], n);
      block_backward<Depth>(work, drawn[b], b, checkpoint, px, tile, exp2);
    }
    for (int k = 0; k < n; ++k)
      if (!sink.own || any[k / 16] >> k % 16 & 1) sink.add(from[k], tile, batch.rows[k].sums);
  }
  if (!sink.own)
    for (uint32_t at = end; at < s.tile_begin.data()[number + 1]; ++at)
      std::memset(&sink.slot(s.list.data()[at], tile), 0, sizeof(Sums));
}

// The first slot of each place: slots of a place are contiguous, in row order of its rectangle.
void number_slots(State& s) {
  uint32_t* slots = s.slots.get(static_cast<size_t>(s.places()));
  uint32_t at = 0;
  for (int64_t c = 0; c < s.places() / kChunk; ++c)
    for (uint32_t i = 0; i < s.chunk_count.data()[c]; ++i) {
      const int64_t place = c * kChunk + i;
      const Rect r = s.rects.data()[place];
      slots[place] = at;
      at += static_cast<uint32_t>((r.x1 - r.x0) * (r.y1 - r.y0));
    }
}

void prepare_sums(State& s, int rows, int threads) {
  const int64_t places = s.places(), chunks = places / kChunk;
  if (rows == 0) {
    s.sums.get(static_cast<size_t>(s.pairs));
    number_slots(s);
    return;
  }
  Sums* sums = s.sums.get(static_cast<size_t>(places) * rows);
  parallel_for(chunks * rows, 1, threads, [&](int64_t i, int64_t, int) {
    const int64_t chunk = i % chunks, row = i / chunks;
    std::memset(static_cast<void*>(sums + row * places + chunk * kChunk), 0, s.chunk_count.data()[chunk] * sizeof(Sums));
  });
}

}  // namespace

void blend_backward(State& s, const float* background, const Upstream& up, float* g_background, int rows, int threads) {
  prepare_sums(s, rows, threads);
  double* total = s.background.get(static_cast<size_t>(s.tiles()) * 3);
  parallel_for(s.tiles(), 2, threads, [&](int64_t begin, int64_t end, int worker) {
    Work& work = scratch<Work>();
    const Exp2 exp2;
    const Sink sink{s, rows ? s.sums.data() + worker * s.places() : nullptr};
    for (int64_t t = begin; t < end; ++t) {
      if (up.depth)
        tile_backward<true>(s, static_cast<int>(t), work, background, up, sink, exp2);
      else
        tile_backward<false>(s, static_cast<int>(t), work, background, up, sink, exp2);
    }
  });
  for (int c = 0; c < 3; ++c) {
    double sum = 0;
    for (int t = 0; t < s.tiles(); ++t) sum += total[t * 3 + c];
    g_background[c] = static_cast<float>(sum);
  }
}

}  // namespace se::raster
