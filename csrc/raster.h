// What the stages of the CPU rasteriser share. The picture's definition is render/reference.py; here is how it is computed:
//
//   project    every Gaussian -> a 64-byte Record (whitened ellipse, colour, depth) and its rectangle of tiles
//   bin        a stable scatter into areas of 4 x 4 tiles of 16 x 16 pixels, then each area's sort by depth and its tiles' lists
//   forward    per tile: which 4 x 4 pixel blocks does each Gaussian touch (exact), then block by block, one block per F32x16
//   backward   per tile, batch by batch from the last, from checkpoints that forward left; sums per Gaussian; then the chain rule through
//              the projection
//
// Whitened ellipse: with d = centre - pixel, log2 of the Gaussian's value is log_opacity - (l1 dy + l2 dx)^2 - (l3 dx)^2. As a sum of
// squares it has no cancellation for thin Gaussians, and within a tile it costs two operations per block: for every column x of the tile
// height[x] = log_opacity - (l3 dx)^2 and slope[x] = l1 (v - tile's centre) + l2 dx are made once, then p = height - (slope - l1 y)^2.
#pragma once
#include <cstdint>
#include <cstdlib>
#include <memory>
#include <new>
#include <vector>

#if defined(__linux__)
#include <sys/mman.h>
#elif defined(_WIN32)
#include <malloc.h>
#endif

#include "se_api.h"

namespace se::raster {

constexpr int kTile = 16;             // pixels
constexpr int kArea = 4;              // tiles
constexpr int kMaxAreas = 65536;      // of a picture: 268 million pixels
constexpr int kChunk = 4096;          // Gaussians that one worker projects at a time; a multiple of 16
constexpr int kBatch = 512;           // Gaussians of a tile worked on at a time: each batch's end costs every block some hundred cycles
constexpr int kAhead = 128;           // how many of a tile's Gaussians ahead memory is fetched
constexpr int kBeyond = kAhead + 16;  // entries after the last list, so that looking ahead needs no test
constexpr float kMaxAlpha = 0.99f, kMinTransmittance = 1e-4f;
constexpr float kMinAlphaLog2 = -7.994353437f;  // log2(1 / 255)
constexpr float kWhiten = 0.84932180f;          // sqrt(log2(e) / 2)

// A Gaussian that reaches the picture; colours and ellipse first, as blending reads them.
struct alignas(64) Record {
  float l1, r, g, b, z, u, v, log_opacity, l2, l3, spare[6];
};
static_assert(sizeof(Record) == 64);

struct Rect {  // tiles, end exclusive
  uint16_t x0, y0, x1, y1;
};

struct alignas(16) Item {
  uint32_t key, place;  // depth bits; place of the record
  Rect rect;
};
static_assert(sizeof(Item) == 16);

// A Gaussian in one area: its key, then 16 bits for its number in its part, then bit 4 y + x for the area's tile in column x, row y.
using Entry = uint64_t;
constexpr int kMaxPartChunks = 65536 / kChunk;  // chunks of a part

// Sums over pixels for one Gaussian, W = d loss / d power at a pixel: W, W dx, W dy, W dx^2, W dx dy, W dy^2, then colour and depth.
// The places below kSums but kDepth are 0: a tile keeps the Gaussian's own numbers there, in the same cache line.
struct alignas(64) Sums {
  float x[16];
};
enum { kDepth = 4, kS = 7, kSx, kSy, kSxx, kSxy, kSyy, kRed, kGreen, kBlue, kSums = kS };

// Uninitialised memory that only grows. Large pieces ask for huge pages: their random reads would miss the translation cache otherwise.
template <class T>
class Buffer {
 public:
  T* get(size_t n) {
    if (n > size_) {
      data_.reset();
      size_ = 0;
      const size_t grown = n + n / 8;
      data_.reset(static_cast<T*>(allocate(grown * sizeof(T))));
      size_ = grown;
    }
    return data_.get();
  }
  T* data() const { return data_.get(); }

 private:
  static constexpr size_t kHuge = size_t{1} << 21;
  static void* allocate(size_t bytes) {
    if (bytes < kHuge) return allocate_aligned(bytes, 64);
    void* p = allocate_aligned(bytes, kHuge);
#if defined(__linux__)
    madvise(p, bytes, MADV_HUGEPAGE);
#endif
    return p;
  }
  static void* allocate_aligned(size_t bytes, size_t alignment) {
    const size_t rounded = (bytes + alignment) / alignment * alignment;
#if defined(_WIN32)
    void* p = _aligned_malloc(rounded, alignment);
#else
    void* p = std::aligned_alloc(alignment, rounded);
#endif
    if (!p) throw std::bad_alloc();
    return p;
  }
  struct Free {
    void operator()(T* p) const {
#if defined(_WIN32)
      _aligned_free(p);
#else
      std::free(p);
#endif
    }
  };
  std::unique_ptr<T[], Free> data_;
  size_t size_ = 0;
};

// Everything of one picture that backward needs, and the scratch memory of the stages; reused from picture to picture.
struct State {
  SeCamera camera{};
  int64_t m = 0, visible = 0, pairs = 0;
  int tiles_x = 0, tiles_y = 0;
  bool antialias = false;

  Buffer<Record> records;          // [chunk-aligned m]; chunk c holds its visible ones from c * kChunk on
  Buffer<Item> items;              // same places
  Buffer<uint16_t> group_mask;     // [m / 16] which of sixteen neighbours are visible
  Buffer<uint32_t> group_first;    // [m / 16] place of the first of them
  Buffer<uint32_t> chunk_count;    // [chunks] visible ones
  Buffer<uint32_t> chunk_entries;  // [chunks] areas that its Gaussians meet
  Buffer<uint32_t> part_begin;     // [parts + 1] into the entries
  Buffer<uint32_t> area_begin;     // [parts, areas + 1] into the entries
  Buffer<uint32_t> area_at;        // [areas + 1] how many entries come before each area's
  Buffer<uint32_t> tile_begin;     // [tiles + 1] into `list`
  Buffer<uint32_t> tile_used;      // [tiles] how many of its list a tile looked at before all its pixels had stopped
  Buffer<uint32_t> list;           // [pairs] places, per tile near to far
  Buffer<uint16_t> masks;          // [batches, 16 blocks, kBatch / 16] which of a tile's blocks a Gaussian touches, see batch()
  Buffer<uint16_t> drawn;          // [batches, 16 blocks] how many of those were blended before all the block's pixels had stopped
  Buffer<float> transmittance;     // [tiles * 256] what is left at the end, in block order
  Buffer<float> checkpoints;       // [batches * 256] what is left before each batch but a tile's first, see batch()
  Buffer<Sums> sums;               // backward: one row per place and worker, or (deterministic) per pair; binning works here
  Buffer<uint32_t> slots;          // deterministic backward: first row of each place
  Buffer<double> background;       // backward: [tiles * 3]

  double seconds[5] = {};  // processor time of the calling thread: project, bin, blend, blend backward, project backward

  int tiles() const { return tiles_x * tiles_y; }
  // With one more column and row, which stay empty: rectangles end there.
  int areas_x() const { return (tiles_x + kArea - 1) / kArea + 1; }
  int areas() const { return areas_x() * ((tiles_y + kArea - 1) / kArea + 1); }
  // A number for each batch of each tile: no two share one, and no table is needed.
  int64_t batch(int tile, int index) const { return static_cast<int64_t>(tile_begin.data()[tile]) / kBatch + tile + index; }
  size_t batches() const { return static_cast<size_t>(pairs / kBatch + tiles() + 1); }
  int64_t places() const { return (m + kChunk - 1) / kChunk * kChunk; }
};

struct Inputs {
  const float *means, *quats, *scales, *opacities, *colors;  // [m, 3] [m, 4] [m, 3] [m] [m, 3]
};

struct Outputs {
  float *image, *alpha, *depth;  // [H, W, 3] [H, W] [H, W]
};

struct Upstream {
  const float *image, *alpha, *depth;  // gradients of the outputs; null: zero
};

struct Gradients {
  float *means, *quats, *scales, *opacities, *colors, *mean2d;
};

// Projects all; fills records, items and groups per chunk, and radii [m].
void project(State& s, const Inputs& in, int32_t* radii, int threads);
// Radii alone, of unrotated Gaussians.
void project_visible(const SeCamera& camera, const float* means, const float* scales, int64_t m, uint8_t* visible, int threads);
// Sorts by depth and fills the tiles' lists.
void bin(State& s, int threads);
void blend(State& s, const float* background, const Outputs& out, int threads);
// Fills `sums` and the background's gradient; returns the number of rows that hold one Gaussian's sums (0: slots per pair).
void blend_backward(State& s, const float* background, const Upstream& up, float* g_background, int rows, int threads);
void project_backward(State& s, const Inputs& in, const Gradients& out, int rows, int threads);

}  // namespace se::raster
