// The work of one tile: the Gaussians of one batch laid out for blending, and the blocks that each of them
// touches.
//
// A tile has 16 blocks of 4 x 4 pixels. Block b is in column b % 4 and row b / 4; lane l of its F32x16 is the
// pixel in column l % 4 and row l / 4. Coordinates are relative to the centre of the tile. The forward and the
// backward blending call compute_alphas with the same numbers, so they agree bit for bit.
#pragma once
#include <algorithm>
#include <atomic>
#include <cstring>

#include "pool.h"
#include "raster.h"
#include "raster_simd.h"

namespace se::raster {

struct Tile {
  int x, y;                  // in tiles
  float centre_x, centre_y;  // px
  bool whole;                // every pixel lies in the image
};

// One Gaussian of a batch, as the blocks of the tile read it.
struct alignas(64) Row {
  float shape[2][2][8];        // per half of the tile: heights of eight columns, then their slopes, see raster.h
  float l1, r, g, b, z, u, v;  // as in the Record
  float sums[16 - kSums];      // backward: the sums over blocks so far
  const float* height(int block_column) const { return shape[block_column / 2][0] + block_column % 2 * 4; }
  static constexpr int kSlope = 8;  // offset from a height to its slope
};
static_assert(sizeof(Row) == 192 && kSums == 7);

constexpr int kGroups = kBatch / 16;
using Touched = uint16_t[kGroups][16];  // per group of sixteen Gaussians and per block, one bit per Gaussian

// The Gaussians of a batch that touch one block, near to far, padded to a multiple of 16.
struct List {
  uint16_t place[kBatch + 32];  // offset from the batch's first row in units of eight bytes
  int count;                    // without the padding
};

constexpr int kPlace = sizeof(Row) / 8;

struct Batch {
  Row rows[kBatch + 16];  // the last 16 are Gaussians that draw nothing and pad lists
  List list;              // of the current block
  const Packing<kPlace> packing;

  Batch() {
    std::memset(static_cast<void*>(rows + kBatch), 0, 16 * sizeof(Row));
    for (int k = 0; k < 16; ++k)
      for (auto& half : rows[kBatch + k].shape) std::fill(half[0], half[0] + 8, -1000.0f);
  }

  const Row& row(uint16_t place) const { return *reinterpret_cast<const Row*>(reinterpret_cast<const char*>(rows) + place * size_t{8}); }
  Row& row(uint16_t place) { return *reinterpret_cast<Row*>(reinterpret_cast<char*>(rows) + place * size_t{8}); }

  void load_rows(const Record* records, const uint32_t* from, const uint16_t (&any)[kGroups], int n, const Tile& tile);
  void fill_list(const Touched& touched, int block, int n);
};

inline void Batch::fill_list(const Touched& touched, int block, int n) {
  int count = 0;
  for (int i = 0; i < n; i += 16) {
    packing.pack(list.place + count, touched[i / 16][block], i);
    count += __builtin_popcount(touched[i / 16][block]);
  }
  packing.pack(list.place + count, 0xffff, kBatch);  // distinct rows, so that their sums do not wait for each other
  list.count = count;
}

// Processing order of the blocks of a tile: first one half of the tile, which needs only that half of each row.
constexpr int kBlockOrder[16] = {0, 1, 4, 5, 8, 9, 12, 13, 2, 3, 6, 7, 10, 11, 14, 15};

inline const float* lane_x() {
  alignas(64) static const float x[16] = {-7.5f, -6.5f, -5.5f, -4.5f, -3.5f, -2.5f, -1.5f, -0.5f,
                                          0.5f,  1.5f,  2.5f,  3.5f,  4.5f,  5.5f,  6.5f,  7.5f};
  return x;
}

// Row of each lane's pixel in block row 0..3, relative to the centre of the tile.
inline F32x16 block_y(int block_row) {
  alignas(64) static const float y[16] = {-7.5f, -7.5f, -7.5f, -7.5f, -6.5f, -6.5f, -6.5f, -6.5f,
                                          -5.5f, -5.5f, -5.5f, -5.5f, -4.5f, -4.5f, -4.5f, -4.5f};
  return load(y) + broadcast(4.0f * static_cast<float>(block_row));
}

// Fill the rows of the Gaussians whose bits are set in `any`.
inline void Batch::load_rows(const Record* records, const uint32_t* from, const uint16_t (&any)[kGroups], int n, const Tile& tile) {
  const F32x16 columns = load(lane_x()) + broadcast(tile.centre_x), centre_y = broadcast(tile.centre_y);
  for (int first = 0; first < n; first += 16) {
    for (uint32_t left = any[first / 16]; left; left &= left - 1) {
      const int k = first + __builtin_ctz(left);
      const Record& r = records[from[k]];
      Row& row = rows[k];
      const F32x16 dx = broadcast(r.u) - columns, f = broadcast(r.l3) * dx, ly = broadcast(r.l1) * (broadcast(r.v) - centre_y);
      store_halves(&row.shape[0][0][0], fnma(f, f, broadcast(r.log_opacity)), fma(broadcast(r.l2), dx, ly));
      store(&row.l1, load_first<kSums>(&r.l1));
    }
  }
}

// Exact test of ellipse against block. The smallest distance over the box of pixel centres lies on one of the
// two sides that face the centre: where the ellipse is tangent to the side, or at its end. Sixteen Gaussians,
// one per lane.
inline void test_blocks(const Record* records, const uint32_t* from, int n, const Tile& tile, Touched& touched) {
  const F32x16 zero = broadcast(0.0f);
  for (int i = 0; i < n; i += 16) {
    F32x16 c[16];
    for (int k = 0; k < 16; ++k) __builtin_prefetch(&records[from[i + k + kAhead]]);
    for (int k = 0; k < 16; ++k) c[k] = load(&records[from[i + k < n ? i + k : n - 1]].l1);
    transpose(c);
    const F32x16 l1 = c[0], l2 = c[8], l3 = c[9], U = c[5] - broadcast(tile.centre_x), V = c[6] - broadcast(tile.centre_y);
    const F32x16 limit = c[7] - broadcast(kMinAlphaLog2 - 1e-3f);  // the slack covers rounding
    const F32x16 per_x = zero - l2 / l1, per_y = zero - l1 * l2 / fma(l2, l2, l3 * l3);
    F32x16 lo_y[4], hi_y[4], far_e[4], best_x[4];
    for (int y = 0; y < 4; ++y) {
      lo_y[y] = V - broadcast(4.0f * static_cast<float>(y) - 4.5f), hi_y[y] = lo_y[y] + broadcast(3.0f);
      const F32x16 dy = min(max(zero, lo_y[y]), hi_y[y]);
      far_e[y] = l1 * dy, best_x[y] = per_y * dy;
    }
    const uint32_t valid = n - i < 16 ? (1u << (n - i)) - 1 : 0xffffu;
    for (int x = 0; x < 4; ++x) {
      const F32x16 lo_x = U - broadcast(4.0f * static_cast<float>(x) - 4.5f), hi_x = lo_x + broadcast(3.0f);
      const F32x16 dx = min(max(zero, lo_x), hi_x), f = l3 * dx, near_f2 = f * f, near_e = l2 * dx, best_y = per_x * dx;
      for (int y = 0; y < 4; ++y) {
        const F32x16 e1 = fma(l1, min(max(best_y, lo_y[y]), hi_y[y]), near_e);
        const F32x16 there = min(max(best_x[y], lo_x), hi_x), e2 = fma(l2, there, far_e[y]), f2 = l3 * there;
        touched[i / 16][4 * y + x] = static_cast<uint16_t>(bits(ge(limit, min(fma(e1, e1, near_f2), fma(e2, e2, f2 * f2)))) & valid);
      }
    }
  }
}

// Find which Gaussians of a batch touch any of the blocks whose bits are set.
inline void merge_blocks(const Touched& touched, uint32_t blocks, int n, uint16_t (&any)[kGroups]) {
  uint16_t use[16];
  for (int b = 0; b < 16; ++b) use[b] = blocks >> b & 1 ? 0xffff : 0;
  for (int i = 0; i < (n + 15) / 16; ++i) {
    uint16_t found = 0;
    for (int b = 0; b < 16; ++b) found |= touched[i][b] & use[b];
    any[i] = found;
  }
}

// Compute the alpha of four Gaussians at the pixels of a block; 0 if below 1/255.
inline void compute_alphas(const Row* const (&row)[4], int block_column, F32x16 y, const Exp2& exp2, F32x16 (&alpha)[4]) {
  constexpr int N = kInterleaved;
  const F32x16 limit = broadcast(kMinAlphaLog2), most = broadcast(kMaxAlpha);
  for (int i = 0; i < 4; i += N) {
    F32x16 e[N], p[N];
    Mask16 drawn[N];
    for (int k = 0; k < N; ++k) e[k] = fnma(broadcast(row[i + k]->l1), y, broadcast4(row[i + k]->height(block_column) + Row::kSlope));
    for (int k = 0; k < N; ++k) p[k] = fnma(e[k], e[k], broadcast4(row[i + k]->height(block_column)));
    for (int k = 0; k < N; ++k) drawn[k] = ge(p[k], limit);
    exp2(p);
    for (int k = 0; k < N; ++k) alpha[i + k] = min_keep(drawn[k], p[k], most);
  }
}

// Split four pixels into three channels, and join them.
typedef float F32x4 __attribute__((vector_size(16)));

inline void split_rgb(const float* p, float* r, float* g, float* b) {
  F32x4 x, y, z;  // r0 g0 b0 r1, g1 b1 r2 g2, b2 r3 g3 b3
  std::memcpy(&x, p, 16), std::memcpy(&y, p + 4, 16), std::memcpy(&z, p + 8, 16);
  const F32x4 low = SE_SHUFFLE(x, y, 1, 2, 4, 5), high = SE_SHUFFLE(y, z, 2, 3, 5, 6);  // g0 b0 g1 b1, r2 g2 r3 g3
  const F32x4 red = SE_SHUFFLE(x, high, 0, 3, 4, 6), green = SE_SHUFFLE(low, high, 0, 2, 5, 7), blue = SE_SHUFFLE(low, z, 1, 3, 4, 7);
  std::memcpy(r, &red, 16), std::memcpy(g, &green, 16), std::memcpy(b, &blue, 16);
}

inline void join_rgb(float* p, const float* r, const float* g, const float* b) {
  F32x4 red, green, blue;
  std::memcpy(&red, r, 16), std::memcpy(&green, g, 16), std::memcpy(&blue, b, 16);
  const F32x4 rg = SE_SHUFFLE(red, green, 0, 4, 1, 5), gb = SE_SHUFFLE(green, blue, 1, 5, 2, 6), br = SE_SHUFFLE(blue, red, 0, 5, 2, 7);
  const F32x4 x = SE_SHUFFLE(rg, br, 0, 1, 4, 5);           // r0 g0 b0 r1
  const F32x4 middle = SE_SHUFFLE(red, green, 2, 6, 3, 7);  // r2 g2 r3 g3
  const F32x4 y = SE_SHUFFLE(gb, middle, 0, 1, 4, 5);       // g1 b1 r2 g2
  const F32x4 end = SE_SHUFFLE(middle, blue, 2, 3, 7, 7);   // r3 g3 b3 b3
  const F32x4 z = SE_SHUFFLE(br, end, 2, 4, 5, 6);          // b2 r3 g3 b3
  std::memcpy(p, &x, 16), std::memcpy(p + 4, &y, 16), std::memcpy(p + 8, &z, 16);
}

// Call whole(offset in the image, index in block order) for each four horizontal neighbours inside the image,
// and one(...) for single pixels at its edge.
template <class Whole, class One>
inline void for_each_pixel(const SeCamera& c, const Tile& tile, Whole&& whole, One&& one) {
  const int width = std::min(kTile, c.width - tile.x * kTile), height = std::min(kTile, c.height - tile.y * kTile);
  for (int j = 0; j < height; ++j) {
    const int64_t row = static_cast<int64_t>(tile.y * kTile + j) * c.width + tile.x * kTile;
    const int at = j / 4 * 64 + j % 4 * 4;
    int i = 0;
    for (; i + 4 <= width; i += 4) whole(row + i, at + 4 * i);
    for (; i < width; ++i) one(row + i, at + i / 4 * 16 + i % 4);
  }
}

// Load a tile of an image [H, W, channels] in block order, [channels][16 blocks, 16 lanes]; 0 outside of the
// image.
inline void load_tile(const float* picture, const SeCamera& c, const Tile& tile, float (&plane)[256]) {
  if (!tile.whole) std::memset(plane, 0, sizeof plane);
  for_each_pixel(
      c, tile, [&](int64_t from, int to) { std::memcpy(plane + to, picture + from, 16); },
      [&](int64_t from, int to) { plane[to] = picture[from]; });
}

inline void load_tile(const float* picture, const SeCamera& c, const Tile& tile, float (&planes)[3][256]) {
  if (!tile.whole) std::memset(planes, 0, sizeof planes);
  for_each_pixel(
      c, tile, [&](int64_t from, int to) { split_rgb(picture + 3 * from, planes[0] + to, planes[1] + to, planes[2] + to); },
      [&](int64_t from, int to) {
        for (int k = 0; k < 3; ++k) planes[k][to] = picture[3 * from + k];
      });
}

inline void store_tile(float* picture, const SeCamera& c, const Tile& tile, const float (&plane)[256]) {
  for_each_pixel(
      c, tile, [&](int64_t to, int from) { std::memcpy(picture + to, plane + from, 16); },
      [&](int64_t to, int from) { picture[to] = plane[from]; });
}

inline void store_tile(float* picture, const SeCamera& c, const Tile& tile, const float (&planes)[3][256]) {
  for_each_pixel(
      c, tile, [&](int64_t to, int from) { join_rgb(picture + 3 * to, planes[0] + from, planes[1] + from, planes[2] + from); },
      [&](int64_t to, int from) {
        for (int k = 0; k < 3; ++k) picture[3 * to + k] = planes[k][from];
      });
}

// Call f(begin, end, worker) for all tiles. Each worker starts with its own part of the image, because
// neighbours share Gaussians, and then helps with other parts. It takes several tiles at a time, which prefetch
// each other's Gaussians, but only a few, because all workers wait for the last ones.
template <class F>
void distribute_tiles(const State& s, int threads, F&& f) {
  struct alignas(64) Part {
    std::atomic<int> next;
    int end;
  };
  const int parts = std::clamp(threads, 1, std::max(1, s.tiles())), step = std::clamp(s.tiles() / (64 * parts), 1, 8);
  std::vector<Part> part(static_cast<size_t>(parts));
  for (int p = 0; p < parts; ++p) {
    part[p].next = static_cast<int>(int64_t{s.tiles()} * p / parts);
    part[p].end = static_cast<int>(int64_t{s.tiles()} * (p + 1) / parts);
  }
  parallel_for(parts, 1, threads, [&](int64_t own, int64_t, int worker) {
    for (int k = 0; k < parts; ++k) {
      Part& from = part[(own + k) % parts];
      for (int begin; (begin = from.next.fetch_add(step, std::memory_order_relaxed)) < from.end;)
        f(begin, std::min(begin + step, from.end), worker);
    }
  });
}

// One T per thread, created at its first use. (Accessing a plain thread_local object of a shared library looks
// it up every time.)
template <class T>
T& thread_scratch() {
  thread_local const std::unique_ptr<T> own = std::make_unique<T>();
  return *own;
}

inline Tile tile_at(const State& s, int number) {
  const int x = number % s.tiles_x, y = number / s.tiles_x;
  const bool whole = (x + 1) * kTile <= s.camera.width && (y + 1) * kTile <= s.camera.height;
  return {x, y, static_cast<float>(x * kTile + kTile / 2), static_cast<float>(y * kTile + kTile / 2), whole};
}

// 1 for pixels inside the image, 0 for the rest of a tile at the edge.
inline void mark_inside(const SeCamera& c, const Tile& tile, float (&one)[256]) {
  if (tile.whole) {
    std::fill(one, one + 256, 1.0f);
    return;
  }
  for (int k = 0; k < 256; ++k) {
    const int block = k / 16, lane = k % 16;
    const int x = tile.x * kTile + block % 4 * 4 + lane % 4, y = tile.y * kTile + block / 4 * 4 + lane / 4;
    one[k] = x < c.width && y < c.height ? 1.0f : 0.0f;
  }
}

}  // namespace se::raster
