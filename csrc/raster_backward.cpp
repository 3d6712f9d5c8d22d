// Backward blending. Let s_i = colour_i . g (plus depth), and behind_i the same for what lies behind Gaussian i.
// Then
//   behind_(i-1) = alpha_i s_i + (1 - alpha_i) behind_i,   W_i = w_i (s_i - behind_i) = d loss / d power_i,   w_i = T_i alpha_i,
// without division or cancellation. Batches are processed from the last to the first: a near-to-far pass
// computes alpha_i and w_i from the checkpoint of the forward pass, and a far-to-near pass computes W_i. All
// gradients of the ellipse are six moments of W over the pixels. Sixteen Gaussians are reduced together, one per
// lane.
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
  // Of one block's list: w, and alpha, which W replaces.
  F32x16 w[kBatch + 16], alpha[kBatch + 16];
  float depth[kBatch + 16];  // the batch's sums of depth
  float absolute[2][kBatch + 16];  // the batch's sums kAbsoluteX, kAbsoluteY
};

// Upstream gradients of one block by column: lane l of column c is the pixel in column c of the row of l.
template <bool Depth>
struct Columns {
  F32x16 color[3][4], depth[Depth ? 4 : 1];
  Columns(const Pixels& px, int block) {
    for (int c = 0; c < 3; ++c) split(load(px.color[c] + block * 16), color[c]);
    if constexpr (Depth) split(load(px.depth + block * 16), depth);
  }
  static void split(F32x16 pixels, F32x16 (&columns)[4]) {
    columns[0] = column<0>(pixels), columns[1] = column<1>(pixels), columns[2] = column<2>(pixels), columns[3] = column<3>(pixels);
  }
};

// Sum the weights w of sixteen Gaussians over the pixels of the block, times the upstream gradients; one
// Gaussian per lane.
template <bool Depth>
void reduce_colors(const F32x16* w, const Columns<Depth>& by, F32x16* out, F32x16& depth) {
  F32x16 part[3][4], part_depth[4];
  for (int j = 0; j < 4; ++j) {  // four Gaussians at a time; lanes: row of the block, then Gaussian
    F32x16 c[4] = {w[4 * j], w[4 * j + 1], w[4 * j + 2], w[4 * j + 3]};
    transpose4(c);
    const auto sum = [&](const F32x16(&g)[4]) { return fma(c[0], g[0], fma(c[1], g[1], fma(c[2], g[2], c[3] * g[3]))); };
    for (int k = 0; k < 3; ++k) part[k][j] = sum(by.color[k]);
    if constexpr (Depth) part_depth[j] = sum(by.depth);
  }
  for (int k = 0; k < 3; ++k) out[k] = sum_quarters(part[k]);
  if constexpr (Depth) depth = sum_quarters(part_depth);
}

// Sums of W over the pixels: m; and those of W x, W y, W x^2, W x y, W y^2, with x and y in half pixels from the
// centre of the block (-3 -1 1 3).
struct Moments {
  F32x16 m, x, y, xx, xy, yy;
  explicit Moments(const F32x16* W) {
    const F32x16 three = broadcast(3.0f), nine = broadcast(9.0f);
    F32x16 row0[4], row1[4], row2[4];  // sums along a row: of W, W x, W x^2
    for (int j = 0; j < 4; ++j) {
      F32x16 c[4] = {W[4 * j], W[4 * j + 1], W[4 * j + 2], W[4 * j + 3]};
      transpose4(c);
      const F32x16 outer = c[0] + c[3], inner = c[1] + c[2];
      row0[j] = outer + inner, row1[j] = fma(three, c[3] - c[0], c[2] - c[1]), row2[j] = fma(nine, outer, inner);
    }
    transpose_quarters(row0), transpose_quarters(row1), transpose_quarters(row2);
    const F32x16 outer = row0[0] + row0[3], inner = row0[1] + row0[2];
    m = outer + inner;
    y = fma(three, row0[3] - row0[0], row0[2] - row0[1]), yy = fma(nine, outer, inner);
    x = (row1[0] + row1[3]) + (row1[1] + row1[2]), xx = (row2[0] + row2[3]) + (row2[1] + row2[2]);
    xy = fma(three, row1[3] - row1[0], row1[2] - row1[1]);
  }
};

// Sum sixteen registers over their lanes.
F32x16 sum_lanes(const F32x16 (&r)[16]) {
  F32x16 part[4];
  for (int j = 0; j < 4; ++j) {
    F32x16 c[4] = {r[4 * j], r[4 * j + 1], r[4 * j + 2], r[4 * j + 3]};
    transpose4(c);
    part[j] = (c[0] + c[1]) + (c[2] + c[3]);
  }
  return sum_quarters(part);
}

// Add the absolute values of W times the gradient of the power in the centre over one block. With e = l1 dy + l2 dx, the gradient of
// -e^2 - (l3 dx)^2 is -2 (l2 e + l3^2 dx, l1 e).
void reduce_absolute(Work& work, int first, int block, const Tile& tile, const Record* records, const uint32_t* from) {
  const uint16_t* place = work.batch.list.place + first;
  alignas(64) static const float x[16] = {-7.5f, -6.5f, -5.5f, -4.5f, -7.5f, -6.5f, -5.5f, -4.5f,
                                          -7.5f, -6.5f, -5.5f, -4.5f, -7.5f, -6.5f, -5.5f, -4.5f};
  const F32x16 column = load(x) + broadcast(tile.centre_x + 4.0f * static_cast<float>(block % 4));
  const F32x16 row = block_y(block / 4) + broadcast(tile.centre_y), zero = broadcast(0.0f);
  F32x16 along_x[16], along_y[16];
  for (int k = 0; k < 16; ++k) {
    const int n = place[k] / kPlace;
    const Record& r = records[from[n < kBatch ? n : 0]];  // the rows that pad the list have W = 0
    const F32x16 dx = broadcast(r.u) - column, dy = broadcast(r.v) - row, W = work.alpha[first + k];
    const F32x16 e = fma(broadcast(r.l1), dy, broadcast(r.l2) * dx);
    const F32x16 gx = W * fma(broadcast(r.l2), e, broadcast(r.l3 * r.l3) * dx), gy = W * (broadcast(r.l1) * e);
    along_x[k] = max(gx, zero - gx), along_y[k] = max(gy, zero - gy);
  }
  alignas(64) float value[2][16];
  store(value[0], sum_lanes(along_x)), store(value[1], sum_lanes(along_y));
  for (int axis = 0; axis < 2; ++axis)
    for (int k = 0; k < 16; ++k) work.absolute[axis][place[k] / kPlace] += value[axis][k];
}

// Add the sums over one block to the rows of sixteen Gaussians of its list.
template <bool Depth>
void reduce(Work& work, int first, const Columns<Depth>& by, int block, const Tile& tile) {
  const uint16_t* place = work.batch.list.place + first;
  F32x16 color[3], depth;
  reduce_colors<Depth>(work.w + first, by, color, depth);
  if constexpr (Depth) {
    alignas(64) float value[16];
    store(value, depth);
    for (int k = 0; k < 16; ++k) work.depth[place[k] / kPlace] += value[k];
  }
  const Moments b(work.alpha + first);

  // Shift the moments to the centre of each Gaussian, in half pixels.
  Row* rows[16];
  const float* centre[16];
  for (int k = 0; k < 16; ++k) rows[k] = &work.batch.row(place[k]), centre[k] = &rows[k]->u;
  F32x16 u, v;
  load_pairs(centre, u, v);
  const F32x16 dx = u + u - broadcast(2 * (tile.centre_x + 4.0f * static_cast<float>(block % 4) - 6.0f));
  const F32x16 dy = v + v - broadcast(2 * (tile.centre_y + 4.0f * static_cast<float>(block / 4) - 6.0f));
  const F32x16 zero = broadcast(0.0f), sx = dx * b.m - b.x, sy = dy * b.m - b.y;
  F32x16 q1[4] = {zero, zero, zero, b.m};
  F32x16 q2[4] = {sx, sy, fma(dx, sx - b.x, b.xx), fma(dx, sy, fnma(dy, b.x, b.xy))};
  F32x16 q3[4] = {fma(dy, sy - b.y, b.yy), color[0], color[1], color[2]};
  transpose4(q1), transpose4(q2), transpose4(q3);
  for (int k = 0; k < 4; ++k) {
    F32x16 line[4] = {zero, q1[k], q2[k], q3[k]};
    transpose_quarters(line);
    for (int j = 0; j < 4; ++j) {
      float* sums = &rows[4 * j + k]->l1;
      store(sums, load(sums) + line[j]);
    }
  }
}

// Compute alpha and w of the first `count` Gaussians of the block's list, near to far.
void compute_weights(Work& work, int count, int block, const float* checkpoint, const Exp2& exp2) {
  const Batch& batch = work.batch;
  const F32x16 y = block_y(block / 4), stop = broadcast(kMinTransmittance);
  const int column = block % 4;
  F32x16 through = load(checkpoint + block * 16);
  for (int i = 0; i < count; i += 4) {
    const Row* row[4];
    F32x16 alpha[4];
    for (int k = 0; k < 4; ++k) row[k] = &batch.row(batch.list.place[i + k]);
    compute_alphas(row, column, y, exp2, alpha);
    for (int k = 0; k < 4; ++k) {
      const F32x16 weight = through * alpha[k];
      through = fnma(through, alpha[k], through);
      const Mask16 drawn = ge(through, stop);
      work.w[i + k] = keep(drawn, weight);
      work.alpha[i + k] = keep(drawn, alpha[k]);
    }
  }
}

// The records of the Gaussians of a batch, for the sums of absolute values.
struct Originals {
  const Record* records;
  const uint32_t* from;
};

template <bool Depth, bool Absolute>
void differentiate_block(Work& work, int count, int block, const float* checkpoint, Pixels& px, const Tile& tile, const Originals& originals,
                         const Exp2& exp2) {
  const Batch& batch = work.batch;
  compute_weights(work, count, block, checkpoint, exp2);
  const F32x16 most = broadcast(kMaxAlpha), zero = broadcast(0.0f), one = broadcast(1.0f);
  const int at = block * 16;
  const Columns<Depth> by(px, block);
  F32x16 behind = load(px.behind + at);
  const F32x16 red = load(px.color[0] + at), green = load(px.color[1] + at), blue = load(px.color[2] + at), depth = load(px.depth + at);
  for (int i = count; i < (count + 15) / 16 * 16; ++i) work.w[i] = work.alpha[i] = zero;
  for (int i = count - 1; i >= 0; --i) {
    const Row& row = batch.row(batch.list.place[i]);
    F32x16 s = fma(red, broadcast(row.r), fma(green, broadcast(row.g), blue * broadcast(row.b)));
    if constexpr (Depth) s = fma(depth, broadcast(row.z), s);
    const F32x16 alpha = work.alpha[i];
    work.alpha[i] = mul_keep(gt(most, alpha), work.w[i], s - behind);
    behind = fma(one - alpha, behind, alpha * s);  // the only dependency from Gaussian to Gaussian: one step long
  }
  store(px.behind + at, behind);
  for (int first = 0; first < count; first += 16) {
    reduce<Depth>(work, first, by, block, tile);
    if constexpr (Absolute) reduce_absolute(work, first, block, tile, originals.records, originals.from);
  }
}

// Load the upstream gradients of a tile in block order, the value behind all Gaussians, and the background's
// gradient.
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
  mark_inside(s.camera, tile, px.through);
  const float* left = s.transmittance.data() + number * 256;
  F32x16 total[3] = {broadcast(0.0f), broadcast(0.0f), broadcast(0.0f)};
  for (int k = 0; k < 256; k += 16) {
    F32x16 behind = broadcast(0.0f) - load(alpha + k);
    const F32x16 l = load(left + k);
    for (int c = 0; c < 3; ++c) {
      const F32x16 g = load(px.color[c] + k);
      behind = fma(g, broadcast(background[c]), behind);
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

// Where the sums of a batch go: added to the worker's own rows, or (slots) stored in the row of this Gaussian
// and tile.
struct Sink {
  State& s;
  Sums* own;
  Sums& slot(uint32_t place, const Tile& tile) const {
    const Rect r = s.items.data()[place].rect;
    return s.sums.data()[s.slots.data()[place] + static_cast<uint32_t>((tile.y - r.y0) * (r.x1 - r.x0) + tile.x - r.x0)];
  }
  void add(uint32_t place, const Tile& tile, F32x16 sums) const {
    if (own)
      store(own[place].x, load(own[place].x) + sums);
    else
      store(slot(place, tile).x, sums);
  }
};

template <bool Depth, bool Absolute>
void differentiate_tile(State& s, int number, Work& work, const float* background, const Upstream& up, const Sink& sink, const Exp2& exp2) {
  const Tile tile = tile_at(s, number);
  Pixels px;
  begin_tile(s, number, tile, background, up, px);
  const uint32_t begin = s.tile_begin.data()[number], used = s.tile_used.data()[number], end = begin + used;
  Batch& batch = work.batch;
  for (int index = static_cast<int>((used + kBatch - 1) / kBatch) - 1; index >= 0; --index) {
    const uint32_t at = begin + static_cast<uint32_t>(index) * kBatch;
    const int n = static_cast<int>(std::min<uint32_t>(kBatch, end - at));
    const uint32_t* from = s.list.data() + at;
    const int64_t number_of_batch = s.batch(number, index);
    const Touched& touched = *reinterpret_cast<const Touched*>(s.masks.data() + number_of_batch * kBatch);
    const float* checkpoint = index > 0 ? s.checkpoints.data() + number_of_batch * 256 : px.through;
    const uint16_t* drawn = s.drawn.data() + number_of_batch * 16;  // multiples of 4: the lists are padded
    uint16_t any[kGroups];
    uint32_t blocks = 0;
    for (int b = 0; b < 16; ++b) blocks |= (drawn[b] > 0 ? 1u : 0u) << b;
    merge_blocks(touched, blocks, n, any);
    for (int k = 0; k < n; ++k) __builtin_prefetch(&s.records.data()[from[k + kAhead]]);
    batch.load_rows(s.records.data(), from, any, n, tile);
    if constexpr (Depth) std::fill(work.depth, work.depth + kBatch, 0.0f);
    if constexpr (Absolute)
      for (auto& sums : work.absolute) std::fill(sums, sums + kBatch, 0.0f);
    if (sink.own)
      for (int k = 0; k < n; ++k) __builtin_prefetch(&sink.own[from[k]], 1);
    for (const int b : kBlockOrder) {
      if (!drawn[b]) continue;
      batch.fill_list(touched, b, n);
      differentiate_block<Depth, Absolute>(work, drawn[b], b, checkpoint, px, tile, {s.records.data(), from}, exp2);
    }
    for (int first = 0; first < n; first += 16) {
      if (!sink.own) {  // every slot must be written
        for (int k = first; k < std::min(n, first + 16); ++k)
          if (!(any[first / 16] >> (k - first) & 1)) std::memset(&sink.slot(from[k], tile), 0, sizeof(Sums));
      }
      for (uint32_t left = any[first / 16]; left; left &= left - 1) {
        const int k = first + __builtin_ctz(left);
        F32x16 sums = load_from<kSums>(&batch.rows[k].l1);
        if constexpr (Depth) sums = sums + at_lane(kDepth, work.depth[k]);
        if constexpr (Absolute) sums = sums + at_lane(kAbsoluteX, work.absolute[0][k]) + at_lane(kAbsoluteY, work.absolute[1][k]);
        sink.add(from[k], tile, sums);
      }
    }
  }
  if (!sink.own)
    for (uint32_t at = end; at < s.tile_begin.data()[number + 1]; ++at) std::memset(&sink.slot(s.list.data()[at], tile), 0, sizeof(Sums));
}

// Find the first slot of each place. The slots of a place are contiguous, in row order of its rectangle.
void number_slots(State& s) {
  uint32_t* slots = s.slots.get(static_cast<size_t>(s.places()));
  uint32_t at = 0;
  for (int64_t c = 0; c < s.places() / kChunk; ++c)
    for (uint32_t i = 0; i < s.chunk_count.data()[c]; ++i) {
      const int64_t place = c * kChunk + i;
      const Rect r = s.items.data()[place].rect;
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

void blend_backward(State& s, const float* background, const Upstream& up, float* g_background, int rows, bool absolute, int threads) {
  const auto differentiate = absolute ? (up.depth ? differentiate_tile<true, true> : differentiate_tile<false, true>)
                                      : (up.depth ? differentiate_tile<true, false> : differentiate_tile<false, false>);
  prepare_sums(s, rows, threads);
  double* total = s.background.get(static_cast<size_t>(s.tiles()) * 3);
  distribute_tiles(s, threads, [&](int begin, int end, int worker) {
    Work& work = thread_scratch<Work>();
    const Exp2 exp2;
    const Sink sink{s, rows ? s.sums.data() + worker * s.places() : nullptr};
    for (int t = begin; t < end; ++t) differentiate(s, t, work, background, up, sink, exp2);
  });
  for (int c = 0; c < 3; ++c) {
    double sum = 0;
    for (int t = 0; t < s.tiles(); ++t) sum += total[t * 3 + c];
    g_background[c] = static_cast<float>(sum);
  }
}

}  // namespace se::raster
