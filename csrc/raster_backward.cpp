// Backward blending, front to back like forward: with s_i = colour_i . g (and depth), the light behind Gaussian i is
// rest_i = sum_{j > i} w_j s_j + T_final (...), which starts as the picture's own value and loses w_i s_i at each step, so
//   d loss / d alpha_i = T_i s_i - rest_i / (1 - alpha_i),   W_i = alpha_i d loss / d alpha_i = d loss / d power_i.
// All gradients of the ellipse are six moments of W over the pixels; sixteen Gaussians are buffered and reduced together, one per lane.
#include <algorithm>
#include <cstring>

#include "pool.h"
#include "raster_tile.h"

namespace se::raster {
namespace {

struct Pixels {
  alignas(64) float through[256], rest[256], color[3][256], depth[256];  // color, depth: upstream gradients
};

struct Work {
  Batch batch;
  Sums sums[kBatch + 1];
};

// Adds the sixteen Gaussians' sums over one block. `w`: T alpha, `W`: see above, each [16 Gaussians] of one block's pixels.
template <bool Depth>
void reduce(Work& work, const uint16_t* index, F16 (&w)[16], F16 (&W)[16], const Pixels& px, int block, const Tile& tile) {
  F16 out[16];
  const int at = block * 16;
  transpose(w);
  F16 red = bcast(0.0f), green = red, blue = red, depth = red;
  for (int l = 0; l < 16; ++l) {
    red = fma(w[l], bcast(px.color[0][at + l]), red);
    green = fma(w[l], bcast(px.color[1][at + l]), green);
    blue = fma(w[l], bcast(px.color[2][at + l]), blue);
    if constexpr (Depth) depth = fma(w[l], bcast(px.depth[at + l]), depth);
  }
  out[kRed] = red, out[kGreen] = green, out[kBlue] = blue, out[kDepth] = depth;

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
  alignas(64) float u[16], v[16];
  for (int k = 0; k < 16; ++k) u[k] = work.batch.head[index[k]][5], v[k] = work.batch.head[index[k]][6];
  const F16 dx = load(u) - bcast(tile.centre_x + 4.0f * static_cast<float>(block % 4) - 6.0f);
  const F16 dy = load(v) - bcast(tile.centre_y + 4.0f * static_cast<float>(block / 4) - 6.0f);
  const F16 sx = dx * m - mx, sy = dy * m - my;
  out[kS] = m, out[kSx] = sx, out[kSy] = sy;
  out[kSxx] = fma(dx, sx - mx, mxx);
  out[kSxy] = fma(dx, sy, fnma(dy, mx, mxy));
  out[kSyy] = fma(dy, sy - my, myy);
  for (int k = 10; k < 16; ++k) out[k] = bcast(0.0f);
  transpose(out);
  for (int k = 0; k < 16; ++k) {
    float* sums = work.sums[index[k]].x;
    store(sums, load(sums) + out[k]);
  }
}

template <bool Depth>
void block_backward(Work& work, int count, int block, Pixels& px, const Tile& tile, const Exp2& exp2) {
  const Batch& batch = work.batch;
  const F16 y = block_y(block / 4), limit = bcast(kMinAlphaLog2), most = bcast(kMaxAlpha), stop = bcast(kMinTransmittance);
  const F16 one = bcast(1.0f), zero = bcast(0.0f);
  const int at = block * 16, column = block % 4;
  F16 through = load(px.through + at), rest = load(px.rest + at);
  const F16 red = load(px.color[0] + at), green = load(px.color[1] + at), blue = load(px.color[2] + at), depth = load(px.depth + at);
  for (int first = 0; first < count; first += 16) {
    F16 w[16], W[16];
    const uint16_t* index = batch.list + first;
    const int group = std::min(16, count - first);
    int i = 0;
    for (; i < group; i += 4) {
      F16 alpha[4];
      M16 smooth[4];
      for (int k = 0; k < 4; ++k) {
        const F16 p = log_alpha(batch, index[i + k], column, y), value = exp2(p);
        alpha[k] = min_keep(ge(p, limit), value, most);
        smooth[k] = gt(most, alpha[k]);
      }
      for (int k = 0; k < 4; ++k) {
        const float* head = batch.head[index[i + k]];
        const F16 clear = one - alpha[k], next = through * clear;
        const M16 drawn = ge(next, stop);
        w[i + k] = mul_keep(drawn, through, alpha[k]);
        F16 s = fma(red, bcast(head[1]), fma(green, bcast(head[2]), blue * bcast(head[3])));
        if constexpr (Depth) s = fma(depth, bcast(head[4]), s);
        const F16 seen = w[i + k] * s;
        rest = rest - seen;
        W[i + k] = keep(drawn & smooth[k], fnma(rest, alpha[k] * reciprocal(clear), seen));
        through = next;
      }
    }
    for (; i < 16; ++i) w[i] = zero, W[i] = zero;
    reduce<Depth>(work, index, w, W, px, block, tile);
    if (!any(ge(through, stop))) break;
  }
  store(px.through + at, through), store(px.rest + at, rest);
}

// Upstream gradients of a tile in block order, the starting value of `rest`, and the background's gradient.
void begin_tile(State& s, int number, const Tile& tile, const float* background, const Upstream& up, Pixels& px) {
  alignas(64) float image[3][256], depth[256], alpha[256];
  (void)background;
  if (up.g_image) {
    load_tile<3>(up.g_image, s.camera, tile, px.color);
    load_tile<3>(up.image, s.camera, tile, image);
  } else {
    std::memset(px.color, 0, sizeof px.color);
    std::memset(image, 0, sizeof image);
  }
  if (up.g_depth) {
    load_tile<1>(up.g_depth, s.camera, tile, &px.depth);
    load_tile<1>(up.depth, s.camera, tile, &depth);
  } else {
    std::memset(px.depth, 0, sizeof px.depth);
    std::memset(depth, 0, sizeof depth);
  }
  if (up.g_alpha)
    load_tile<1>(up.g_alpha, s.camera, tile, &alpha);
  else
    std::memset(alpha, 0, sizeof alpha);
  inside(s.camera, tile, px.through);
  const float* left = s.transmittance.data() + number * 256;
  double total[3] = {0, 0, 0};
  for (int k = 0; k < 256; k += 16) {
    F16 rest = load(px.depth + k) * load(depth + k);
    const F16 l = load(left + k);
    for (int c = 0; c < 3; ++c) {
      const F16 g = load(px.color[c] + k);
      rest = fma(g, load(image[c] + k), rest);
      alignas(64) float product[16];
      store(product, g * l);
      for (float value : product) total[c] += value;
    }
    store(px.rest + k, fnma(l, load(alpha + k), rest));
  }
  for (int c = 0; c < 3; ++c) s.background.data()[number * 3 + c] = total[c];
}

// Where a batch's sums go: added to the worker's own rows, or (slots) stored in the row of this Gaussian and tile.
struct Sink {
  State& s;
  Sums* own;
  Sums& slot(uint32_t place, const Tile& tile) const {
    const Rect r = s.rects.data()[place];
    return s.sums.data()[s.slots.data()[place] + static_cast<uint32_t>((tile.y - r.y0) * (r.x1 - r.x0) + tile.x - r.x0)];
  }
  void add(uint32_t place, const Tile& tile, const Sums& sums) const {
    if (own)
      store(own[place].x, load(own[place].x) + load(sums.x));
    else
      store(slot(place, tile).x, load(sums.x));
  }
};

template <bool Depth>
void tile_backward(State& s, int number, Work& work, const float* background, const Upstream& up, const Sink& sink, const Exp2& exp2) {
  const Tile tile = tile_at(s, number);
  Pixels px;
  begin_tile(s, number, tile, background, up, px);
  const uint32_t begin = s.tile_begin.data()[number], end = begin + s.tile_used.data()[number];
  Batch& batch = work.batch;
  for (uint32_t at = begin; at < end; at += kBatch) {
    const int n = static_cast<int>(std::min<uint32_t>(kBatch, end - at));
    const uint32_t* places = s.list.data() + at;
    batch.load_rows(s.records.data(), places, n, tile);
    std::copy(s.masks.data() + at, s.masks.data() + at + n, batch.masks);
    std::fill(batch.masks + n, batch.masks + std::min(kBatch, (n + 15) / 16 * 16), static_cast<uint16_t>(0));
    std::memset(work.sums, 0, static_cast<size_t>(n) * sizeof(Sums));
    uint32_t touched = 0;
    for (int k = 0; k < n; ++k) touched |= batch.masks[k];
    for (; touched; touched &= touched - 1) {
      const int b = __builtin_ctz(touched);
      block_backward<Depth>(work, batch.block_list(n, b), b, px, tile, exp2);
    }
    for (int k = 0; k < n; ++k)
      if (!sink.own || batch.masks[k]) sink.add(places[k], tile, work.sums[k]);
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
    thread_local Work work;
    const Exp2 exp2;
    const Sink sink{s, rows ? s.sums.data() + worker * s.places() : nullptr};
    for (int64_t t = begin; t < end; ++t) {
      if (up.g_depth)
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
