// A tile's share of the work: the Gaussians of one batch laid out for blending, and which blocks each of them touches.
//
// Block b of a tile is 4 x 4 pixels, column b % 4, row b / 4; lane l of its F16 is the pixel in column l % 4, row l / 4. Coordinates are
// relative to the tile's centre. Both directions of the blending run `alpha` on the same numbers, so they agree to the last bit.
#pragma once
#include <algorithm>
#include <cstring>

#include "raster.h"
#include "raster_simd.h"

namespace se::raster {

struct Tile {
  int x, y;          // in tiles
  float centre_x, centre_y;  // px
};

// One Gaussian of a batch, as the tile's blocks read it.
struct alignas(64) Row {
  float height[16], slope[16];  // by column of the tile, see raster.h
  float l1, r, g, b, z, spare[11];
  float sums[16];  // backward: what blocks have added up so far
};

struct Batch {
  Row rows[kBatch + 1];  // one beyond the end is a Gaussian that draws nothing, which fills up lists to whole groups
  alignas(64) int32_t masks[kBatch];
  alignas(64) float u[kBatch], v[kBatch];
  alignas(64) int32_t places[kBatch];  // bytes from `rows` to each row
  // The current block's Gaussians, near to far: bytes from `rows`, and centres.
  alignas(64) int32_t list[kBatch + 32];
  alignas(64) float list_u[kBatch + 32], list_v[kBatch + 32];

  Batch() {
    Row& blank = rows[kBatch];
    for (float& height : blank.height) height = -1000.0f;
    for (float& slope : blank.slope) slope = 0.0f;
    blank.l1 = blank.r = blank.g = blank.b = blank.z = 0.0f;
    for (int k = 0; k < kBatch; ++k) places[k] = k * static_cast<int32_t>(sizeof(Row)), u[k] = v[k] = 0.0f;
  }

  const Row& row(int32_t place) const { return *reinterpret_cast<const Row*>(reinterpret_cast<const char*>(rows) + place); }
  Row& row(int32_t place) { return *reinterpret_cast<Row*>(reinterpret_cast<char*>(rows) + place); }

  void load_rows(const Record* records, const uint32_t* from, int n, int ahead, const Tile& tile);
  void touch_blocks(const Record* records, const uint32_t* from, int n, const Tile& tile);

  // Lists the Gaussians of the batch that touch block b, filled up to a multiple of 16; returns how many without the filling.
  template <bool Centres>
  int list_block(int n, int b) {
    int count = 0;
    for (int i = 0; i < n; i += 16) {
      const M16 m = test_bit(masks + i, b);
      compress(reinterpret_cast<float*>(list + count), load(reinterpret_cast<const float*>(places + i)), m);
      if constexpr (Centres) compress(list_u + count, load(u + i), m), compress(list_v + count, load(v + i), m);
      count += __builtin_popcount(bits(m));
    }
    for (int k = 0; k < 16; ++k) list[count + k] = kBatch * static_cast<int32_t>(sizeof(Row));
    return count;
  }
};

inline const float* lane_x() {
  alignas(64) static const float x[16] = {-7.5f, -6.5f, -5.5f, -4.5f, -3.5f, -2.5f, -1.5f, -.5f, .5f, 1.5f, 2.5f, 3.5f, 4.5f, 5.5f, 6.5f, 7.5f};
  return x;
}

// Row of each lane's pixel in block row 0..3, relative to the tile's centre.
inline F16 block_y(int block_row) {
  alignas(64) static const float y[16] = {-7.5f, -7.5f, -7.5f, -7.5f, -6.5f, -6.5f, -6.5f, -6.5f,
                                          -5.5f, -5.5f, -5.5f, -5.5f, -4.5f, -4.5f, -4.5f, -4.5f};
  return load(y) + bcast(4.0f * static_cast<float>(block_row));
}

// `ahead`: how many of the tile's Gaussians follow, so that they can be fetched early.
inline void Batch::load_rows(const Record* records, const uint32_t* from, int n, int ahead, const Tile& tile) {
  const F16 columns = load(lane_x());
  for (int k = 0; k < n; ++k) {
    __builtin_prefetch(&records[from[std::min(k + 24, n + ahead - 1)]]);
    const Record& r = records[from[k]];
    Row& row = rows[k];
    const F16 dx = bcast(r.u - tile.centre_x) - columns, f = bcast(r.l3) * dx;
    store(row.height, fnma(f, f, bcast(r.log_opacity)));
    store(row.slope, fma(bcast(r.l2), dx, bcast(r.l1 * (r.v - tile.centre_y))));
    std::memcpy(&row.l1, &r, 32);
    u[k] = r.u, v[k] = r.v;
  }
}

// Exact test of ellipse against block: the least distance over the box of its pixel centres lies on one of the two sides that face the
// centre, and on a side it is where the ellipse is tangent to it, or at its end. Sixteen Gaussians per lane.
inline void Batch::touch_blocks(const Record* records, const uint32_t* from, int n, const Tile& tile) {
  const F16 zero = bcast(0.0f);
  for (int i = 0; i < n; i += 16) {
    F16 c[16];
    for (int k = 0; k < 16; ++k) c[k] = load(&records[from[i + k < n ? i + k : n - 1]].l1);
    transpose(c);
    const F16 l1 = c[0], l2 = c[8], l3 = c[9], U = c[5] - bcast(tile.centre_x), V = c[6] - bcast(tile.centre_y);
    const F16 limit = c[7] - bcast(kMinAlphaLog2 - 1e-3f);  // the slack covers rounding
    const F16 per_x = zero - l2 / l1, per_y = zero - l1 * l2 / fma(l2, l2, l3 * l3);
    F16 lo_x[4], hi_x[4], near_f2[4], near_e[4], best_y[4], lo_y[4], hi_y[4], far_e[4], best_x[4];
    for (int k = 0; k < 4; ++k) {
      const float at = 4.0f * static_cast<float>(k);
      lo_x[k] = U - bcast(at - 4.5f), hi_x[k] = U - bcast(at - 7.5f);
      lo_y[k] = V - bcast(at - 4.5f), hi_y[k] = V - bcast(at - 7.5f);
      const F16 dx = min(max(zero, lo_x[k]), hi_x[k]), dy = min(max(zero, lo_y[k]), hi_y[k]);
      const F16 f = l3 * dx;
      near_f2[k] = f * f, near_e[k] = l2 * dx, best_y[k] = per_x * dx;
      far_e[k] = l1 * dy, best_x[k] = per_y * dy;
    }
    Words words;
    for (int b = 0; b < 16; ++b) {
      const int x = b % 4, y = b / 4;
      const F16 e1 = fma(l1, min(max(best_y[x], lo_y[y]), hi_y[y]), near_e[x]);
      const F16 dx = min(max(best_x[y], lo_x[x]), hi_x[x]), e2 = fma(l2, dx, far_e[y]), f2 = l3 * dx;
      words.set(ge(limit, min(fma(e1, e1, near_f2[x]), fma(e2, e2, f2 * f2))), b);
    }
    words.store(masks + i);
  }
  for (int k = n; k < (n + 15) / 16 * 16; ++k) masks[k] = 0;
}

// alpha before the cut at kMaxAlpha is exp2 of this; below kMinAlphaLog2 it is not drawn.
inline F16 log_alpha(const Row& row, int block_column, F16 y) {
  const F16 e = fnma(bcast(row.l1), y, bcast4(row.slope + 4 * block_column));
  return fnma(e, e, bcast4(row.height + 4 * block_column));
}

// [channels, 16 blocks, 16 lanes] of a tile from a picture [H, W, channels]; 0 outside.
template <int Channels>
inline void load_tile(const float* picture, const CameraArgs& c, const Tile& tile, float (*planes)[256]) {
  const int width = std::min(kTile, c.width - tile.x * kTile), height = std::min(kTile, c.height - tile.y * kTile);
  if (width < kTile || height < kTile) std::memset(planes, 0, Channels * 256 * sizeof(float));
  for (int j = 0; j < height; ++j) {
    const float* row = picture + (static_cast<int64_t>(tile.y * kTile + j) * c.width + tile.x * kTile) * Channels;
    for (int i = 0; i < width; ++i) {
      const int at = (j / 4 * 4 + i / 4) * 16 + j % 4 * 4 + i % 4;
      for (int k = 0; k < Channels; ++k) planes[k][at] = row[i * Channels + k];
    }
  }
}

template <int Channels>
inline void store_tile(float* picture, const CameraArgs& c, const Tile& tile, const float (*planes)[256]) {
  const int width = std::min(kTile, c.width - tile.x * kTile), height = std::min(kTile, c.height - tile.y * kTile);
  for (int j = 0; j < height; ++j) {
    float* row = picture + (static_cast<int64_t>(tile.y * kTile + j) * c.width + tile.x * kTile) * Channels;
    for (int i = 0; i < width; ++i) {
      const int at = (j / 4 * 4 + i / 4) * 16 + j % 4 * 4 + i % 4;
      for (int k = 0; k < Channels; ++k) row[i * Channels + k] = planes[k][at];
    }
  }
}

inline Tile tile_at(const State& s, int number) {
  const int x = number % s.tiles_x, y = number / s.tiles_x;
  return {x, y, static_cast<float>(x * kTile + kTile / 2), static_cast<float>(y * kTile + kTile / 2)};
}

// 1 for pixels inside the picture, 0 for the rest of a tile at the edge.
inline void inside(const CameraArgs& c, const Tile& tile, float (&one)[256]) {
  for (int k = 0; k < 256; ++k) {
    const int block = k / 16, lane = k % 16;
    const int x = tile.x * kTile + block % 4 * 4 + lane % 4, y = tile.y * kTile + block / 4 * 4 + lane / 4;
    one[k] = x < c.width && y < c.height ? 1.0f : 0.0f;
  }
}

}  // namespace se::raster
